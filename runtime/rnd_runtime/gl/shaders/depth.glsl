// How far Gaussians lie along the view, in float64: float32 depths swap neighbours (60 nm at 1 m).

uniform sampler2D drawn;  // mean m; positive where it is drawn
uniform dvec3 forward;    // the view's direction, world
uniform int count;        // Gaussians

// Whether Gaussian i is drawn, and its depth.
bool depth_of(int i, out double depth) {
    vec4 mean = texelFetch(drawn, ivec2(i % ROW_GAUSSIANS, i / ROW_GAUSSIANS), 0);
    precise double along = forward.x * mean.x + forward.y * mean.y + forward.z * mean.z;  // no fused products
    depth = along;
    return mean.w > 0.0;
}
