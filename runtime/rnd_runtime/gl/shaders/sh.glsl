// Sixteen real spherical harmonics as a mat4: function j is component j % 4 of column j / 4. See sh.py.

mat4 sh_basis(vec3 d) {
    float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
    return mat4(
        SH_C0, -SH_C1 * d.y, SH_C1 * d.z, -SH_C1 * d.x,
        SH_C2_SIDE * d.x * d.y, -SH_C2_SIDE * d.y * d.z,
        SH_C2_ZONAL * (2.0 * zz - xx - yy), -SH_C2_SIDE * d.x * d.z,
        0.5 * SH_C2_SIDE * (xx - yy), -SH_C3_3 * d.y * (3.0 * xx - yy),
        SH_C3_2 * d.x * d.y * d.z, -SH_C3_1 * d.y * (4.0 * zz - xx - yy),
        SH_C3_0 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -SH_C3_1 * d.x * (4.0 * zz - xx - yy),
        0.5 * SH_C3_2 * d.z * (xx - yy), -SH_C3_3 * d.x * (xx - 3.0 * yy)
    );
}

// Coefficients, each degree times its own factor.
mat4 sh_scaled(mat4 c, vec4 degrees) {
    c[0] *= vec4(degrees.x, degrees.yyy);
    c[1] *= degrees.z;
    c[2] *= vec4(degrees.z, degrees.www);
    c[3] *= degrees.w;
    return c;
}

float sh_dot(mat4 a, mat4 b) {
    return dot(a[0], b[0]) + dot(a[1], b[1]) + dot(a[2], b[2]) + dot(a[3], b[3]);
}
