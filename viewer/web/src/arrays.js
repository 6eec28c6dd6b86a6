// Arrays of numbers: rows, and what stands in the middle.

/** The `rows` of `values`, which has `width` numbers in each. */
export function taken(values, width, rows) {
  const some = new values.constructor(width * rows.length);
  rows.forEach((row, i) => some.set(values.subarray(width * row, width * (row + 1)), width * i));
  return some;
}

/** The median of numbers. */
export function median(values) {
  const sorted = Float64Array.from(values).sort(), half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
}
