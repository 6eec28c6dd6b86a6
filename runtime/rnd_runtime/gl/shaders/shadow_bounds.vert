// What surrounds BLOCK Gaussians across the direction of a light, as a point on the light's texel; blended by maximum.

uniform sampler2D points;
uniform sampler2D normals;
uniform mat3 light_axes[LIGHTS];
uniform int count;

flat out vec4 around;  // −left, −bottom, right, top m

void main() {
    int blocks = (count + BLOCK - 1) / BLOCK;
    int light = gl_VertexID / blocks, first = gl_VertexID % blocks * BLOCK;
    around = vec4(-1e30);
    for (int i = first; i < min(first + BLOCK, count); i++) {
        ivec2 place = ivec2(i % ROW_GAUSSIANS, i / ROW_GAUSSIANS);
        vec4 point = texelFetch(points, place, 0);
        vec3 n = texelFetch(normals, place, 0).xyz;
        float sum = point.x + point.y + point.z + point.w + n.x + n.y + n.z;
        if (abs(sum) < 1e30) {  // NaN fails
            vec2 across = (light_axes[light] * point.xyz).xy;
            around = max(around, vec4(-across, across));
        }
    }
    gl_Position = vec4((float(light) + 0.5) / float(LIGHTS) * 2.0 - 1.0, 0.0, 0.0, 1.0);
}
