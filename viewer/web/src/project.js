// Gaussians → records for the splatting shader, back to front (rnd_runtime/_raster_project.py, raster_gl.py).

export const ROW_GAUSSIANS = 1024, TEXELS = 3;  // centre, reach, peak; shape; three attributes

const NEAR = 0.1, DILATION = 0.3, MARGIN = 0.3, HALF_LOG2_E = 0.5 * Math.LOG2E, LOG2_255 = Math.log2(255);
const RADIX = 11, DIGITS = 1 << RADIX;

/** Records as the shaders read them: {data: Float32Array, count, rows}. `features` [N·3]; `grown` scales covariances. */
export function project({ means, covariances, opacities }, count, features, camera, grown) {
  const { rotation: r, translation: t, focal, width, height } = camera;
  const limitX = (0.5 + MARGIN * 0.5) * width / focal, limitY = (0.5 + MARGIN * 0.5) * height / focal;
  const splats = new Float32Array(7 * count), depths = new Float64Array(count), drawn = new Int32Array(count);
  let visible = 0;
  for (let i = 0; i < count; i++) {
    const mx = means[3 * i], my = means[3 * i + 1], mz = means[3 * i + 2], opacity = opacities[i];
    const x = r[0] * mx + r[1] * my + r[2] * mz + t[0], y = r[3] * mx + r[4] * my + r[5] * mz + t[1];
    const z = r[6] * mx + r[7] * my + r[8] * mz + t[2];
    if (!(z >= NEAR && z < Infinity && opacity >= 1 / 255)) continue;
    const slopeX = Math.min(Math.max(x / z, -limitX), limitX), slopeY = Math.min(Math.max(y / z, -limitY), limitY);
    const scale = focal / z;
    const a0 = scale * (r[0] - slopeX * r[6]), a1 = scale * (r[1] - slopeX * r[7]), a2 = scale * (r[2] - slopeX * r[8]);
    const b0 = scale * (r[3] - slopeY * r[6]), b1 = scale * (r[4] - slopeY * r[7]), b2 = scale * (r[5] - slopeY * r[8]);
    const k = 6 * i, xx = grown * covariances[k], xy = grown * covariances[k + 1], xz = grown * covariances[k + 2];
    const yy = grown * covariances[k + 3], yz = grown * covariances[k + 4], zz = grown * covariances[k + 5];
    const sa0 = xx * a0 + xy * a1 + xz * a2, sa1 = xy * a0 + yy * a1 + yz * a2, sa2 = xz * a0 + yz * a1 + zz * a2;
    const sb0 = xx * b0 + xy * b1 + xz * b2, sb1 = xy * b0 + yy * b1 + yz * b2, sb2 = xz * b0 + yz * b1 + zz * b2;
    const pxx = a0 * sa0 + a1 * sa1 + a2 * sa2 + DILATION, pxy = b0 * sa0 + b1 * sa1 + b2 * sa2;
    const pyy = b0 * sb0 + b1 * sb1 + b2 * sb2 + DILATION, shear = pxy / pyy, conditional = pxx - pxy * shear;
    if (!(pyy > 0 && conditional > 0 && pxx < Infinity && pyy < Infinity)) continue;
    const centerX = focal * x / z + width / 2, centerY = focal * y / z + height / 2, peak = Math.log2(opacity);
    const reach = Math.sqrt(Math.max(peak + LOG2_255, 0));
    const reachX = reach * Math.sqrt(pxx / HALF_LOG2_E), reachY = reach * Math.sqrt(pyy / HALF_LOG2_E);
    if (!(centerX + reachX > 0 && centerX - reachX < width && centerY + reachY > 0 && centerY - reachY < height)) continue;
    splats.set([centerX, centerY, reach, peak, Math.sqrt(HALF_LOG2_E / conditional), Math.sqrt(HALF_LOG2_E / pyy), shear], 7 * i);
    depths[i] = z;
    drawn[visible++] = i;
  }
  const rows = Math.ceil(visible / ROW_GAUSSIANS), data = new Float32Array(rows * ROW_GAUSSIANS * TEXELS * 4);
  frontToBack(depths, drawn.subarray(0, visible)).forEach((i, place) => {
    const at = (visible - 1 - place) * TEXELS * 4;
    for (let c = 0; c < 7; c++) data[at + c] = splats[7 * i + c];
    for (let c = 0; c < 3; c++) data[at + 8 + c] = features[3 * i + c];
  });
  return { data, count: visible, rows };
}

/** `drawn` by depth: a stable radix sort of 32-bit keys that span just the visible range. */
function frontToBack(depths, drawn) {
  let near = Infinity, far = -Infinity;
  for (const i of drawn) {
    near = Math.min(near, depths[i]);
    far = Math.max(far, depths[i]);
  }
  const scale = far > near ? 4294967295 / (far - near) : 0;
  let order = drawn, other = new Int32Array(drawn.length);
  let keys = Uint32Array.from(drawn, (i) => (depths[i] - near) * scale), otherKeys = new Uint32Array(drawn.length);
  for (let shift = 0; shift < 32; shift += RADIX) {
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
