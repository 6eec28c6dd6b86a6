// Directional lights of shading/direct.py: the whole BRDF, the highlight widened by the light's size, a hard shadow from the depth map. They fade
// out between the n·v AT_SILHOUETTE and TURNED_AWAY.

uniform sampler2D depths;  // m towards the light
uniform vec3 light_directions[LIGHTS];  // unit, in the light's frame
uniform vec3 light_irradiances[LIGHTS];
uniform float light_blurs[LIGHTS];  // mean square angle

// Bilinear share of the four texels around the Gaussian that lies open: what rises above its tangent plane hides it.
float reached_by(int light) {
    MapPoint here = in_map(light, mean_world, normal_world);
    if (!(here.cosine > 0.0) || !usable(mean_world, normal_world, disc_radius)) return 0.0;
    float clearance = max(DEPTH_BIAS * disc_radius, CLEARANCE_TEXELS * here.texel) / max(here.cosine, SLOPE_FLOOR);
    ivec2 cell = ivec2(here.position.xy);
    float lit = 0.0;
    for (int corner = 0; corner < 4; corner++) {
        ivec2 texel = cell + ivec2(corner & 1, corner >> 1);
        vec2 d = vec2(texel) - here.position.xy;
        float plane = here.position.z + dot(here.slope, d);
        float depth = texelFetch(depths, texel + ivec2(0, light * MAP_SIZE), 0).r;
        float open_share = (plane + (1.0 + SOFTNESS) * clearance - depth) / (2.0 * SOFTNESS * clearance);
        lit += (1.0 - abs(d.x)) * (1.0 - abs(d.y)) * clamp(open_share, 0.0, 1.0);
    }
    return min(lit, 1.0);
}

vec3 direct() {
    vec3 sum = vec3(0.0);
    float facing = min((n_dot_v - (TURNED_AWAY)) / (AT_SILHOUETTE - (TURNED_AWAY)), 1.0);
    if (!(facing > 0.0)) return sum;
    for (int light = 0; light < LIGHTS; light++) {
        vec3 l = light_directions[light];
        float n_dot_l = dot(normal, l);
        float visible_cosine = facing * reached_by(light) * n_dot_l;
        if (!(visible_cosine > 0.0)) continue;
        vec3 h = l + view;
        float half_squared = max(dot(h, h), TINY);
        vec3 across = cross(normal, h);
        float widened = min(alpha_squared() + light_blurs[light] / sqrt(half_squared), 1.0);
        float specular_term = ggx(widened, n_dot_l, n_dot_v, dot(across, across) / half_squared, half_squared);
        sum += visible_cosine * (ONE_OVER_PI * albedo + specular_share * specular_term) * light_irradiances[light];
    }
    return sum;
}
