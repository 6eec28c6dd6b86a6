// Errors of input in one line (rnd_runtime/core/errors.py).

/** An error such as "walk.npz: frame 17: poses: expected finite numbers, got nan"; every part is optional. */
export function refusal(what, { expected, got, file, frame, hint } = {}) {
  const location = [file, frame === undefined ? undefined : `frame ${frame}`].filter((part) => part !== undefined);
  let line = [...location, what].join(": ");
  if (expected !== undefined) line += `: expected ${expected}`;
  if (got !== undefined) line += `${expected === undefined ? ":" : ","} got ${got}`;
  if (hint !== undefined) line += ` (${hint})`;
  return new Error(line.trim().replace(/\s+/g, " "));
}

/** `error` with the file's name in its message. */
export function inFile(error, file) {
  const what = error.message ?? String(error);
  return what.startsWith(file) ? error : refusal(what, { file });
}

/** A number formatted as by Python's `g`, by default with six digits. */
export function short(value, digits = 6) {
  if (!Number.isFinite(value)) return String(value).replace("NaN", "nan").replace("Infinity", "inf");
  const [mantissa, power] = value.toExponential(digits - 1).split("e");
  if (power >= -4 && power < digits) return String(Number(value.toPrecision(digits)));
  return `${Number(mantissa)}e${power.replace(/^(.)(\d)$/, "$10$2")}`;
}

/** A shape such as "5×72". */
export const sizes = (shape) => shape.join("×") || "a single number";
