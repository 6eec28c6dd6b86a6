// shading/tables.py: irradiance for each harmonic of the visibility over the normal, light prefiltered by lobes.

uniform sampler2D diffuse;   // DIFFUSE_SIZE² nodes of twelve texels: 16 numbers of red, of green, of blue
uniform sampler2D specular;  // LEVELS maps of SPECULAR_SIZE² nodes, one below the other

// The corner of an octahedral grid's cell, and the place within the cell, of a direction of any length.
void octahedral_cell(vec3 d, int size, out ivec2 cell, out vec2 place) {
    vec2 p = d.xy / max(abs(d.x) + abs(d.y) + abs(d.z), TINY);
    if (d.z < 0.0) p = (1.0 - abs(p.yx)) * vec2(p.x >= 0.0 ? 1.0 : -1.0, p.y >= 0.0 ? 1.0 : -1.0);
    p = (p + 1.0) * 0.5 * float(size - 1);
    cell = clamp(ivec2(p), ivec2(0), ivec2(size - 2));
    place = p - vec2(cell);
}

vec3 irradiance_at(ivec2 node) {
    ivec2 texel = ivec2(12 * node.x, node.y);
    vec3 sum = vec3(0.0);
    for (int q = 0; q < 4; q++) {
        sum.r += dot(coefficients[q], texelFetch(diffuse, texel + ivec2(q, 0), 0));
        sum.g += dot(coefficients[q], texelFetch(diffuse, texel + ivec2(4 + q, 0), 0));
        sum.b += dot(coefficients[q], texelFetch(diffuse, texel + ivec2(8 + q, 0), 0));
    }
    return sum;
}

vec3 prefiltered(ivec2 node, vec2 place) {
    vec3 top = mix(texelFetch(specular, node, 0).rgb, texelFetch(specular, node + ivec2(1, 0), 0).rgb, place.x);
    vec3 bottom =
        mix(texelFetch(specular, node + ivec2(0, 1), 0).rgb, texelFetch(specular, node + ivec2(1, 1), 0).rgb, place.x);
    return mix(top, bottom, place.y);
}

vec3 sky() {
    Lobe lobe = lobe_here();
    float open = max(sh_dot(sh_scaled(sh_basis(lobe.mean), lobe.shrink), coefficients), 0.0);
    ivec2 cell;
    vec2 place;
    octahedral_cell(lobe.mean, SPECULAR_SIZE, cell, place);
    int low = clamp(int(lobe.place), 0, LEVELS - 2);
    cell.y += low * SPECULAR_SIZE;
    vec3 specular_sum = mix(
        prefiltered(cell, place), prefiltered(cell + ivec2(0, SPECULAR_SIZE), place), lobe.place - float(low)
    );
    octahedral_cell(normal, DIFFUSE_SIZE, cell, place);
    vec3 upper = mix(irradiance_at(cell), irradiance_at(cell + ivec2(1, 0)), place.x);
    vec3 lower = mix(irradiance_at(cell + ivec2(0, 1)), irradiance_at(cell + ivec2(1, 1)), place.x);
    return max(ONE_OVER_PI * albedo * mix(upper, lower, place.y) + specular_share * lobe.energy * open * specular_sum, 0.0);
}
