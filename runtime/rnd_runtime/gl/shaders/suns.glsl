// shading.py's suns: the whole BRDF, the highlight widened by the sun's size, a hard shadow from the depth map. They fade
// out between the n·v AT_SILHOUETTE and TURNED_AWAY.

uniform sampler2D depths;  // m towards the sun
uniform vec3 sun_directions[SUNS];  // unit, in the light's frame
uniform vec3 sun_irradiances[SUNS];
uniform float sun_blurs[SUNS];  // mean square angle

// Bilinear share of the four texels around the Gaussian that lies open: what rises above its tangent plane hides it.
float reached_by(int sun) {
    MapPoint here = in_map(sun, mean_world, normal_world);
    if (!(here.cosine > 0.0) || !usable(mean_world, normal_world, disc_radius)) return 0.0;
    float clearance = max(CLEARANCE * disc_radius, CLEARANCE_TEXELS * here.texel) / max(here.cosine, SLOPE_FLOOR);
    ivec2 cell = ivec2(here.position.xy);
    float lit = 0.0;
    for (int corner = 0; corner < 4; corner++) {
        ivec2 texel = cell + ivec2(corner & 1, corner >> 1);
        vec2 d = vec2(texel) - here.position.xy;
        float plane = here.position.z + dot(here.slope, d);
        float depth = texelFetch(depths, texel + ivec2(0, sun * MAP_SIZE), 0).r;
        float open_share = (plane + (1.0 + SOFTNESS) * clearance - depth) / (2.0 * SOFTNESS * clearance);
        lit += (1.0 - abs(d.x)) * (1.0 - abs(d.y)) * clamp(open_share, 0.0, 1.0);
    }
    return min(lit, 1.0);
}

vec3 suns() {
    vec3 sum = vec3(0.0);
    float facing = min((n_dot_v - (TURNED_AWAY)) / (AT_SILHOUETTE - (TURNED_AWAY)), 1.0);
    if (!(facing > 0.0)) return sum;
    for (int sun = 0; sun < SUNS; sun++) {
        vec3 l = sun_directions[sun];
        float n_dot_l = dot(normal, l);
        float arriving = facing * reached_by(sun) * n_dot_l;
        if (!(arriving > 0.0)) continue;
        vec3 h = l + view;
        float half_squared = max(dot(h, h), TINY);
        vec3 across = cross(normal, h);
        float widened = min(alpha_squared() + sun_blurs[sun] / sqrt(half_squared), 1.0);
        float shine = ggx(widened, n_dot_l, n_dot_v, dot(across, across) / half_squared, half_squared);
        sum += arriving * (ONE_OVER_PI * albedo + shine) * sun_irradiances[sun];
    }
    return sum;
}
