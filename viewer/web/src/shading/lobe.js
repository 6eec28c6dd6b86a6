// What a specular lobe looks like to a light map: energy, mean direction, width (rnd_runtime/shading/specular_lobe.py).

import { ROUGHNESS_HIGH, ROUGHNESS_LOW, clampRoughness, ggx } from "./brdf.js";

export const WIDTHS = Array.from({ length: 7 }, (_, k) => 2e-3 * 2.5 ** k);
const ROWS = 16, COLUMNS = 49, SAMPLES = 24, VALUES = 7;
let table = null;

/** [16·49·7]: energy, mean along tangent and normal, place among WIDTHS, attenuation of degree 1, 2, 3. */
export function lobeTable() {
  if (table) return table;
  table = new Float32Array(ROWS * COLUMNS * VALUES);
  const inverse = widthsOfMeans();
  for (let row = 0; row < ROWS; row++)
    for (let column = 0; column < COLUMNS; column++) {
      const root = -1 + 2 * column / (COLUMNS - 1);
      const { energy, tangent, normal } =
        lobeMoments(ROUGHNESS_LOW + (ROUGHNESS_HIGH - ROUGHNESS_LOW) * row / (ROWS - 1), Math.sign(root) * root * root);
      const length = Math.hypot(tangent, normal), width = inverse(length);
      const place = Math.log(width / WIDTHS[0]) / Math.log(WIDTHS[1] / WIDTHS[0]);
      table.set([energy, tangent / length, normal / length, Math.min(Math.max(place, 0), WIDTHS.length - 1),
        ...attenuation(width)], (row * COLUMNS + column) * VALUES);
    }
  return table;
}

/** Energy and first moment of the lobe seen at the cosine n·v: half the samples follow D, half the cosine of l. */
function lobeMoments(roughness, viewZ) {
  const alpha = clampRoughness(roughness) ** 2, viewX = Math.sqrt(1 - viewZ * viewZ);
  let energy = 0, tangent = 0, normal = 0;
  const add = (lx, lz) => {
    const lDotV = lx * viewX + lz * viewZ, halfSquared = Math.max(2 + 2 * lDotV, 1e-12);
    const nh = Math.min((lz + viewZ) ** 2 / halfSquared, 1);
    const distribution = alpha * alpha / (Math.PI * (1 - nh + alpha * alpha * nh) ** 2);
    const density = distribution * Math.sqrt(nh / halfSquared) / 2 + Math.max(lz, 0) / Math.PI;
    const clamped = Math.max(halfSquared, 1e-8), sine = Math.max(1 - (lz + viewZ) ** 2 / clamped, 0);
    const weight = ggx(alpha * alpha, lz, viewZ, sine, clamped) * Math.max(lz, 0) / Math.max(density, 1e-30) / SAMPLES ** 2;
    energy += weight;
    tangent -= weight * lx;
    normal += weight * lz;
  };
  for (let i = 0; i < SAMPLES; i++)
    for (let j = 0; j < SAMPLES; j++) {
      const u = (i + 0.5) / SAMPLES, cosine = Math.cos((j + 0.5) / SAMPLES * Math.PI);
      const halfZ = 1 / Math.sqrt(1 + alpha * alpha * u / (1 - u)), halfX = Math.sqrt(1 - halfZ * halfZ) * cosine;
      const vDotH = viewX * halfX + viewZ * halfZ;
      add(2 * vDotH * halfX - viewX, 2 * vDotH * halfZ - viewZ);
      add(Math.sqrt(1 - u) * cosine, Math.sqrt(u));
    }
  return { energy, tangent: tangent / energy, normal: normal / energy };
}

/** The width whose lobe 1/(1 + width − x)² has a given mean cosine. */
function widthsOfMeans() {
  const count = 4096, low = Math.log(1e-8), high = Math.log(4);
  const logs = Array.from({ length: count }, (_, k) => low + (high - low) * k / (count - 1));
  const means = logs.map((log) => attenuation(Math.exp(log))[0]);  // falls with the width
  return (mean) => {
    let first = 0, last = count - 1;
    if (mean >= means[first]) return Math.exp(logs[first]);
    if (mean <= means[last]) return Math.exp(logs[last]);
    while (last - first > 1) {
      const middle = (first + last) >> 1;
      if (means[middle] >= mean) first = middle;
      else last = middle;
    }
    const t = (means[first] - mean) / (means[first] - means[last]);
    return Math.exp(logs[first] + t * (logs[last] - logs[first]));
  };
}

/** Mean Legendre polynomials P1, P2, P3 under 1/(1 + width − x)². */
function attenuation(width) {
  const a = 1 + width, total = 2 / (width * (a + 1)), powers = [];
  let once = Math.log((a + 1) / width), twice = total;
  for (let m = 1; m < 4; m++) {
    twice = a * twice - once;
    once = a * once - (m % 2 ? 2 / m : 0);
    powers.push(twice / total);
  }
  return [powers[0], (3 * powers[1] - 1) / 2, (5 * powers[2] - 3 * powers[0]) / 2];
}

/** The table between its nodes, into `out`: energy, mean direction x y z, place, three attenuations. */
export function lobeAt(lobes, roughness, nDotV, n, v, out) {
  const a = Math.min(Math.max((roughness - ROUGHNESS_LOW) / (ROUGHNESS_HIGH - ROUGHNESS_LOW), 0), 1) * (ROWS - 1);
  const root = Math.sqrt(Math.min(Math.abs(nDotV), 1));
  const b = ((nDotV >= 0 ? root : -root) + 1) / 2 * (COLUMNS - 1);
  const i = Math.min(Math.floor(a), ROWS - 2), j = Math.min(Math.floor(b), COLUMNS - 2), s = a - i, t = b - j;
  const at = (i * COLUMNS + j) * VALUES, below = at + COLUMNS * VALUES;
  const value = (k) => (1 - s) * ((1 - t) * lobes[at + k] + t * lobes[at + VALUES + k])
    + s * ((1 - t) * lobes[below + k] + t * lobes[below + VALUES + k]);
  // the tangent away from the camera; in a view along the normal there is none, and none is needed
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
