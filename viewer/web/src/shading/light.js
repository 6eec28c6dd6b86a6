// Lat-long, linear light probes: read, repair, downsize (rnd_runtime/shading/light.py, shading/files/load.py).

import { COARSE, DIM, MAX_EXPOSURE, REC709, REC709_LUMINANCE, SAME_COLOUR } from "../constants.js";
import { refusal, short } from "../errors.js";
import { readExr } from "../files/exr.js";

const LARGEST_FLOAT = 3.4028234663852886e38, LARGEST_HALF = 65504;
const RGBE = "FORMAT=32-bit_rle_rgbe";

const [LUMA_R, LUMA_G, LUMA_B] = REC709_LUMINANCE;
export const luminance = (r, g, b) => LUMA_R * r + LUMA_G * g + LUMA_B * b;

/** {height, width, radiance: Float32Array [H·W·3], cut, repaired, chromaticities} of an .exr or .hdr file. */
export function readLight(bytes, name) {
  const image = name.toLowerCase().endsWith(".exr") ? readExr(bytes) : readHdr(bytes);
  if (image.width !== 2 * image.height) throw new Error(`${name}: expected a 2:1 lat-long map, got ${image.width} x ${image.height}`);
  return repair({ ...image, name, cut: image.half ? limitHalf(image.radiance) : 0 });
}

/** Notes on a light for the user. */
export function lightNotes({ radiance, cut, repaired, chromaticities, exposure = 1 }) {
  const notes = [];
  if (exposure !== 1) notes.push(`the light's pixels are divided by the exposure that its file states, ${short(exposure, 4)}`);
  if (chromaticities?.some((value, k) => !(Math.abs(value - REC709[k]) <= SAME_COLOUR))) {
    const [red, green, blue, white] = [0, 2, 4, 6].map((k) => `(${short(chromaticities[k], 4)}, ${short(chromaticities[k + 1], 4)})`);
    notes.push(`the light is taken as Rec.709, but its file states red ${red}, green ${green}, blue ${blue} and white ${white}`);
  }
  if (cut) notes.push(`${cut} texels of the light were infinite and are taken as ${LARGEST_HALF}, HALF's largest number: a sun was cut`);
  if (repaired) notes.push(`${repaired} texels of the light were NaN, infinite or negative and were filled in`);
  if (radiance.every((value) => value < DIM)) {
    const largest = radiance.reduce((a, b) => Math.max(a, b), 0);
    notes.push(`the light is dark: its largest radiance is ${short(largest, 3)}; try --exposure`);
  }
  return notes;
}

/** Radiance's RGBE, run-length coded or flat (Ward 1991, "Real Pixels"). */
function readHdr(bytes) {
  let at = 0;
  const line = () => {
    const end = bytes.indexOf(10, at);
    if (end < 0) throw new Error("the .hdr file has no header");
    const text = new TextDecoder("latin1").decode(bytes.subarray(at, end));
    at = end + 1;
    return text.replace(/\r$/, "");
  };
  if (!line().startsWith("#?")) throw new Error("not a Radiance .hdr file");
  let exposure = 1, chromaticities;
  for (let text = line(); text !== ""; text = line()) {
    if (/^FORMAT=/.test(text) && text !== RGBE) throw refusal("the .hdr file", { expected: RGBE, got: text });
    const [name, value = ""] = text.split("="), numbers = value.trim().split(/\s+/).map((word) => Number(word || NaN));
    if (name === "EXPOSURE") exposure *= numbers.length === 1 ? numbers[0] : NaN;
    if (name === "PRIMARIES" && numbers.length === 8 && numbers.every(Number.isFinite) && numbers.some(Boolean))
      chromaticities = numbers;  // zeros are ignored
  }
  if (!(exposure >= 1 / MAX_EXPOSURE && exposure <= MAX_EXPOSURE)) {
    const expected = `numbers whose product is ${short(1 / MAX_EXPOSURE, 6)} to ${short(MAX_EXPOSURE, 6)}`;
    throw refusal("EXPOSURE of the light probe", { expected, got: short(exposure, 6) });
  }
  const size = /^-Y (\d+) \+X (\d+)/.exec(line());
  if (!size) throw new Error("the .hdr file must be stored top to bottom, left to right");
  const height = Number(size[1]), width = Number(size[2]);
  const radiance = new Float32Array(width * height * 3), row = new Uint8Array(4 * width);
  for (let y = 0; y < height; y++) {
    at = readScanline(bytes, at, width, row);
    for (let x = 0; x < width; x++) {
      const exponent = row[3 * width + x];
      const scale = exponent ? 2 ** (exponent - 136) : 0;  // mantissas are 0.x in 256ths, exponents start at 128
      for (let c = 0; c < 3; c++) radiance[3 * (y * width + x) + c] = row[c * width + x] * scale / exposure;
    }
  }
  return { width, height, radiance, chromaticities, exposure };
}

