// One triangle around the ellipse α = 1/255 of each Gaussian, from gl_VertexID alone.
// Before these lines the program states GLSL's version, ATTRIBUTES, ROW_GAUSSIANS and either TEXELS or LIT.

#ifdef LIT
uniform isampler2D order;    // the Gaussian of each rank, back to front; −1 where none is drawn, which has no radiance
uniform sampler2D places;    // by Gaussian: as below
uniform sampler2D shapes;
uniform sampler2D radiance;  // by rank
#else
uniform sampler2D records;   // TEXELS texels for each Gaussian, back to front; see gl/raster.py
#endif
uniform vec2 size;           // px

flat out vec3 centre;   // centre from the image's middle px; log2 of the opacity
flat out vec3 ellipse;  // u = ellipse.x (dx − ellipse.z dy), v = ellipse.y dy with log2 α = peak − u² − v²
flat out vec4 attributes[(ATTRIBUTES + 3) / 4];

const vec2 CORNERS[3] = vec2[3](vec2(0.0, 2.0), vec2(-1.7320508, -1.0), vec2(1.7320508, -1.0));
const float MARGIN = 1.001;  // the rasteriser snaps corners to 1/256 px

void main() {
    int rank = gl_VertexID / 3, corner = gl_VertexID % 3;
#ifdef LIT
    ivec2 texel = ivec2(rank % ROW_GAUSSIANS, rank / ROW_GAUSSIANS);
    int gaussian = max(texelFetch(order, texel, 0).r, 0);
    attributes[0] = texelFetch(radiance, texel, 0);
    texel = ivec2(gaussian % ROW_GAUSSIANS, gaussian / ROW_GAUSSIANS);
    vec4 place = texelFetch(places, texel, 0);
    vec3 shape = texelFetch(shapes, texel, 0).xyz;
    if (attributes[0].w < 0.5) place.z = 0.0;  // nor is radiance that is no number
#else
    ivec2 texel = ivec2(rank % ROW_GAUSSIANS * TEXELS, rank / ROW_GAUSSIANS);
    vec4 place = texelFetch(records, texel, 0);                // centre x, y; reach in u, v; peak
    vec3 shape = texelFetch(records, texel + ivec2(1, 0), 0).xyz;  // √fall_x, √fall_y, shear
    for (int k = 0; k < (ATTRIBUTES + 3) / 4; k++)
        attributes[k] = texelFetch(records, texel + ivec2(2 + k, 0), 0);
#endif

    vec2 uv = place.z * MARGIN * CORNERS[corner];
    float dy = uv.y / shape.y;
    vec2 position = place.xy + vec2(uv.x / shape.x + shape.z * dy, dy);
    // Around an ellipse much larger than the image clipping would lose precision: cover the image instead.
    float extent = 2.0 * place.z * ((1.0 + abs(shape.z)) / shape.y + 1.0 / shape.x);
    if (!(extent < 8.0 * max(size.x, size.y)))
        position = size * (vec2(corner == 1 ? 2.0 : 0.0, corner == 2 ? 2.0 : 0.0) - 0.5);
    centre = vec3(place.xy, place.w);
    ellipse = shape;
    gl_Position = vec4(2.0 * position / size, 0.0, 1.0);
}
