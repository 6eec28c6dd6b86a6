// Gaussians → records and lists of Gaussians by tile (rnd_runtime/raster/project.py, tiles.py).

import { ALPHA_MIN, DILATION, FIELD_OF_VIEW_MARGIN, HALF_LOG2_E, LOG2_ALPHA_MIN, NEAR, RADIX_BITS } from "../constants.js";

export const ROW_GAUSSIANS = 512, ROW_PAIRS = 2048, TILE = 4;
export const TEXELS = 3;  // whole and broken part of the centre less ½; shear, fall_y, fall_x, peak; three attributes

const HALF = 0.5 * (TILE - 1), LEAST = LOG2_ALPHA_MIN - 1e-3;  // no tile is lost to rounding
const DIGITS = 1 << RADIX_BITS;

/**
 * Inputs of the shader in complete rows: `records` [rows·ROW_GAUSSIANS·TEXELS·4], `pairs` (Gaussians by tile, front to
 * back), `tiles` [columns·rows·2] (first and last + 1 of its pairs). `features` [N·3]; `covarianceScale` scales covariances.
 * Gaussians with numbers that are not finite, without extent, or with n·v below `cull` are skipped: NaN fails every guard.
 */
export function project({ means, covariances, opacities, normals }, count, features, camera, covarianceScale, cull) {
  const { rotation: r, translation: t, position: eye, focal, centre: [cx, cy], width, height } = camera;
  const marginX = FIELD_OF_VIEW_MARGIN * 0.5 * width / focal, marginY = FIELD_OF_VIEW_MARGIN * 0.5 * height / focal;
  const leftX = -cx / focal - marginX, rightX = (width - cx) / focal + marginX;
  const topY = -cy / focal - marginY, bottomY = (height - cy) / focal + marginY;
  const records = new Float32Array(wholeRows(count, ROW_GAUSSIANS) * TEXELS * 4);
  const boxes = new Int32Array(4 * count), depths = new Float64Array(count), drawn = new Int32Array(count);
  let visible = 0;
  for (let i = 0; i < count; i++) {
    const mx = means[3 * i], my = means[3 * i + 1], mz = means[3 * i + 2], opacity = opacities[i];
    const x = r[0] * mx + r[1] * my + r[2] * mz + t[0], y = r[3] * mx + r[4] * my + r[5] * mz + t[1];
    const z = r[6] * mx + r[7] * my + r[8] * mz + t[2];
    const trace = covariances[6 * i] + covariances[6 * i + 3] + covariances[6 * i + 5];
    if (!(z >= NEAR && z < Infinity && opacity >= ALPHA_MIN && opacity < Infinity && trace > 0 && trace < Infinity)) continue;
    const awayX = eye[0] - mx, awayY = eye[1] - my, awayZ = eye[2] - mz;
    const along = awayX * normals[3 * i] + awayY * normals[3 * i + 1] + awayZ * normals[3 * i + 2];
    if (along < cull * Math.sqrt(awayX * awayX + awayY * awayY + awayZ * awayZ)) continue;
    const slopeX = Math.min(Math.max(x / z, leftX), rightX), slopeY = Math.min(Math.max(y / z, topY), bottomY);
    const scale = focal / z;
    const a0 = scale * (r[0] - slopeX * r[6]), a1 = scale * (r[1] - slopeX * r[7]), a2 = scale * (r[2] - slopeX * r[8]);
    const b0 = scale * (r[3] - slopeY * r[6]), b1 = scale * (r[4] - slopeY * r[7]), b2 = scale * (r[5] - slopeY * r[8]);
    const k = 6 * i, xx = covarianceScale * covariances[k], xy = covarianceScale * covariances[k + 1], xz = covarianceScale * covariances[k + 2];
    const yy = covarianceScale * covariances[k + 3], yz = covarianceScale * covariances[k + 4], zz = covarianceScale * covariances[k + 5];
    const sa0 = xx * a0 + xy * a1 + xz * a2, sa1 = xy * a0 + yy * a1 + yz * a2, sa2 = xz * a0 + yz * a1 + zz * a2;
    const sb0 = xx * b0 + xy * b1 + xz * b2, sb1 = xy * b0 + yy * b1 + yz * b2, sb2 = xz * b0 + yz * b1 + zz * b2;
    const pxx = a0 * sa0 + a1 * sa1 + a2 * sa2 + DILATION, pxy = b0 * sa0 + b1 * sa1 + b2 * sa2;
    const pyy = b0 * sb0 + b1 * sb1 + b2 * sb2 + DILATION, shear = pxy / pyy, conditional = pxx - pxy * shear;
    if (!(pyy > 0 && conditional > 0 && pxx < Infinity && pyy < Infinity)) continue;
    const centerX = focal * x / z + cx, centerY = focal * y / z + cy, peak = Math.log2(opacity);
    const reach = Math.max(peak - LOG2_ALPHA_MIN, 0) / HALF_LOG2_E;  // 2·ln(255·opacity)
    const reachX = Math.sqrt(reach * pxx) - 0.499, reachY = Math.sqrt(reach * pyy) - 0.499;  // to the last pixel centre
    const left = Math.max(centerX - reachX, 0), right = Math.min(centerX + reachX, width - 1);
    const top = Math.max(centerY - reachY, 0), bottom = Math.min(centerY + reachY, height - 1);
    if (!(left < width && top < height && right >= 0 && bottom >= 0)) continue;
    if (Math.floor(left) > Math.floor(right) || Math.floor(top) > Math.floor(bottom)) continue;
    if (!Number.isFinite(features[3 * i] + features[3 * i + 1] + features[3 * i + 2])) continue;
    boxes[4 * i] = left / TILE;  // truncated to integers
    boxes[4 * i + 1] = top / TILE;
    boxes[4 * i + 2] = right / TILE;
    boxes[4 * i + 3] = bottom / TILE;
    const column = Math.floor(centerX - 0.5), row = Math.floor(centerY - 0.5), at = 4 * TEXELS * i;
    records[at] = column;
    records[at + 1] = row;
    records[at + 2] = centerX - 0.5 - column;
    records[at + 3] = centerY - 0.5 - row;
    records[at + 4] = shear;
    records[at + 5] = HALF_LOG2_E / pyy;
    records[at + 6] = HALF_LOG2_E / conditional;
    records[at + 7] = peak;
    for (let c = 0; c < 3; c++) records[at + 8 + c] = features[3 * i + c];
    depths[i] = z;
    drawn[visible++] = i;
  }
  return { records, ...sortIntoTiles(frontToBack(depths, drawn.subarray(0, visible)), boxes, records, width, height) };
}

