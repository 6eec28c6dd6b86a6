// .npz archives: zip (fflate) of .npy, numbers and strings only.

import { unzipSync } from "fflate";

const READERS = {
  f8: [8, (view, at) => view.getFloat64(at, true)], f4: [4, (view, at) => view.getFloat32(at, true)],
  i8: [8, (view, at) => Number(view.getBigInt64(at, true))], i4: [4, (view, at) => view.getInt32(at, true)],
  i2: [2, (view, at) => view.getInt16(at, true)], i1: [1, (view, at) => view.getInt8(at)],
  u1: [1, (view, at) => view.getUint8(at)], b1: [1, (view, at) => view.getUint8(at)],
};

/** {name: {shape, numbers: Float64Array} | {shape, strings}} of the members that hold numbers or strings. */
export function readNpz(bytes) {
  const members = {};
  for (const [name, data] of Object.entries(unzipSync(bytes))) {
    const array = name.endsWith(".npy") ? readNpy(data) : null;
    if (array) members[name.slice(0, -4)] = array;
  }
  return members;
}

function readNpy(data) {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const long = view.getUint8(6) > 1;  // format version
  const start = long ? 12 : 10;
  const length = long ? view.getUint32(8, true) : view.getUint16(8, true);
  const header = new TextDecoder().decode(data.subarray(start, start + length));
  const type = /'descr':\s*'([^']*)'/.exec(header)?.[1];
  const shape = (/'shape':\s*\(([^)]*)\)/.exec(header)?.[1] ?? "").split(",").filter((n) => n.trim()).map(Number);
  if (!type || type[0] === ">" || header.includes("'fortran_order': True")) return null;
  const count = shape.reduce((a, b) => a * b, 1), kind = type.slice(1);
  const at = start + length;
  if (kind[0] === "U" || kind[0] === "S") return { shape, strings: readStrings(view, at, count, kind) };
  const reader = READERS[kind];
  if (!reader || at + count * reader[0] > view.byteLength) return null;
  return { shape, numbers: Float64Array.from({ length: count }, (_, k) => reader[1](view, at + k * reader[0])) };
}

function readStrings(view, at, count, kind) {
  const length = Number(kind.slice(1)), wide = kind[0] === "U";
  return Array.from({ length: count }, (_, k) => {
    let text = "";
    for (let c = 0; c < length; c++) {
      const code = wide ? view.getUint32(at + 4 * (k * length + c), true) : view.getUint8(at + k * length + c);
      if (code) text += String.fromCodePoint(code);
    }
    return text;
  });
}
