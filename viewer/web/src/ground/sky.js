// The sky's shadow: the body in slices, each moved along every direction, and their unions summed (rnd_runtime/ground/sky.py).

import { CELL, CELLS, GAP, MAX_SLICES, REACH, SLICE } from "../constants.js";

/** Blocked share [CELLS·CELLS·4] of the ground's light, RGB and 0, around `centre` [2] m: of `discs` [n·4] under light from `directions`
 *  [K][3] in their axes, whose `shares` [K·3] are of the whole. */
export function skyMap(discs, centre, directions, shares) {
  const { slices, corner, width } = sliced(discs, centre[0] - REACH, centre[1] - REACH);
  const span = CELLS + 2 * width, covered = new Float32Array(CELLS * span), blocked = new Float32Array(4 * CELLS * CELLS);
  directions.forEach(([x, y, sine], k) => {
    const stepI = -x / (sine * CELL), stepJ = -y / (sine * CELL);
    const copies = Math.floor(Math.hypot(stepI, stepJ) * SLICE / GAP) + 1;
    let top = CELLS, bottom = 0, left = span, right = 0;
    slices.forEach(({ first, last, cells }, s) => {
      for (let copy = 0; copy < copies && cells.length; copy++) {
        const height = (s + (copy + 0.5) / copies) * SLICE;
        const shift = Math.floor(height * stepI + 0.5) + corner[0], start = Math.floor(height * stepJ + 0.5) + corner[1] + width;
        const low = Math.max(first + shift, 0), high = Math.min(last + shift, CELLS);
        if (start < 0 || start > CELLS + width || low >= high) continue;
        for (let c = 0; c < cells.length; c += 3) {
          const i = cells[c] + shift, at = i * span + start + cells[c + 1];
          if (i >= 0 && i < CELLS && cells[c + 2] > covered[at]) covered[at] = cells[c + 2];
        }
        [top, bottom, left, right] = [Math.min(top, low), Math.max(bottom, high), Math.min(left, start), Math.max(right, start + width)];
      }
    });
    const red = shares[3 * k], green = shares[3 * k + 1], blue = shares[3 * k + 2];
    for (let i = top; i < bottom; i++) {
      for (let j = Math.max(left, width); j < Math.min(right, width + CELLS); j++) {
        const here = covered[i * span + j], at = 4 * (i * CELLS + j - width);
        if (here === 0) continue;
        blocked[at] += red * here;
        blocked[at + 1] += green * here;
        blocked[at + 2] += blue * here;
      }
      covered.fill(0, i * span + left, i * span + right);
    }
  });
  return blocked;
}

/** Cells that discs cover, by slice: `cells` [n·3] row, column and share, rows from `first` to before `last`; their `corner` in the map. */
function sliced(discs, i0, j0) {
  const inside = [], slice = (height) => Math.min(Math.floor(height / SLICE), MAX_SLICES - 1);
  let lowI = CELLS, lowJ = CELLS, highI = 0, highJ = 0, count = 0;
  for (let k = 0; k < discs.length; k += 4) {
    const a = (discs[k] - i0) / CELL, b = (discs[k + 1] - j0) / CELL, i = Math.floor(a), j = Math.floor(b);
    if (!(i >= 2 && i < CELLS - 2 && j >= 2 && j < CELLS - 2)) continue;
    inside.push([a, b, slice(discs[k + 2]), discs[k + 3] / CELL + 0.5]);
    [lowI, lowJ, highI, highJ] = [Math.min(lowI, i), Math.min(lowJ, j), Math.max(highI, i), Math.max(highJ, j)];
    count = Math.max(count, slice(discs[k + 2]) + 1);
  }
  const corner = [lowI - 2, lowJ - 2], rows = Math.max(highI - lowI + 5, 0), width = Math.max(highJ - lowJ + 5, 1);
  const shares = Array.from({ length: count }, () => new Float32Array(rows * width));
  for (const [a, b, s, reach] of inside) {
    const i = Math.floor(a) - corner[0], j = Math.floor(b) - corner[1];
    for (let row = i - 1; row <= i + 1; row++)
      for (let column = j - 1; column <= j + 1; column++) {
        const x = row + 0.5 + corner[0] - a, y = column + 0.5 + corner[1] - b, at = row * width + column;
        shares[s][at] = Math.max(shares[s][at], Math.min(reach - Math.sqrt(x * x + y * y), 1));
      }
  }
  const slices = shares.map((slice) => {
    const cells = [];
    slice.forEach((share, at) => { if (share > 0) cells.push(Math.floor(at / width), at % width, share); });
    return { first: cells[0], last: cells.at(-3) + 1, cells: Float32Array.from(cells) };
  });
  return { slices, corner, width };
}
