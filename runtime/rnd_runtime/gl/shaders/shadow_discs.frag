// Depth of a disc's plane, which falls steeply beyond the disc, inside its own light's map; blended by maximum.

flat in vec4 disc;
flat in vec4 plane;
flat in vec2 rim;
out float depth;

void main() {
    vec2 texel = floor(gl_FragCoord.xy) - vec2(0.0, plane.w);
    vec2 d = texel - disc.xy;
    float rise = dot(plane.xy, d);
    if (texel.y < 0.0 || texel.y >= float(MAP_SIZE)) discard;
    float beyond = dot(d, d) * plane.z * plane.z - disc.w * disc.w;  // the circle, of which one sees an ellipse
    depth = disc.z + rise - rim.x * (max(beyond, 0.0) + rim.y * max(beyond + rise * rise, 0.0));
}
