// Sixteen real spherical harmonics as a mat4: function j is component j % 4 of column j / 4. See sh.py.

mat4 sh_basis(vec3 d) {
    float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
    return mat4(
        0.28209479177387814, -0.48860251190291992 * d.y, 0.48860251190291992 * d.z, -0.48860251190291992 * d.x,
        1.0925484305920792 * d.x * d.y, -1.0925484305920792 * d.y * d.z,
        0.31539156525252001 * (2.0 * zz - xx - yy), -1.0925484305920792 * d.x * d.z,
        0.54627421529603959 * (xx - yy), -0.59004358992664351 * d.y * (3.0 * xx - yy),
        2.8906114426405538 * d.x * d.y * d.z, -0.45704579946446572 * d.y * (4.0 * zz - xx - yy),
        0.37317633259011540 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -0.45704579946446572 * d.x * (4.0 * zz - xx - yy),
        1.4453057213202769 * d.z * (xx - yy), -0.59004358992664351 * d.x * (xx - 3.0 * yy)
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
