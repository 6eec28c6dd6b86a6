// Discs that stand for the body, in coordinates of a plane: across it twice, and above it (rnd_runtime/ground/stand_in.py).

import { BANDS, GROWN, LARGEST_DISC, MAX_DISCS, SINK } from "../constants.js";

const FAR = 1e6;  // m

/** {discs: [n·4] m, starts: [7] first disc of each band of height, and n} of the plane with `axes` [3][3] at `offset` m; `radii` [N]. */
export function standIn({ means, normals, count }, radii, axes, offset) {
  const step = Math.max(1, Math.ceil(radii.reduce((sum, radius) => sum + (radius > 0), 0) / MAX_DISCS));
  const grown = GROWN * Math.sqrt(step), bands = Array.from({ length: BANDS.length + 1 }, () => []);
  for (let i = 0, seen = 0; i < count; i++) {
    if (!(radii[i] > 0) || seen++ % step) continue;
    const radius = Math.min(radii[i] * grown, LARGEST_DISC);
    const point = [0, 1, 2].map((k) => means[3 * i + k] - SINK * radius * normals[3 * i + k]);
    if (!(Math.abs(point[0]) + Math.abs(point[1]) + Math.abs(point[2]) < FAR)) continue;
    const [x, y, z] = axes.map((axis) => axis[0] * point[0] + axis[1] * point[1] + axis[2] * point[2]);
    const height = Math.max(z - offset, 0);
    bands[BANDS.filter((bound) => height >= bound).length].push(x, y, height, radius);
  }
  const starts = [0];
  for (const band of bands) starts.push(starts.at(-1) + band.length / 4);
  return { discs: Float32Array.from(bands.flat()), starts };
}
