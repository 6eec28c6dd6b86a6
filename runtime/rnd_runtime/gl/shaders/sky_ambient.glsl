// shading/ambient.py: sixteen SH coefficients of light times one number of occlusion.

uniform mat4 ambient[3];  // the light's SH coefficients, red, green, blue

vec3 sky() {
    Lobe lobe = lobe_here();
    mat4 shining = sh_scaled(sh_basis(lobe.mean), lobe.shrink), open = sh_scaled(sh_basis(normal), COSINE_LOBE);
    vec3 specular_sum = vec3(sh_dot(shining, ambient[0]), sh_dot(shining, ambient[1]), sh_dot(shining, ambient[2]));
    vec3 diffuse = vec3(sh_dot(open, ambient[0]), sh_dot(open, ambient[1]), sh_dot(open, ambient[2]));
    float occlusion = max(sh_dot(open, coefficients), 0.0);
    return occlusion * (albedo * max(diffuse, 0.0) + specular_share * lobe.energy * max(specular_sum, 0.0));
}
