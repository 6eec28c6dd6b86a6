// A user's mistake in one line (rnd_runtime/core/errors.py).

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

/** A number as Python's `g` has it, in six digits unless told otherwise. */
export function short(value, digits = 6) {
  if (!Number.isFinite(value)) return String(value).replace("NaN", "nan").replace("Infinity", "inf");
  const [mantissa, power] = value.toExponential(digits - 1).split("e");
  if (power >= -4 && power < digits) return String(Number(value.toPrecision(digits)));
  return `${Number(mantissa)}e${power.replace(/^(.)(\d)$/, "$10$2")}`;
}

/** A shape as messages have it: "5×72". */
export const sizes = (shape) => shape.join("×") || "a single number";
