// Depth of a disc's plane, which falls steeply beyond the disc, inside its own sun's map; blended by maximum.

flat in vec4 disc;
flat in vec4 plane;
flat in float cosine;  // of the normal with the sun's direction, SLOPE_FLOOR at least
out float depth;

void main() {
    vec2 texel = floor(gl_FragCoord.xy) - vec2(0.0, plane.w);
    vec2 d = texel - disc.xy;
    float rise = dot(plane.xy, d);
    if (texel.y < 0.0 || texel.y >= float(MAP_SIZE)) discard;
    float square = disc.w * disc.w, box = disc.w / plane.z + RIM_TEXELS;
    float fall = DROP / (box * box * plane.z * plane.z - square);
    float beyond = dot(d, d) * plane.z * plane.z - square;  // the circle, of which one sees an ellipse
    depth = disc.z + rise - fall * (max(beyond, 0.0) + cosine * max(beyond + rise * rise, 0.0));
}
