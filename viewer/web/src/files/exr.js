// OpenEXR images ("OpenEXR File Layout", Academy Software Foundation): headers are checked for what parse-exr supports.

import parseExr from "parse-exr";
import { refusal } from "../errors.js";

const MAGIC = 20000630, TILED = 0x200, DEEP = 0x800, PARTS = 0x1000;
const FLOAT_TYPE = 1015;  // parse-exr's name for 32-bit floats
const UINT = 0, HALF = 1, DECREASING_Y = 1;
const COMPRESSIONS = ["none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"];
const BLOCK_LINES = { none: 1, RLE: 1, ZIPS: 1, ZIP: 16, PIZ: 32, PXR24: 16, DWAA: 32, DWAB: 256 };  // supported ones

/**
 * {height, width, radiance: Float32Array [H·W·3], half, chromaticities} of one flat image with channels R, G and B;
 * chromaticities [8]: x and y of red, green, blue and white, if given.
 */
export function readExr(file) {
  const bytes = file.slice(), header = readHeader(bytes);
  check(header);
  if (header.lineOrder === DECREASING_Y && !header.tiled) turnOver(bytes, header);
  const { width, height, data } = parseExr(bytes.buffer, FLOAT_TYPE);
  const channels = data.length / (width * height), radiance = new Float32Array(width * height * 3);
  for (let row = 0; row < height; row++)  // parse-exr's rows run bottom to top
    for (let column = 0; column < width; column++)
      for (let c = 0; c < 3; c++)
        radiance[3 * (row * width + column) + c] = data[channels * ((height - 1 - row) * width + column) + c];
  const half = header.channels.find(({ name }) => name === "R").type === HALF;
  return { width, height, radiance, half, chromaticities: header.chromaticities };
}

/** The header: {tiled, flat, channels, chromaticities, compression, lineOrder, lineOrderAt, data and canvas windows, end}. */
function readHeader(bytes) {
  const view = new DataView(bytes.buffer), decoder = new TextDecoder("latin1");
  if (bytes.length < 8 || view.getUint32(0, true) !== MAGIC) throw refusal("light probe", { expected: "an OpenEXR file" });
  const flags = view.getUint32(4, true), header = { tiled: !!(flags & TILED), flat: !(flags & (DEEP | PARTS)), channels: [] };
  let at = 8;
  const number = () => view.getInt32((at += 4) - 4, true);
  const word = () => {
    const end = bytes.indexOf(0, at);
    if (end < 0) throw refusal("the .exr file is cut short");
    const text = decoder.decode(bytes.subarray(at, end));
    at = end + 1;
    return text;
  };
  const readers = {
    channels: (end) => {
      while (at < end - 1) header.channels.push({ name: word(), type: number(), sampling: (at += 4, [number(), number()]) });
    },
    chromaticities: (end) => {
      if (end - at === 4 * 8) header.chromaticities = Array.from({ length: 8 }, () => view.getFloat32((at += 4) - 4, true));
    },
    compression: () => { header.compression = COMPRESSIONS[bytes[at]] ?? `number ${bytes[at]}`; },
    dataWindow: () => { header.data = [number(), number(), number(), number()]; },
    displayWindow: () => { header.canvas = [number(), number(), number(), number()]; },
    lineOrder: () => { header.lineOrder = bytes[header.lineOrderAt = at]; },
  };
  try {
    for (let name = word(); name; name = word()) {
      word();  // its type
      const end = number() + at;
      if (end < at) throw refusal("the .exr file is damaged");  // a negative size would loop forever
      readers[name]?.(end);
      at = end;
    }
  } catch (error) {
    throw error instanceof RangeError ? refusal("the .exr file is cut short") : error;
  }
  return { ...header, end: at };
}

function check({ flat, channels, compression, data, canvas }) {
  const names = channels.map(({ name }) => name), own = channels.filter(({ name }) => /^[RGBA]$/.test(name));
  if (!["R", "G", "B"].every((name) => names.includes(name)))
    throw refusal("light probe", { expected: "channels R, G and B, of no layer", got: names.join(", ") || "none" });
  if (!flat || String(data) !== String(canvas)) {
    const got = flat ? `pixels ${data} of canvas ${canvas}` : "a deep one, or several";
    throw refusal("image layout", { expected: "one flat image that fills its canvas", got });
  }
  const odd = channels.find(({ type, sampling }) => type === UINT || sampling.some((step) => step !== 1));
  if (odd || own.some(({ type }) => type !== own[0].type)) {
    const got = odd ? `${odd.name} of ${odd.type === UINT ? "whole numbers" : "every other pixel"}` : "both";
    throw refusal("pixels", { expected: "half or float in all channels", got });
  }
  if (!BLOCK_LINES[compression])
    throw refusal("compression", { expected: Object.keys(BLOCK_LINES).join(", "), got: compression });
}

/** Reorder blocks of lines stored bottom to top into the order of the file's table, which is top to bottom. */
function turnOver(bytes, { data: [, top, , bottom], compression, end, lineOrderAt }) {
  const view = new DataView(bytes.buffer), count = Math.ceil((bottom - top + 1) / BLOCK_LINES[compression]);
  const stored = bytes.slice();
  let to = end + 8 * count;
  for (let block = 0; block < count; block++) {
    const from = end + 8 * block + 8 <= bytes.length ? Number(view.getBigUint64(end + 8 * block, true)) : bytes.length;
    if (from + 8 > bytes.length) throw refusal("the .exr file is cut short");
    const length = 8 + new DataView(stored.buffer).getInt32(from + 4, true);
    if (length < 8 || from + length > bytes.length || to + length > bytes.length) throw refusal("the .exr file is cut short");
    bytes.set(stored.subarray(from, from + length), to);
    to += length;
  }
  bytes[lineOrderAt] = 0;
}
