// One triangle around the ellipse α = 1/255 of each Gaussian, from gl_VertexID alone, as in rnd_runtime/shaders; but
// the ellipse goes to the fragments whole, which take their place in it from gl_FragCoord: a browser may snap corners
// to a sixteenth of a pixel, and what it interpolates between them is off by as much.

uniform sampler2D records;  // three texels for each Gaussian, back to front; see project.js
uniform vec2 size;          // px

flat out vec4 place;       // centre x, y px; reach in u, v; peak
flat out vec3 shape;       // u = shape.x (dx − shape.z dy), v = shape.y dy
flat out vec3 attributes;

const vec2 CORNERS[3] = vec2[3](vec2(0.0, 2.0), vec2(-1.7320508, -1.0), vec2(1.7320508, -1.0));
const float SNAP = 0.1;  // px

void main() {
    int gaussian = gl_VertexID / 3, corner = gl_VertexID % 3;
    ivec2 texel = ivec2(gaussian % ROW_GAUSSIANS * TEXELS, gaussian / ROW_GAUSSIANS);
    place = texelFetch(records, texel, 0);
    shape = texelFetch(records, texel + ivec2(1, 0), 0).xyz;
    attributes = texelFetch(records, texel + ivec2(2, 0), 0).xyz;

    float reach = place.z + SNAP * max(shape.x * (1.0 + abs(shape.z)), shape.y);
    vec2 uv = reach * CORNERS[corner];
    float dy = uv.y / shape.y;
    vec2 position = place.xy + vec2(uv.x / shape.x + shape.z * dy, dy);
    // Around an ellipse much larger than the picture clipping would lose precision: cover the picture instead.
    float extent = 2.0 * reach * ((1.0 + abs(shape.z)) / shape.y + 1.0 / shape.x);
    if (!(extent < 8.0 * max(size.x, size.y)))
        position = vec2(corner == 1 ? 2.0 * size.x : 0.0, corner == 2 ? 2.0 * size.y : 0.0);
    gl_Position = vec4(2.0 * position / size - 1.0, 0.0, 1.0);
}
