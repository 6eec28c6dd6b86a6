// Energy, mean direction and width of a specular lobe (rnd_runtime/shading/specular_lobe.py).

import { COSINE_COUNT, LOBE_TABLE, ROUGHNESS_COUNT, ROUGHNESS_RANGE } from "../constants.js";

const VALUES = 7;  // energy, mean along tangent and normal, position among LOBE_WIDTHS, attenuation of degree 1, 2, 3
const table = new Float32Array(Uint8Array.from(atob(LOBE_TABLE), (c) => c.charCodeAt(0)).buffer);

/** The interpolated table, into `out`: energy, mean direction x y z, position, three attenuations. */
export function lobeAt(roughness, nDotV, n, v, out) {
  const [low, high] = ROUGHNESS_RANGE, a = Math.min(Math.max((roughness - low) / (high - low), 0), 1) * (ROUGHNESS_COUNT - 1);
  const root = Math.sqrt(Math.min(Math.abs(nDotV), 1));
  const b = ((nDotV >= 0 ? root : -root) + 1) / 2 * (COSINE_COUNT - 1);
  const i = Math.min(Math.floor(a), ROUGHNESS_COUNT - 2), j = Math.min(Math.floor(b), COSINE_COUNT - 2), s = a - i, t = b - j;
  const at = (i * COSINE_COUNT + j) * VALUES, below = at + COSINE_COUNT * VALUES;
  const value = (k) => (1 - s) * ((1 - t) * table[at + k] + t * table[at + VALUES + k])
    + s * ((1 - t) * table[below + k] + t * table[below + VALUES + k]);
  // the tangent away from the camera; irrelevant for views along the normal
  const tx = nDotV * n[0] - v[0], ty = nDotV * n[1] - v[1], tz = nDotV * n[2] - v[2];
  const along = value(1) / Math.max(Math.sqrt(tx * tx + ty * ty + tz * tz), 1e-12), normal = value(2);
  const mx = normal * n[0] + along * tx, my = normal * n[1] + along * ty, mz = normal * n[2] + along * tz;
  const length = Math.max(Math.sqrt(mx * mx + my * my + mz * mz), 1e-12);
  out[0] = value(0);
  out[1] = mx / length;
  out[2] = my / length;
  out[3] = mz / length;
  for (let k = 3; k < VALUES; k++) out[k + 1] = value(k);
}
