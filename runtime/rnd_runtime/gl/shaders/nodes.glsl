// What the networks say at the nodes, interpolated for a Gaussian.

uniform sampler2D mixing;  // NEIGHBOURS texels a Gaussian: a node and its weight
uniform sampler2D fields;  // FIELD_TEXELS texels a node: RestPose.node_fields

vec2 neighbours[NEIGHBOURS];

void find_neighbours(int gaussian) {
    ivec2 texel = ivec2(gaussian % ROW_WIDE * NEIGHBOURS, gaussian / ROW_WIDE);
    for (int k = 0; k < NEIGHBOURS; k++) neighbours[k] = texelFetch(mixing, texel + ivec2(k, 0), 0).xy;
}

vec4 field(int quad) {
    vec4 sum = vec4(0.0);
    for (int k = 0; k < NEIGHBOURS; k++) {
        int node = int(neighbours[k].x);
        ivec2 texel = ivec2(node % ROW_WIDE * FIELD_TEXELS + quad, node / ROW_WIDE);
        sum += neighbours[k].y * texelFetch(fields, texel, 0);
    }
    return sum;
}
