// A square around the disc of each Gaussian that faces a light, in the light's depth map; six corners each.

uniform sampler2D points;
uniform sampler2D normals;
uniform int count;

flat out vec4 disc;    // x, y texels; z m; radius m
flat out vec4 plane;   // rise along x, along y, m a texel; m a texel; the first row of the light's map
flat out vec2 rim;     // fall beyond the disc, m a m²; cosine of the normal with the light's direction, SLOPE_FLOOR at least

const vec2 CORNERS[6] = vec2[6](
    vec2(-1.0, -1.0), vec2(1.0, -1.0), vec2(-1.0, 1.0), vec2(-1.0, 1.0), vec2(1.0, -1.0), vec2(1.0, 1.0)
);

void main() {
    int corner = gl_VertexID % 6, light = gl_VertexID / 6 / count, index = gl_VertexID / 6 % count;
    ivec2 place = ivec2(index % ROW_GAUSSIANS, index / ROW_GAUSSIANS);
    vec4 point = texelFetch(points, place, 0);
    vec3 normal_world = texelFetch(normals, place, 0).xyz;
    MapPoint here = in_map(light, point.xyz, normal_world);
    disc = vec4(here.position, point.w);
    disc.z -= DROP * max(1.0 - here.cosine / EDGE_ON, 0.0);
    float box = point.w / here.texel + RIM_TEXELS;
    rim = vec2(DROP / (box * box * here.texel * here.texel - point.w * point.w), max(here.cosine, SLOPE_FLOOR));
    plane = vec4(here.slope, here.texel, float(light * MAP_SIZE));
    gl_Position = vec4(-2.0, -2.0, 0.0, 1.0);
    if (here.cosine > 0.0 && point.w > 0.0 && usable(point.xyz, normal_world, point.w)) {
        vec2 corner_at = here.position.xy + box * CORNERS[corner] + 0.5;
        corner_at.y += plane.w;
        gl_Position.xy = 2.0 * corner_at / vec2(float(MAP_SIZE), float(LIGHTS * MAP_SIZE)) - 1.0;
    }
}
