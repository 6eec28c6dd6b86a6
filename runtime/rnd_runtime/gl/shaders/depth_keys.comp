// A key for each Gaussian, least for the farthest, by falling index; what is not drawn has the greatest.
// The key is raster/tiles.py's, turned round: 32 bits that span just the visible range.

layout(local_size_x = THREADS) in;
layout(std430, binding = 0) readonly buffer Range { double nearest, farthest; };
layout(std430, binding = 1) writeonly buffer Keys { uint keys[]; };
layout(std430, binding = 2) writeonly buffer Gaussians { int gaussians[]; };

const uint LAST = 0xFFFFFFFFu;

void main() {
    int place = int(gl_GlobalInvocationID.x);
    if (place >= count) return;
    int gaussian = count - 1 - place;
    double depth;
    bool visible = depth_of(gaussian, depth);
    double span = farthest - nearest;
    double scale = span > 0.0lf ? 4294967295.0lf / span : 0.0lf;
    // the nearest's own key would be LAST: it shares that of what lies 0.2 nm in 1 m behind it
    keys[place] = visible ? min(LAST - uint((depth - nearest) * scale), LAST - 1u) : LAST;
    gaussians[place] = visible ? gaussian : -1;
}