/** Counting sort of the (Gaussian, tile) pairs into tiles, in the order of `order` within each. */
function sortIntoTiles(order, boxes, records, width, height) {
  const columns = Math.ceil(width / TILE), rows = Math.ceil(height / TILE), tiles = new Uint32Array(2 * columns * rows);
  let total = 0, most = 0;
  for (const i of order) most += (boxes[4 * i + 2] - boxes[4 * i] + 1) * (boxes[4 * i + 3] - boxes[4 * i + 1] + 1);
  const reached = new Uint32Array(most), counts = new Uint32Array(order.length);
  for (let place = 0; place < order.length; place++) {
    const i = order[place], at = 4 * TEXELS * i, before = total, shear = records[at + 4], peak = records[at + 7];
    const x = records[at] + records[at + 2] - HALF, y = records[at + 1] + records[at + 3] - HALF;
    const fallY = records[at + 5], fallX = records[at + 6], slack = HALF * (1 + Math.abs(shear));
    const left = boxes[4 * i], right = boxes[4 * i + 2], last = boxes[4 * i + 3];
    for (let row = boxes[4 * i + 1]; row <= last; row++) {
      // whether α may reach 1/255 in the tile: pixels are within HALF of its centre
      const dy = TILE * row - y, v = Math.max(Math.abs(dy) - HALF, 0), lost = fallY * v * v, middle = x + shear * dy;
      for (let column = left, tile = row * columns + left; column <= right; column++, tile++) {
        const u = Math.max(Math.abs(TILE * column - middle) - slack, 0);
        if (peak - lost - fallX * u * u >= LEAST) {
          reached[total++] = tile;
          tiles[2 * tile + 1]++;
        }
      }
    }
    counts[place] = total - before;
  }
  for (let tile = 0, start = 0; tile < tiles.length; tile += 2) {
    const count = tiles[tile + 1];
    tiles[tile] = tiles[tile + 1] = start;
    start += count;
  }
  const pairs = new Uint32Array(wholeRows(total, ROW_PAIRS));
  for (let place = 0, pair = 0; place < order.length; place++)
    for (const last = pair + counts[place]; pair < last; pair++) pairs[tiles[2 * reached[pair] + 1]++] = order[place];
  return { pairs, tiles, columns };
}

const wholeRows = (count, row) => Math.max(Math.ceil(count / row), 1) * row;

/** `drawn` by depth: a stable radix sort of 32-bit keys over the visible range. */
function frontToBack(depths, drawn) {
  let near = Infinity, far = -Infinity;
  for (const i of drawn) {
    near = Math.min(near, depths[i]);
    far = Math.max(far, depths[i]);
  }
  const scale = far > near ? 4294967295 / (far - near) : 0;
  let order = drawn, other = new Int32Array(drawn.length);
  let keys = new Uint32Array(drawn.length), otherKeys = new Uint32Array(drawn.length);
  for (let k = 0; k < drawn.length; k++) keys[k] = (depths[drawn[k]] - near) * scale;
  for (let shift = 0; shift < 32; shift += RADIX_BITS) {
    const starts = new Int32Array(DIGITS + 1);
    for (const key of keys) starts[((key >>> shift) & (DIGITS - 1)) + 1]++;
    for (let digit = 0; digit < DIGITS; digit++) starts[digit + 1] += starts[digit];
    for (let k = 0; k < order.length; k++) {
      const place = starts[(keys[k] >>> shift) & (DIGITS - 1)]++;
      otherKeys[place] = keys[k];
      other[place] = order[k];
    }
    [keys, otherKeys, order, other] = [otherKeys, keys, other, order];
  }
  return order;
}
