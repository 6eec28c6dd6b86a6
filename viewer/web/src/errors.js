// A user's mistake in one line (rnd_runtime/errors.py).

/** "walk.npz: frame 17: poses: expected finite numbers, got nan", to be thrown; parts that nobody gave are left out. */
export function refusal(what, { expected, got, file, frame, hint } = {}) {
  const places = [file, frame === undefined ? undefined : `frame ${frame}`].filter((place) => place !== undefined);
  let line = [...places, what].join(": ");
  if (expected !== undefined) line += `: expected ${expected}`;
  if (got !== undefined) line += `${expected === undefined ? ":" : ","} got ${got}`;
  if (hint !== undefined) line += ` (${hint})`;
  return new Error(line.trim().replace(/\s+/g, " "));
}

/** `error`, whatever was thrown over a file, with the file's name where its message lacks it. */
export function inFile(error, file) {
  const what = error.message ?? String(error);
  return what.startsWith(file) ? error : refusal(what, { file });
}

/** A number in six digits, as Python's `g` has it. */
export function short(value) {
  if (!Number.isFinite(value)) return String(value).replace("NaN", "nan").replace("Infinity", "inf");
  const rounded = Number(value.toPrecision(6));
  return Math.abs(rounded) < 1e6 ? String(rounded) : rounded.toExponential().replace(/\+(\d)$/, "+0$1");
}

/** A shape as messages have it: "5×72". */
export const sizes = (shape) => shape.join("×") || "a single number";
