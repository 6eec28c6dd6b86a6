// A sun's shadow: the discs projected along it, band by band of height, each blurred (rnd_runtime/ground/sun.py, shadow.py).

import { BOX, SUN_CELL, SUN_CELLS, SUN_REACH } from "../constants.js";

const MARGIN = 0.03;  // m

/** {values [rows·columns], rows, columns, toCells [2][3]}: blocked share of the light from `towards` [3], of the given `spread`; `pixel`
 *  is the finest detail that is wanted, m. */
export function sunMap({ discs, starts }, [x, y, rise], spread, pixel) {
  const flat = Math.hypot(x, y), cosine = flat > 1e-6 ? x / flat : 1, sine = flat > 1e-6 ? y / flat : 0, blur = BOX * Math.tan(spread);
  const along = (k) => discs[k] * cosine + discs[k + 1] * sine - discs[k + 2] * flat / rise, across = (k) => discs[k + 1] * cosine - discs[k] * sine;
  const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  let largest = 0, tallest = 0;
  for (let k = 0; k < discs.length; k += 4) {
    [along(k), across(k)].forEach((value, axis) => {
      low[axis] = Math.min(low[axis], value);
      high[axis] = Math.max(high[axis], value);
    });
    tallest = Math.max(tallest, discs[k + 2]);
    largest = Math.max(largest, discs[k + 3]);
  }
  const cell = [1 / rise, 1].map((longer, axis) => {
    const margin = (largest + blur * tallest / rise) * longer + MARGIN;
    high[axis] += margin;
    low[axis] = Math.max(low[axis] - margin, high[axis] - SUN_REACH);  // the feet's end of a long shadow is kept
    return Math.max((high[axis] - low[axis]) / SUN_CELLS, Math.min(Math.max(pixel, SUN_CELL[0]), SUN_CELL[1]));
  });
  const [columns, rows] = [0, 1].map((axis) => Math.ceil((high[axis] - low[axis]) / cell[axis]));
  const scale = [cell[0] * rise, cell[1]], free = new Float32Array(rows * columns).fill(1);  // m across the light of a cell
  for (let band = 0; band + 1 < starts.length; band++) {
    let heights = 0;
    const places = [], box = [Infinity, 0, Infinity, 0];  // row, row, column, column
    for (let k = 4 * starts[band]; k < 4 * starts[band + 1]; k += 4) {
      const column = (along(k) - low[0]) / cell[0], row = (across(k) - low[1]) / cell[1];
      const reach = discs[k + 3] + (scale[0] + scale[1]) / 4, wide = reach / scale[0], tall = reach / scale[1];
      places.push([column, row, wide, tall, discs[k + 3]]);
      heights += discs[k + 2];
      box[0] = Math.min(box[0], Math.trunc(row - tall));
      box[1] = Math.max(box[1], Math.trunc(row + tall) + 1);
      box[2] = Math.min(box[2], Math.trunc(column - wide));
      box[3] = Math.max(box[3], Math.trunc(column + wide) + 1);
    }
    const widths = scale.map((metres) => Math.trunc(blur * heights / (Math.max(places.length, 1) * rise) / metres + 0.5));
    const [top, bottom] = [Math.max(box[0] - widths[1], 0), Math.min(box[1] + widths[1], rows)];
    const [left, right] = [Math.max(box[2] - widths[0], 0), Math.min(box[3] + widths[0], columns)];
    if (!(top < bottom && left < right)) continue;
    const width = right - left, covered = new Float32Array((bottom - top) * width);
    for (const place of places) draw(covered, place, scale, top, bottom, left, right);
    for (let row = 0; row < bottom - top; row++) average(covered, row * width, 1, width, widths[0]);
    for (let column = 0; column < width; column++) average(covered, column, width, bottom - top, widths[1]);
    for (let row = top; row < bottom; row++)
      for (let column = left; column < right; column++) free[row * columns + column] *= 1 - covered[(row - top) * width + column - left];
  }
  const toCells = [[-sine / cell[1], cosine / cell[1], -low[1] / cell[1] - 0.5], [cosine / cell[0], sine / cell[0], -low[0] / cell[0] - 0.5]];
  return { values: free.map((value) => 1 - value), rows, columns, toCells };
}

/** Max-blend a disc's coverage, one cell soft at its edge. */
function draw(covered, [column, row, wide, tall, radius], scale, top, bottom, left, right) {
  const edge = (scale[0] + scale[1]) / 2, reach = radius + edge / 2, sharp = 1 / (2 * radius * edge);
  const first = Math.max(Math.trunc(column - wide), left), last = Math.min(Math.trunc(column + wide) + 1, right);
  for (let i = Math.max(Math.trunc(row - tall), top); i < Math.min(Math.trunc(row + tall) + 1, bottom); i++) {
    const y = (i + 0.5 - row) * scale[1], most = reach * reach - y * y;
    for (let j = first, at = (i - top) * (right - left) + first - left; j < last; j++, at++) {
      const x = (j + 0.5 - column) * scale[0], inside = Math.min((most - x * x) * sharp, 1);
      if (inside > covered[at]) covered[at] = inside;
    }
  }
}

/** Replace `count` values from `first` on, `step` apart, by their means over ± `width`, 0 beyond their ends. */
function average(values, first, step, count, width) {
  if (width === 0) return;
  const line = new Float32Array(count);
  let total = 0;
  for (let k = 0; k < Math.min(width, count); k++) total += values[first + step * k];
  for (let k = 0; k < count; k++) {
    if (k + width < count) total += values[first + step * (k + width)];
    if (k > width) total -= values[first + step * (k - width - 1)];
    line[k] = Math.max(total / (2 * width + 1), 0);
  }
  for (let k = 0; k < count; k++) values[first + step * k] = line[k];
}
