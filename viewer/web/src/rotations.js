// Rotations as in rnd_runtime/core/rotations.py: axis-angle at file borders, row-major 3×3 matrices inside.

/** Rodrigues' formula: axis-angle (x, y, z) rad → nine numbers of `out` from `at`. */
export function axisAngleToMatrix(x, y, z, out, at) {
  const angle = Math.hypot(x, y, z);
  const sine = angle > 1e-8 ? Math.sin(angle) / angle : 1;
  const half = angle > 1e-8 ? Math.sin(angle / 2) / (angle / 2) : 1;
  const versine = 0.5 * half * half;
  out[at] = 1 - versine * (y * y + z * z);
  out[at + 1] = -sine * z + versine * x * y;
  out[at + 2] = sine * y + versine * x * z;
  out[at + 3] = sine * z + versine * x * y;
  out[at + 4] = 1 - versine * (x * x + z * z);
  out[at + 5] = -sine * x + versine * y * z;
  out[at + 6] = -sine * y + versine * x * z;
  out[at + 7] = sine * x + versine * y * z;
  out[at + 8] = 1 - versine * (x * x + y * y);
}

/** Axis-angle, angle in [0, π], of the matrix at `at`; through the quaternion's largest component (Shepperd 1978). */
export function matrixToAxisAngle(m, at) {
  const xx = m[at], yy = m[at + 4], zz = m[at + 8];
  const squares = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz];  // 4q²
  const wx = m[at + 7] - m[at + 5], wy = m[at + 2] - m[at + 6], wz = m[at + 3] - m[at + 1];
  const xy = m[at + 1] + m[at + 3], yz = m[at + 5] + m[at + 7], zx = m[at + 2] + m[at + 6];
  const largest = squares.indexOf(Math.max(...squares));
  let q = [[squares[0], wx, wy, wz], [wx, squares[1], xy, zx], [wy, xy, squares[2], yz], [wz, zx, yz, squares[3]]][largest];
  const sign = (q[0] < 0 ? -1 : 1) / Math.hypot(...q);
  q = q.map((value) => value * sign);
  const sine = Math.hypot(q[1], q[2], q[3]);
  const scale = sine < 1e-9 ? 2 : 2 * Math.atan2(sine, q[0]) / sine;
  return [scale * q[1], scale * q[2], scale * q[3]];
}

/** out = a · b, 3×3 each, at their offsets. */
export function multiply(a, atA, b, atB, out, at) {
  for (let i = 0; i < 3; i++)
    for (let j = 0; j < 3; j++)
      out[at + 3 * i + j] =
        a[atA + 3 * i] * b[atB + j] + a[atA + 3 * i + 1] * b[atB + 3 + j] + a[atA + 3 * i + 2] * b[atB + 6 + j];
}

/** out = aᵀ · b. */
export function transposedTimes(a, atA, b, atB, out, at) {
  for (let i = 0; i < 3; i++)
    for (let j = 0; j < 3; j++)
      out[at + 3 * i + j] = a[atA + i] * b[atB + j] + a[atA + 3 + i] * b[atB + 3 + j] + a[atA + 6 + i] * b[atB + 6 + j];
}

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

export function unit(v) {
  const length = Math.hypot(...v);
  return v.map((value) => value / length);
}

/** aᵀ of a 3×3. */
export const transposed = (a) => [a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8]];

/** a · v of a 3×3 and [3]. */
export const rotate = (a, v) => [0, 1, 2].map((k) => a[3 * k] * v[0] + a[3 * k + 1] * v[1] + a[3 * k + 2] * v[2]);

/** Eigenvalues of a symmetric 3×3 `m`, ascending, and its unit eigenvectors as columns of `axes` [9] (Jacobi 1846). */
export function principalAxes(m) {
  const a = Float64Array.from(m), v = Float64Array.of(1, 0, 0, 0, 1, 0, 0, 0, 1);
  for (let sweep = 0; sweep < 12; sweep++)
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
      const off = a[3 * p + q];
      if (!off) continue;
      const theta = (a[4 * q] - a[4 * p]) / (2 * off), t = Math.sign(theta || 1) / (Math.abs(theta) + Math.hypot(theta, 1));
      const c = 1 / Math.hypot(t, 1), s = t * c;
      for (const [values, stride, step] of [[a, 3, 1], [a, 1, 3], [v, 3, 1]])  // columns of m, then its rows; columns of v
        for (let k = 0; k < 3; k++) {
          const x = values[stride * k + step * p], y = values[stride * k + step * q];
          values[stride * k + step * p] = c * x - s * y;
          values[stride * k + step * q] = s * x + c * y;
        }
    }
  const order = [0, 1, 2].sort((i, j) => a[4 * i] - a[4 * j]);
  return { values: order.map((i) => a[4 * i]), axes: Float64Array.from({ length: 9 }, (_, k) => v[3 * Math.floor(k / 3) + order[k % 3]]) };
}
