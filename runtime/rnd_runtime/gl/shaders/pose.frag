// posing/skinning.py's formulas for one Gaussian.

uniform sampler2D log_template;  // JOINT_TEXELS texels a Gaussian: what the template has above its floor
uniform sampler2D rest;          // six texels a Gaussian: see gl/posing.py
uniform sampler2D bones;         // three texels a joint, a joint a row: rest pose → posed
uniform float max_offset;        // m
uniform float variance_floor;    // m²
uniform float fallback;

layout(location = 0) out vec4 point;         // mean m, world; radius m of the disc that casts its shadow
layout(location = 1) out vec4 normal;        // unit, world; opacity
layout(location = 2) out vec4 covariance;    // xx, xy, xz, yy m²
layout(location = 3) out vec2 covariance_z;  // yz, zz

vec4 bounded(vec4 x) {
    vec4 tanhs = 1.0 - 2.0 / (exp(2.0 * clamp(x, -9.0, 9.0)) + 1.0);  // 1 in float32 beyond 9
    return mix(tanhs, x, isnan(x));  // which clamp may lose
}

// R of the quaternion normalize(1, v/2).
mat3 turn_by(vec3 v) {
    v *= 0.5;
    float s = 2.0 / (1.0 + dot(v, v));
    vec3 w = s * v;
    return mat3(
        1.0 - w.y * v.y - w.z * v.z, w.x * v.y + w.z, w.x * v.z - w.y,
        w.x * v.y - w.z, 1.0 - w.x * v.x - w.z * v.z, w.y * v.z + w.x,
        w.x * v.z + w.y, w.y * v.z - w.x, 1.0 - w.x * v.x - w.y * v.y
    );
}

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    int gaussian = place.y * ROW_GAUSSIANS + place.x;
    if (gaussian >= GAUSSIANS) discard;
    find_neighbours(gaussian);

    ivec2 texel = ivec2(gaussian % ROW_WIDE * 6, gaussian / ROW_WIDE);
    vec4 r0 = texelFetch(rest, texel, 0), r1 = texelFetch(rest, texel + ivec2(1, 0), 0);
    vec4 r2 = texelFetch(rest, texel + ivec2(2, 0), 0), r3 = texelFetch(rest, texel + ivec2(3, 0), 0);
    vec4 r4 = texelFetch(rest, texel + ivec2(4, 0), 0), r5 = texelFetch(rest, texel + ivec2(5, 0), 0);

    texel = ivec2(gaussian % ROW_WIDE * JOINT_TEXELS, gaussian / ROW_WIDE);
    vec2 ends = field(3).xy;  // sum of the floor's shares, and what their logits are relative to
    float sum = r5.w * ends.x;
    vec4 row_0 = r5.w * field(0), row_1 = r5.w * field(1), row_2 = r5.w * field(2);  // of [A_R | A_T], times sum
    for (int q = 0; q < JOINT_QUADS; q++) {
        vec4 share = exp(texelFetch(log_template, texel + ivec2(q, 0), 0) + (field(BEFORE_JOINTS + q) - ends.y));
        sum += dot(share, vec4(1.0));
        for (int c = 0; c < 4; c++) {
            row_0 += share[c] * texelFetch(bones, ivec2(0, 4 * q + c), 0);
            row_1 += share[c] * texelFetch(bones, ivec2(1, 4 * q + c), 0);
            row_2 += share[c] * texelFetch(bones, ivec2(2, 4 * q + c), 0);
        }
    }
    row_0 /= sum;
    row_1 /= sum;
    row_2 /= sum;
    mat3 a = transpose(mat3(row_0.xyz, row_1.xyz, row_2.xyz));
    mat3 cofactors =
        transpose(mat3(cross(row_1.xyz, row_2.xyz), cross(row_2.xyz, row_0.xyz), cross(row_0.xyz, row_1.xyz)));

    vec3 axis = vec3(r3.w, r4.xy), lever = vec3(r4.zw, r5.x);

    vec3 along = a * axis, across = cofactors * axis;
    float kept = min(length(across) / max(dot(along, along), SMALLEST_SQUARE), 1.0);
    float factor = 1.0;
    for (int k = 0; k < TWIST_STEPS; k++) {
        float halfway = 0.5 * (3.0 - kept);
        factor *= halfway;
        kept *= halfway * halfway;
    }
    float kappa = r5.y * (factor - 1.0);

    vec4 first = bounded(field(4)), second = bounded(field(5));
    vec3 mean = a * (r0.xyz + max_offset * first.xyz + kappa * lever) + vec3(row_0.w, row_1.w, row_2.w);

    mat3 f = transpose(mat3(vec3(r0.w, r1.xy), vec3(r1.zw, r2.x), r2.yzw));
    f = turn_by(vec3(first.w, second.xy)) * f;
    f = a * ((1.0 + kappa) * f - outerProduct(axis, kappa * (axis * f)));
    mat3 sigma = f * transpose(f);
    covariance = vec4(sigma[0].x + variance_floor, sigma[1].x, sigma[2].x, sigma[1].y + variance_floor);
    covariance_z = vec2(sigma[2].y, sigma[2].z + variance_floor);

    vec3 n = r3.xyz + axis * (kappa * dot(axis, r3.xyz));
    n = cofactors * n + fallback * (a * n);
    normal = vec4(n / max(length(n), SHORTEST), r5.z);

    float trace = covariance.x + covariance.w + covariance_z.y;
    point = vec4(mean, r5.z > CASTING_OPACITY ? DISC_SIGMAS * sqrt(0.5 * trace) : 0.0);
}
