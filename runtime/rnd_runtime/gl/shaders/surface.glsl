// The Gaussian that is shaded. Directions are in the light probe's frame, where all tables live.

uniform sampler2D points;      // mean m, world; radius of its disc m
uniform sampler2D normals;     // unit, world
uniform sampler2D materials;   // albedo, roughness
uniform sampler2D visibility;  // four texels: 16 SH coefficients in the root's frame
uniform vec3 eye;              // m, world
uniform mat3 world_to_light;
uniform mat4 turn[8];          // root's frame → light's frame, of the SH coefficients: see below

vec3 mean_world, normal_world;
float disc_radius;
vec3 normal, view, albedo;
float roughness, n_dot_v, specular_share;
mat4 coefficients;  // of the visibility, in the light's frame
float checksum;     // no number where anything of the Gaussian is none; max() and clamp() may lose that

void load_surface(int index) {
    ivec2 place = ivec2(index % ROW_GAUSSIANS, index / ROW_GAUSSIANS);
    vec4 point = texelFetch(points, place, 0), material = texelFetch(materials, place, 0);
    mean_world = point.xyz;
    disc_radius = point.w;
    normal_world = texelFetch(normals, place, 0).xyz;
    albedo = material.rgb;
    roughness = material.a;
    specular_share = min(max(max(albedo.r, albedo.g), albedo.b) / F0, 1.0);

    vec3 to_eye = world_to_light * (eye - mean_world);
    view = to_eye / max(length(to_eye), TINY);
    normal = world_to_light * normal_world;
    n_dot_v = dot(normal, view);

    ivec2 first = ivec2(4 * place.x, place.y);
    vec4 a = texelFetch(visibility, first, 0), b = texelFetch(visibility, first + ivec2(1, 0), 0);
    vec4 c = texelFetch(visibility, first + ivec2(2, 0), 0), d = texelFetch(visibility, first + ivec2(3, 0), 0);
    const vec4 ONES = vec4(1.0);
    checksum = dot(point, ONES) + dot(material, ONES) + dot(normal_world, ONES.xyz) + dot(a + b + c + d, ONES);
    // a rotation mixes SH coefficients of one degree only: degrees 0 and 1 are a, 2 is b and c.x, 3 is c.yzw and d
    coefficients = mat4(
        turn[0] * a,
        turn[1] * b + turn[2] * c,
        turn[3] * b + turn[4] * c + turn[5] * d,
        turn[6] * c + turn[7] * d
    );
}

// GGX's α².
float alpha_squared() {
    float alpha = clamp(roughness, ROUGHNESS_LOW, ROUGHNESS_HIGH);
    alpha *= alpha;
    return alpha * alpha;
}
