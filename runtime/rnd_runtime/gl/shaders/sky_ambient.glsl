// shading_ambient.py: sixteen harmonics of light times one number of occlusion.

uniform mat4 ambient[3];  // the light's harmonics, red, green, blue

const vec4 COSINE = vec4(1.0, 0.66666666666666663, 0.25, 0.0);  // what max(cos, 0)/π leaves of each degree

vec3 sky() {
    Lobe lobe = lobe_here();
    mat4 shining = sh_scaled(sh_basis(lobe.mean), lobe.shrink), open = sh_scaled(sh_basis(normal), COSINE);
    vec3 shine = vec3(sh_dot(shining, ambient[0]), sh_dot(shining, ambient[1]), sh_dot(shining, ambient[2]));
    vec3 diffuse = vec3(sh_dot(open, ambient[0]), sh_dot(open, ambient[1]), sh_dot(open, ambient[2]));
    float occlusion = max(sh_dot(open, coefficients), 0.0);
    return occlusion * (albedo * max(diffuse, 0.0) + lobe.energy * max(shine, 0.0));
}
