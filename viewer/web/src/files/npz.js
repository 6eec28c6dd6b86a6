// .npz archives: zip (fflate) of .npy, read by member, numbers and strings only (rnd_runtime/core/npz.py).

import { unzipSync } from "fflate";
import { crc32, crcs } from "./crc.js";
import { refusal, short } from "../errors.js";

const READERS = {  // bytes, and the number at an index of a view
  f8: [8, (view, at, little) => view.getFloat64(at, little)], f4: [4, (view, at, little) => view.getFloat32(at, little)],
  f2: [2, (view, at, little) => half(view.getUint16(at, little))],
  i8: [8, (view, at, little) => Number(view.getBigInt64(at, little))], i4: [4, (view, at, little) => view.getInt32(at, little)],
  i2: [2, (view, at, little) => view.getInt16(at, little)], i1: [1, (view, at) => view.getInt8(at)],
  u8: [8, (view, at, little) => Number(view.getBigUint64(at, little))], u4: [4, (view, at, little) => view.getUint32(at, little)],
  u2: [2, (view, at, little) => view.getUint16(at, little)], u1: [1, (view, at) => view.getUint8(at)],
  b1: [1, (view, at) => (view.getUint8(at) ? 1 : 0)],
};
const KINDS = { f: "float", i: "int", u: "uint", c: "complex" };  // numpy's names, without the number of bits
// A Python dict of three keys in any order
const HEADER = /^\{(\s*'(descr|fortran_order|shape)':\s*('[^']*'|\[.*\]|True|False|\([\dL,\s]*\))\s*,?){3}\s*\}\s*$/;
const MAGIC = "\x93NUMPY", NEWEST = 3;  // version of the format

/** The members of an archive; errors name file and member. */
export class Npz {
  /** `what` the file is, for messages. */
  constructor(bytes, file, what) {
    this.bytes = bytes;
    this.file = file;
    this.entries = new Map();  // member → its name in the zip
    const wrong = { expected: "an .npz archive", file };
    if (startsWithMagic(bytes)) throw refusal(`${what} cannot be read`, { ...wrong, got: "an array" });
    try {
      unzipSync(bytes, { filter: ({ name }) => { this.entries.set(name.replace(/\.npy$/, ""), name); } });
    } catch {
      throw refusal(`${what} cannot be read`, wrong);
    }
    this.names = [...this.entries.keys()];
    this.crcs = crcs(bytes);
  }

  has(name) { return this.entries.has(name); }

  /** The first of `names` that the archive holds. */
  firstOf(...names) { return names.find((name) => this.has(name)); }

  /** {shape, numbers: Float64Array, the last axis fastest} of member `name`, all finite. */
  numbers(name) {
    const array = this.member(name), { type, dtype, shape } = array;
    if (!READERS[type]) {
      const expected = "fiu".includes(type[0]) ? "numbers of at most 64 bits" : "numbers";
      throw refusal(name, { expected, got: `dtype ${dtype}`, file: this.file });
    }
    const numbers = inRows(readNumbers(array), array);
    const bad = numbers.findIndex((value) => !Number.isFinite(value));
    if (bad >= 0) {
      const frame = shape.length > 1 ? Math.floor(bad / (numbers.length / shape[0])) : undefined;
      throw refusal(name, { expected: "finite numbers", got: short(numbers[bad]), file: this.file, frame });
    }
    return { shape, numbers };
  }

  /** The strings of member `name`. */
  strings(name) {
    const array = this.member(name);
    if (!"SU".includes(array.type[0])) throw refusal(name, { expected: "strings", got: `dtype ${array.dtype}`, file: this.file });
    const texts = inRows(readStrings(array), array);
    if (texts.includes(null)) throw refusal(name, { expected: "strings", got: "damaged ones", file: this.file });
    return texts;
  }

  member(name) {
    const { entries, names, file } = this, entry = entries.get(name);
    if (!this.has(name)) throw refusal(`${name} is missing`, { got: `only ${names.join(", ") || "nothing"}`, file });
    let array = null;
    try {
      const data = unzipSync(this.bytes, { filter: (one) => one.name === entry })[entry];
      if (crc32(data) === (this.crcs.get(entry) ?? crc32(data))) array = readHeader(data);
    } catch { /* cut short, or no .npy at all */ }
    if (!array) throw refusal(name, { expected: "an array", got: "data that is cut short or damaged", file });
    if (array.type === "O") throw refusal(name, { expected: "an array", got: "Python objects", file });
    return array;
  }
}

const startsWithMagic = (data) => [...MAGIC].every((letter, k) => data[k] === letter.charCodeAt(0));

/** The header of a .npy: {type such as f8, dtype as in numpy, size of an element in bytes, little, shape, count, fortran,
 *  view of the elements}; null if it is invalid or too short. */
function readHeader(data) {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength), version = view.getUint16(6, true);
  if (!startsWithMagic(data) || version < 1 || version > NEWEST) return null;
  const start = version > 1 ? 12 : 10, at = start + (version > 1 ? view.getUint32(8, true) : view.getUint16(8, true));
  const header = new TextDecoder().decode(data.subarray(start, at)).replaceAll('"', "'");
  if (!HEADER.test(header)) return null;
  const descr = /'descr':\s*('[^']*'|\[.*\])/.exec(header)[1], extents = /'shape':\s*\(([^)]*)\)/.exec(header)[1];
  const shape = extents.split(",").filter((n) => n.trim()).map((n) => parseInt(n));
  const count = shape.reduce((a, b) => a * b, 1), fortran = /'fortran_order':\s*True/.test(header);
  const [, order, kind, digits] = /^'([<>|=]?)([a-zA-Z])(\d*)/.exec(descr) ?? ["", "", "V", ""];  // several fields
  const type = /'\|?O/.test(descr) ? "O" : kind + digits, size = Number(digits) * (kind === "U" ? 4 : 1);
  if (type !== "O" && !(at + count * size <= view.byteLength)) return null;
  const elements = new DataView(data.buffer, data.byteOffset + at, data.byteLength - at);
  return { type, dtype: dtypeName(descr, order, kind, digits), size, little: order !== ">", shape, count, fortran, view: elements };
}

function dtypeName(descr, order, kind, digits) {
  if (kind === "b") return "bool";
  return KINDS[kind] && order !== ">" ? KINDS[kind] + 8 * digits : descr.replace(/^'(.*)'$/, "$1");
}

/** `values` in C order, from Fortran's. */
function inRows(values, { shape, count, fortran }) {
  if (!fortran) return values;
  return values.map((_, k) => {
    let rest = k, index = 0, stride = count;
    for (let axis = shape.length - 1; axis >= 0; axis--) {
      stride /= shape[axis];
      index += (rest % shape[axis]) * stride;
      rest = Math.floor(rest / shape[axis]);
    }
    return values[index];
  });
}

function readNumbers({ type, little, count, view }) {
  const [size, read] = READERS[type], numbers = new Float64Array(count);
  for (let k = 0; k < count; k++) numbers[k] = read(view, k * size, little);
  return numbers;
}

/** A half float: sign, five bits of exponent, ten of fraction. */
function half(bits) {
  const exponent = bits >> 10 & 31, fraction = bits & 1023, sign = bits >> 15 ? -1 : 1;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
}

/** Strings without padding; null for invalid code points. */
function readStrings({ type, size, little, count, view }) {
  const decoder = new TextDecoder("utf-8", { ignoreBOM: true });
  return Array.from({ length: count }, (_, k) => {
    if (type[0] === "S") return decoder.decode(new Uint8Array(view.buffer, view.byteOffset + k * size, size)).replace(/\0+$/, "");
    const codes = Array.from({ length: size / 4 }, (_, c) => view.getUint32(k * size + 4 * c, little));
    return codes.every(isCharacter) ? codes.map((code) => String.fromCodePoint(code)).join("").replace(/\0+$/, "") : null;
  });
}

const isCharacter = (code) => code < 0xd800 || (code > 0xdfff && code <= 0x10ffff);
