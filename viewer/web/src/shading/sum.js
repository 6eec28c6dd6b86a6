// The sum over distant lights with the full BRDF and the visibility of each (rnd_runtime/shading/sum.py).

import { CUT_TEXELS, HALF_FLOOR, PROBE_SHAPE } from "../constants.js";
import { clampRoughness, ggx, specularShare } from "./brdf.js";
import { downsize, luminance, texelDirections, texelSolidAngles } from "./light.js";
import { rotate } from "../rotations.js";
import { shBasis } from "./sh.js";

/** Every texel of a light: {directions [K·3], flux [K·3]}. */
export function allTexels(light) {
  const { directions, flux } = gridOf(light, PROBE_SHAPE);
  return { directions, flux };
}

/** `count` lights of about equal luminance by median cut (Debevec 2005). */
export function medianCut(light, count) {
  const [height, width] = CUT_TEXELS, { directions, flux } = gridOf(light, CUT_TEXELS);
  const bright = Float64Array.from({ length: height * width }, (_, k) => luminance(flux[3 * k], flux[3 * k + 1], flux[3 * k + 2]));
  const total = summedArea(bright, height, width), done = [];
  const regions = [{ energy: total(height, width), top: 0, bottom: height, left: 0, right: width }];
  while (regions.length && regions.length + done.length < count) {
    const region = regions.splice(regions.reduce((best, one, k) => (one.energy > regions[best].energy ? k : best), 0), 1)[0];
    if (region.energy === 0 || (region.bottom - region.top) * (region.right - region.left) === 1) done.push(region);
    else regions.push(...halves(region, total, height, width));
  }
  const lights = [...done, ...regions].filter(({ energy }) => energy > 0);
  const result = { directions: new Float64Array(3 * lights.length), flux: new Float64Array(3 * lights.length) };
  lights.forEach(({ top, bottom, left, right }, light) => {
    const centroid = [0, 0, 0];
    for (let row = top; row < bottom; row++)
      for (let column = left; column < right; column++)
        for (let c = 0; c < 3; c++) {
          const k = row * width + column;
          centroid[c] += directions[3 * k + c] * bright[k];
          result.flux[3 * light + c] += flux[3 * k + c];
        }
    const length = Math.max(Math.hypot(...centroid), 1e-30);
    for (let c = 0; c < 3; c++) result.directions[3 * light + c] = centroid[c] / length;
  });
  return result;
}

function gridOf(light, [height, width]) {
  const { radiance } = downsize(light, height, width), angles = texelSolidAngles(height, width);
  const flux = Float64Array.from(radiance, (value, k) => value * angles[Math.floor(k / 3 / width)]);
  return { directions: texelDirections(height, width), flux };
}

/** Summed-area table: a function of (bottom, right). */
function summedArea(values, height, width) {
  const sums = new Float64Array((height + 1) * (width + 1)), at = (row, column) => sums[row * (width + 1) + column];
  for (let row = 1; row <= height; row++)  // down the columns, then along the rows
    for (let column = 1; column <= width; column++)
      sums[row * (width + 1) + column] = at(row - 1, column) + values[(row - 1) * width + column - 1];
  for (let row = 1; row <= height; row++)
    for (let column = 1; column <= width; column++) sums[row * (width + 1) + column] += at(row, column - 1);
  return at;
}

/** A region split at half its luminance, across the side that is longer on the sphere. */
function halves({ top, bottom, left, right }, total, height, width) {
  const wide = (right - left) / width * 2 * Math.sin((top + bottom) / 2 / height * Math.PI) > (bottom - top) / height;
  const upright = (wide && right - left > 1) || bottom - top === 1, [first, last] = upright ? [left, right] : [top, bottom];
  const along = (at) => (upright ? total(bottom, at) - total(top, at) : total(at, right) - total(at, left));
  const half = (along(first) + along(last)) / 2;
  let cut = first + 1;
  for (let at = first + 2; at < last; at++) if (Math.abs(along(at) - half) < Math.abs(along(cut) - half)) cut = at;
  const parts = upright ? [{ left, right: cut }, { left: cut, right }] : [{ top, bottom: cut }, { top: cut, bottom }];
  return parts.map((part) => {
    const region = { top, bottom, left, right, ...part };
    const sum = total(region.bottom, region.right) - total(region.top, region.right)
      - total(region.bottom, region.left) + total(region.top, region.left);
    return { ...region, energy: Math.max(sum, 0) };
  });
}

/** Radiance [count·3] towards `eye` under the lights, rotated by the 3×3 `lightToRoot`. */
export function shadeLights(lights, { means, normals, albedo, roughness, visibility }, count, eye, lightToRoot, radiance) {
  const K = lights.flux.length / 3, { flux } = lights, toward = new Float64Array(3 * K), basis = new Float64Array(16 * K);
  for (let k = 0; k < K; k++) {
    const l = rotate(lightToRoot, lights.directions.subarray(3 * k, 3 * k + 3));
    toward.set(l, 3 * k);
    shBasis(...l, basis.subarray(16 * k));
  }
  for (let i = 0; i < count; i++) {
    const nx = normals[3 * i], ny = normals[3 * i + 1], nz = normals[3 * i + 2];
    let vx = eye[0] - means[3 * i], vy = eye[1] - means[3 * i + 1], vz = eye[2] - means[3 * i + 2];
    const distance = Math.max(Math.hypot(vx, vy, vz), HALF_FLOOR);
    vx /= distance;
    vy /= distance;
    vz /= distance;
    const nDotV = nx * vx + ny * vy + nz * vz, alphaSquared = clampRoughness(roughness[i]) ** 4;
    const share = specularShare(albedo, i), diffuse = [0, 0, 0], specular = [0, 0, 0];
    for (let k = 0; k < K; k++) {
      const lx = toward[3 * k], ly = toward[3 * k + 1], lz = toward[3 * k + 2], nDotL = nx * lx + ny * ly + nz * lz;
      if (!(nDotL > 0)) continue;
      let visibleCosine = 0;
      for (let j = 0; j < 16; j++) visibleCosine += visibility[16 * i + j] * basis[16 * k + j];
      visibleCosine *= nDotL;
      const hx = lx + vx, hy = ly + vy, hz = lz + vz, halfSquared = Math.max(hx * hx + hy * hy + hz * hz, HALF_FLOOR);
      const cx = ny * hz - nz * hy, cy = nz * hx - nx * hz, cz = nx * hy - ny * hx;
      const reflected = visibleCosine * ggx(alphaSquared, nDotL, nDotV, (cx * cx + cy * cy + cz * cz) / halfSquared, halfSquared);
      for (let c = 0; c < 3; c++) {
        diffuse[c] += visibleCosine * flux[3 * k + c];
        specular[c] += reflected * flux[3 * k + c];
      }
    }
    for (let c = 0; c < 3; c++) radiance[3 * i + c] = Math.max(albedo[3 * i + c] / Math.PI * diffuse[c] + share * specular[c], 0);
  }
}