/** Read one scanline into `row`, by planes; returns the offset of the next one. */
function readScanline(bytes, at, width, row) {
  const coded = bytes[at] === 2 && bytes[at + 1] === 2 && bytes[at + 2] * 256 + bytes[at + 3] === width;
  const need = (count) => { if (at + count > bytes.length) throw new Error("the .hdr file is cut short"); };
  if (!coded) {
    need(4 * width);
    for (let x = 0; x < width; x++) for (let c = 0; c < 4; c++) row[c * width + x] = bytes[at + 4 * x + c];
    return at + 4 * width;
  }
  at += 4;
  for (let filled = 0; filled < 4 * width;) {
    need(2);
    const code = bytes[at++], run = code > 128, length = run ? code - 128 : code;
    if (filled + length > 4 * width)
      throw refusal("the .hdr file", { expected: "runs that end with their line", got: "a longer one" });
    if (run) row.fill(bytes[at++], filled, filled + length);
    else {
      need(length);
      row.set(bytes.subarray(at, at += length), filled);
    }
    filled += length;
  }
  return at;
}

/** Replace +inf in `radiance` of half floats by the largest of them; in how many texels. */
function limitHalf(radiance) {
  const texels = new Set();
  radiance.forEach((value, k) => {
    if (value !== Infinity) return;
    radiance[k] = LARGEST_HALF;
    texels.add(Math.floor(k / 3));
  });
  return texels.size;
}

/** Fill NaN, infinite and negative values from their valid neighbours, from the rim of holes inwards. */
function repair(light) {
  const { height, width, radiance } = light;
  const invalid = (value) => !(value >= 0 && value <= LARGEST_FLOAT);
  let holes = [];
  radiance.forEach((value, k) => { if (invalid(value)) holes.push(k); });
  light.repaired = new Set(holes.map((k) => Math.floor(k / 3))).size;
  while (holes.length) {
    const filled = [];
    for (const k of holes) {
      const c = k % 3, x = Math.floor(k / 3) % width, y = Math.floor(k / 3 / width);
      let total = 0, count = 0;
      for (let dy = -1; dy <= 1; dy++)
        for (let dx = -1; dx <= 1; dx++) {
          const row = Math.min(Math.max(y + dy, 0), height - 1), column = (x + dx + width) % width;
          const value = radiance[3 * (row * width + column) + c];
          if (!invalid(value)) { total += value; count += 1; }
        }
      if (count) filled.push([k, total / count]);
    }
    if (!filled.length) throw new Error(`${light.name}: no valid radiance in some channel`);
    for (const [k, value] of filled) radiance[k] = value;
    const done = new Set(filled.map(([k]) => k));
    holes = holes.filter((k) => !done.has(k));
  }
  return light;
}

