// Depth of a disc's plane, where it lies inside the disc and inside its own sun's map; blended by maximum.

flat in vec4 disc;
flat in vec4 plane;
out float depth;

void main() {
    vec2 texel = floor(gl_FragCoord.xy) - vec2(0.0, plane.w);
    vec2 d = texel - disc.xy;
    float rise = dot(plane.xy, d);
    bool inside = dot(d, d) * plane.z * plane.z + rise * rise <= disc.w * disc.w;
    if (!inside || texel.y < 0.0 || texel.y >= float(MAP_SIZE)) discard;
    depth = disc.z + rise;
}
