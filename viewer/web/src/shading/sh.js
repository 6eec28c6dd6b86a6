// Real spherical harmonics of degree 3, in the order and with the signs of rnd_runtime/shading/sh.py.

import { C0, C1, C2_SIDE as C2, C2_ZONAL as C20, C3_0 as C30, C3_1 as C31, C3_2 as C32, C3_3 as C33, SH_DEGREES } from "../constants.js";

// Gauss–Legendre, four nodes: with eight steps of azimuth exact up to degree 7
const NODES = [[-0.8611363115940526, 0.34785484513745385], [-0.3399810435848563, 0.6521451548625461],
  [0.3399810435848563, 0.6521451548625461], [0.8611363115940526, 0.34785484513745385]];

/** The sixteen functions at the unit direction (x, y, z), into `out`. */
export function shBasis(x, y, z, out) {
  const xx = x * x, yy = y * y, zz = z * z;
  out[0] = C0;
  out[1] = -C1 * y;
  out[2] = C1 * z;
  out[3] = -C1 * x;
  out[4] = C2 * x * y;
  out[5] = -C2 * y * z;
  out[6] = C20 * (2 * zz - xx - yy);
  out[7] = -C2 * x * z;
  out[8] = 0.5 * C2 * (xx - yy);
  out[9] = -C33 * y * (3 * xx - yy);
  out[10] = C32 * x * y * z;
  out[11] = -C31 * y * (4 * zz - xx - yy);
  out[12] = C30 * z * (2 * zz - 3 * xx - 3 * yy);
  out[13] = -C31 * x * (4 * zz - xx - yy);
  out[14] = 0.5 * C32 * z * (xx - yy);
  out[15] = -C33 * x * (xx - 3 * yy);
  return out;
}

/** M [16·16] that rotates coefficients as the 3×3 `r` rotates directions: Y(R d) · M c = Y(d) · c. */
export function shRotation(r) {
  const matrix = new Float64Array(256), here = new Float64Array(16), rotated = new Float64Array(16);
  for (const [z, weight] of NODES)
    for (let k = 0; k < 8; k++) {
      const azimuth = (k + 0.5) * Math.PI / 4, ring = Math.sqrt(1 - z * z);
      const x = ring * Math.cos(azimuth), y = ring * Math.sin(azimuth);
      shBasis(x, y, z, here);
      shBasis(r[0] * x + r[3] * y + r[6] * z, r[1] * x + r[4] * y + r[7] * z, r[2] * x + r[5] * y + r[8] * z, rotated);
      for (let i = 0; i < 16; i++)
        for (let j = 0; j < 16; j++)
          if (SH_DEGREES[i] === SH_DEGREES[j])
            matrix[16 * i + j] += weight * Math.PI / 4 * here[i] * rotated[j];
    }
  return matrix;
}
