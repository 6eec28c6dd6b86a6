// Discs that stand for the body, in coordinates of a plane: across it twice, and above it (rnd_runtime/ground/stand_in.py).

import { BANDS, GROWN, LARGEST_DISC, MAX_DISCS, SINK } from "../constants.js";
import { dot } from "../rotations.js";

const FAR = 1e6;  // m

/** {discs: [n·4] m, starts: [7] first disc of each band of height, and n} of the plane with `axes` [3][3] at `offset` m; `radii` [N]. */
export function standIn({ means, normals, count }, radii, axes, offset) {
  const step = Math.max(1, Math.ceil(radii.reduce((sum, radius) => sum + (radius > 0), 0) / MAX_DISCS));
  const grown = GROWN * Math.sqrt(step), bands = Array.from({ length: BANDS.length + 1 }, () => []);
  const point = [0, 0, 0];
  for (let i = 0, seen = 0; i < count; i++) {
    if (!(radii[i] > 0) || seen++ % step) continue;
    const radius = Math.min(radii[i] * grown, LARGEST_DISC);
    for (let k = 0; k < 3; k++) point[k] = means[3 * i + k] - SINK * radius * normals[3 * i + k];
    if (!(Math.abs(point[0]) + Math.abs(point[1]) + Math.abs(point[2]) < FAR)) continue;
    const height = Math.max(dot(axes[2], point) - offset, 0);
    let band = 0;
    while (height >= BANDS[band]) band++;
    bands[band].push(dot(axes[0], point), dot(axes[1], point), height, radius);
  }
  const starts = [0];
  for (const band of bands) starts.push(starts.at(-1) + band.length / 4);
  const discs = new Float32Array(4 * starts.at(-1));
  bands.forEach((band, k) => discs.set(band, 4 * starts[k]));
  return { discs, starts };
}