/** The mean of the bright parts, texels weighted by squared luminance: a unit vector in the light's frame. */
export function brightestDirection(light) {
  const { height, width, radiance } = downsize(light, ...COARSE);
  const directions = texelDirections(height, width), angles = texelSolidAngles(height, width), mean = [0, 0, 0];
  for (let k = 0; k < height * width; k++) {
    const luminance = REC709_LUMINANCE.reduce((sum, share, c) => sum + share * radiance[3 * k + c], 0);
    for (let c = 0; c < 3; c++) mean[c] += luminance ** 2 * angles[Math.floor(k / width)] * directions[3 * k + c];
  }
  const length = Math.max(Math.hypot(...mean), 1e-300);
  return mean.map((x) => x / length);
}

/** Radiance [3] towards `direction` in the light's frame, bilinear between texels (rnd_runtime/core/latlong.py). */
export function sampleLight({ height, width, radiance }, [x, y, z]) {
  const column = (0.5 + Math.atan2(z, x) / (2 * Math.PI)) * width - 0.5;
  const row = Math.min(Math.max(Math.atan2(Math.hypot(x, z), y) / Math.PI * height - 0.5, 0), height - 1);
  const left = Math.floor(column), top = Math.floor(row), s = column - left, t = row - top;
  const texel = (i, j, c) => radiance[3 * (Math.min(i, height - 1) * width + (j + width) % width) + c];
  const across = (i, c) => (1 - s) * texel(i, left, c) + s * texel(i, left + 1, c);
  return [0, 1, 2].map((c) => (1 - t) * across(top, c) + t * across(top + 1, c));
}

/** Unit directions [H·W·3] of all texels' centres in the light's frame. */
export function texelDirections(height, width) {
  const directions = new Float64Array(3 * height * width);
  for (let row = 0; row < height; row++)
    for (let column = 0; column < width; column++) {
      const polar = (row + 0.5) / height * Math.PI, azimuth = (column + 0.5) / width * 2 * Math.PI - Math.PI;
      const k = 3 * (row * width + column), ring = Math.sin(polar);
      directions[k] = ring * Math.cos(azimuth);
      directions[k + 1] = Math.cos(polar);
      directions[k + 2] = ring * Math.sin(azimuth);
    }
  return directions;
}

/** Solid angle [H] sr of a texel in each row, exact. */
export function texelSolidAngles(height, width) {
  return Float64Array.from({ length: height }, (_, row) =>
    (Math.cos(row / height * Math.PI) - Math.cos((row + 1) / height * Math.PI)) * 2 * Math.PI / width);
}

/** The light on another grid, each texel the mean over its solid angle; conserves energy. */
export function downsize(light, height, width) {
  const vertical = overlaps(edges(light.height, height, (t) => 1 - Math.cos(t * Math.PI)));
  const horizontal = overlaps(edges(light.width, width, (t) => t));
  const rows = new Float64Array(height * light.width * 3), result = new Float32Array(height * width * 3);
  vertical.forEach((parts, row) => {
    for (const [source, share] of parts)
      for (let k = 0; k < 3 * light.width; k++)
        rows[row * 3 * light.width + k] += share * light.radiance[source * 3 * light.width + k];
  });
  for (let row = 0; row < height; row++)
    horizontal.forEach((parts, column) => {
      for (let c = 0; c < 3; c++) {
        let sum = 0;
        for (const [source, share] of parts) sum += share * rows[3 * (row * light.width + source) + c];
        result[3 * (row * width + column) + c] = sum;
      }
    });
  return { ...light, height, width, radiance: result };
}

function edges(from, to, edgeAt) {
  return [from, to].map((count) => Float64Array.from({ length: count + 1 }, (_, k) => edgeAt(k / count)));
}

/** For each target interval, the covered source intervals and their shares. */
function overlaps([source, target]) {
  const parts = [];
  for (let k = 0, first = 0; k + 1 < target.length; k++) {
    const list = [];
    while (source[first + 1] <= target[k]) first++;
    for (let s = first; s + 1 < source.length && source[s] < target[k + 1]; s++) {
      const share = Math.min(source[s + 1], target[k + 1]) - Math.max(source[s], target[k]);
      if (share > 0) list.push([s, share / (target[k + 1] - target[k])]);
    }
    parts.push(list);
  }
  return parts;
}
