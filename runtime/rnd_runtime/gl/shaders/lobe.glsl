// shading/specular_lobe.py's table between its nodes.

uniform sampler2D lobes;  // two texels a node: energy, along the tangent, along the normal, place; degrees 1 to 3

struct Lobe {
    float energy;
    vec3 mean;     // unit, in the light's frame
    float place;   // among the widths
    vec4 shrink;   // what it leaves of SH coefficients of degree 0 to 3
};

Lobe lobe_here() {
    float a = clamp((roughness - ROUGHNESS_LOW) / (ROUGHNESS_HIGH - ROUGHNESS_LOW), 0.0, 1.0) * float(LOBE_ROWS - 1);
    float root = sqrt(min(abs(n_dot_v), 1.0));
    float b = ((n_dot_v >= 0.0 ? root : -root) + 1.0) * 0.5 * float(LOBE_COLUMNS - 1);
    int i = clamp(int(a), 0, LOBE_ROWS - 2), j = clamp(int(b), 0, LOBE_COLUMNS - 2);
    float s = a - float(i), t = b - float(j);
    vec4 weights = vec4((1.0 - s) * (1.0 - t), (1.0 - s) * t, s * (1.0 - t), s * t);
    ivec2 at = ivec2(2 * j, i);
    vec4 head = weights.x * texelFetch(lobes, at, 0) + weights.y * texelFetch(lobes, at + ivec2(2, 0), 0)
              + weights.z * texelFetch(lobes, at + ivec2(0, 1), 0) + weights.w * texelFetch(lobes, at + ivec2(2, 1), 0);
    at.x += 1;
    vec4 tail = weights.x * texelFetch(lobes, at, 0) + weights.y * texelFetch(lobes, at + ivec2(2, 0), 0)
              + weights.z * texelFetch(lobes, at + ivec2(0, 1), 0) + weights.w * texelFetch(lobes, at + ivec2(2, 1), 0);
    // the tangent away from the camera; in a view along the normal there is none, and none is needed
    vec3 tangent = n_dot_v * normal - view;
    vec3 mean = head.z * normal + head.y / max(length(tangent), TINY) * tangent;
    return Lobe(head.x, mean / max(length(mean), TINY), head.w, vec4(1.0, tail.xyz));
}
