// Interpolation between every n-th node of an avatar (on_fewer_nodes of rnd_runtime/posing/levels.py).

import { NOWHERE } from "../constants.js";

/** `surface` between every `share`-th of its `nodes` alone. */
export function onFewerNodes(surface, nodes, share) {
  const { count, points, neighbours, weights } = surface, own = neighbours.length / count;
  const places = placesOf(surface, nodes, share), many = places.length / 3, width = Math.min(own, many);
  const near = new Int32Array(width * count), squares = new Float64Array(width * count), distances = new Float64Array(many);
  let least = 0;
  for (let i = 0; i < count; i++) {
    for (let m = 0; m < many; m++) {
      const x = points[3 * i] - places[3 * m], y = points[3 * i + 1] - places[3 * m + 1], z = points[3 * i + 2] - places[3 * m + 2];
      distances[m] = x * x + y * y + z * z;
    }
    for (let k = 0; k < width; k++) {
      let best = 0;
      for (let m = 1; m < many; m++) if (distances[m] < distances[best]) best = m;
      near[width * i + k] = best;
      squares[width * i + k] = distances[best];
      distances[best] = Infinity;
    }
    least += squares[width * i] / count;
  }
  const shares = new Float32Array(width * count);
  for (let i = 0; i < count; i++) {
    const kernel = Array.from(squares.subarray(width * i, width * (i + 1)), (square) => 1 / (square + least)), sum = kernel.reduce((a, b) => a + b);
    kernel.forEach((value, k) => { shares[width * i + k] = value / sum; });
  }
  return { ...surface, neighbours: near, weights: shares };
}

/** Places [M·3] m of every `share`-th node: where the Gaussians are that use it, `NOWHERE` m off if none does. */
function placesOf({ count, points, neighbours, weights }, nodes, share) {
  const own = neighbours.length / count, sums = new Float64Array(4 * nodes);
  for (let i = 0; i < count; i++)
    for (let k = own * i; k < own * (i + 1); k++) {
      const at = 4 * neighbours[k];
      for (let c = 0; c < 3; c++) sums[at + c] += weights[k] * points[3 * i + c];
      sums[at + 3] += weights[k];
    }
  const places = [];
  for (let node = 0; node < nodes; node += share)
    for (let c = 0; c < 3; c++) {
      const place = sums[4 * node + c] / sums[4 * node + 3];
      places.push(Number.isFinite(place) ? place : NOWHERE);
    }
  return Float64Array.from(places);
}
