// raster/project.py in float32: the ellipse of one Gaussian in the image, as splat.vert reads it. NEAR m and
// DILATION px² come from raster/oracle.py.

uniform sampler2D points;         // mean m, world; –
uniform sampler2D normals;        // unit, world; opacity
uniform sampler2D covariances;    // xx, xy, xz, yy m²
uniform sampler2D covariances_z;  // yz, zz
uniform int count;
uniform mat3 axes;          // the camera's, world: right, down, forward
uniform vec3 translation;   // m
uniform vec3 eye;           // m, world
uniform vec4 pinhole;       // fx, fy, cx, cy px
uniform vec4 slopes;        // limits of x/z, y/z where the Jacobian is taken: low, high
uniform vec2 size;          // px
uniform float facing;       // n·v below which nothing is drawn

layout(location = 0) out vec4 place;   // centre from the image's middle px; reach in units of the ellipse; log2 of the opacity
layout(location = 1) out vec4 shape;   // √fall_x, √fall_y, shear, –
layout(location = 2) out vec4 drawn;   // mean m; 1, or −1 where nothing is drawn

const float HUGE = 1e30;

// By its bits: drivers may turn comparisons round as if there were no NaN, and NVIDIA's do.
bool finite(float x) {
    return (floatBitsToUint(x) & 0x7f800000u) != 0x7f800000u;
}

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    if (texel.y * ROW_GAUSSIANS + texel.x >= count) discard;
    vec3 mean = texelFetch(points, texel, 0).xyz;
    vec4 outward = texelFetch(normals, texel, 0);
    vec4 s = texelFetch(covariances, texel, 0);
    vec2 t = texelFetch(covariances_z, texel, 0).xy;
    float opacity = outward.w, trace = s.x + s.w + t.y;
    place = vec4(0.0);
    shape = vec4(1.0, 1.0, 0.0, 0.0);
    drawn = vec4(mean, -1.0);

    vec3 p = mean * axes + translation;
    vec3 to_eye = eye - mean;
    float towards = dot(to_eye, outward.xyz);
    if (!finite(p.x + p.y + p.z) || !finite(opacity) || !finite(trace) || !finite(towards)) return;
    bool usable = p.z >= NEAR && p.z < HUGE && opacity >= ALPHA_MIN && opacity < HUGE && trace > 0.0 && trace < HUGE;
    if (!usable || towards < facing * length(to_eye)) return;

    vec2 slope = clamp(p.xy / p.z, slopes.xy, slopes.zw);
    vec3 along_x = pinhole.x / p.z * (axes[0] - slope.x * axes[2]);
    vec3 along_y = pinhole.y / p.z * (axes[1] - slope.y * axes[2]);
    mat3 sigma = mat3(s.x, s.y, s.z, s.y, s.w, t.x, s.z, t.x, t.y);
    vec3 moved = sigma * along_x;
    float xx = dot(along_x, moved) + DILATION;
    float xy = dot(along_y, moved);
    float yy = dot(along_y, sigma * along_y) + DILATION;
    float shear = xy / yy;
    float conditional = max(xx - xy * shear, DILATION);  // no less, were there no rounding
    if (!finite(xx + yy) || !finite(conditional)) return;
    if (!(xx > 0.0 && xx < HUGE && yy > 0.0 && yy < HUGE && conditional < HUGE)) return;

    vec2 along = pinhole.xy * p.xy / p.z, centre = along + pinhole.zw;
    float peak = log2(opacity);
    float reach = max(peak + (-LOG2_ALPHA_MIN), 0.0);
    vec2 reach_px = sqrt(reach / HALF_LOG2_E * vec2(xx, yy));
    vec2 low = max(centre - reach_px + 0.499, 0.0), high = min(centre + reach_px - 0.499, size - 1.0);
    if (!(all(lessThan(low, size)) && all(greaterThanEqual(high, vec2(0.0))))) return;
    if (any(greaterThan(floor(low), floor(high)))) return;  // between two pixels' centres

    place = vec4(along + (pinhole.zw - 0.5 * size), sqrt(reach), peak);
    shape = vec4(sqrt(HALF_LOG2_E / conditional), sqrt(HALF_LOG2_E / yy), shear, 0.0);
    drawn.w = 1.0;
}
