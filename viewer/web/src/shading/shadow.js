// Directional lights: hard shadows from a depth map of the Gaussians (rnd_runtime/shading/shadow.py), and their shading.

import {
  AT_SILHOUETTE, CASTING_OPACITY, DEPTH_BIAS, CLEARANCE_TEXELS, DISC_SIGMAS, DROP, EDGE_ON, RIM_TEXELS, SHADOW_RESOLUTION, SLOPE_FLOOR,
  SOFTNESS, TURNED_AWAY,
} from "../constants.js";
import { cross, unit } from "../rotations.js";
import { clampRoughness, ggx, specularShare } from "./brdf.js";

/** Add to `radiance` [count·3] that of `suns` ({direction in the root's frame, irradiance, spread}). */
export function addSuns(suns, gaussians, count, eye, covarianceScale, radiance) {
  const radii = suns.length ? discRadii(gaussians, count, covarianceScale) : null;
  for (const sun of suns) shadeSun(sun, gaussians, count, eye, sunVisibility(sun.direction, gaussians, count, radii), radiance);
}

/** Disc radius [count] m of each Gaussian in a depth map; `covarianceScale` scales covariances. */
export function discRadii({ covariances, opacities }, count, covarianceScale) {
  const radii = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    const trace = covarianceScale * (covariances[6 * i] + covariances[6 * i + 3] + covariances[6 * i + 5]);
    if (opacities[i] > CASTING_OPACITY) radii[i] = DISC_SIGMAS * Math.sqrt(trace / 2);
  }
  return radii;
}

/** Visibility [count]; Gaussians with numbers that are not finite neither cast nor receive. */
function sunVisibility(direction, { means, normals, detail = 1 }, count, radii) {
  const [x, y, z] = frameOf(direction), position = new Float32Array(3 * count), normal = new Float32Array(3 * count);
  const visibility = new Float32Array(count);
  let left = Infinity, right = -Infinity, low = Infinity, high = -Infinity;
  for (let i = 0; i < count; i++) {
    const mx = means[3 * i], my = means[3 * i + 1], mz = means[3 * i + 2];
    const nx = normals[3 * i], ny = normals[3 * i + 1], nz = normals[3 * i + 2];
    if (!Number.isFinite(mx + my + mz + nx + ny + nz + radii[i])) continue;  // its normal stays 0, which faces no light
    const across = x[0] * mx + x[1] * my + x[2] * mz, up = y[0] * mx + y[1] * my + y[2] * mz;
    position[3 * i] = across;
    position[3 * i + 1] = up;
    position[3 * i + 2] = z[0] * mx + z[1] * my + z[2] * mz;
    normal[3 * i] = x[0] * nx + x[1] * ny + x[2] * nz;
    normal[3 * i + 1] = y[0] * nx + y[1] * ny + y[2] * nz;
    normal[3 * i + 2] = z[0] * nx + z[1] * ny + z[2] * nz;
    left = Math.min(left, across);
    right = Math.max(right, across);
    low = Math.min(low, up);
    high = Math.max(high, up);
  }
  const spans = [right - left, high - low].map((span) => Math.max(span, 0)), extent = Math.max(...spans);
  const texel = (extent > 0 ? extent : 1) / (Math.round(SHADOW_RESOLUTION * detail) - 3);  // centres at integers, empty rows around, one for rounding
  const [width, height] = spans.map((span) => Math.floor(span / texel) + 4);
  const map = { depth: new Float32Array(width * height).fill(-Infinity), width, height, texel };
  for (let i = 0; i < count; i++) {
    if (!(normal[3 * i + 2] > 0)) continue;
    position[3 * i] = (position[3 * i] - left) / texel + 1;
    position[3 * i + 1] = (position[3 * i + 1] - low) / texel + 1;
    if (radii[i] > 0) rasterizeDisc(map, position, normal, 3 * i, radii[i]);
  }
  for (let i = 0; i < count; i++) if (normal[3 * i + 2] > 0) visibility[i] = visibilityAt(map, position, normal, 3 * i, radii[i]);
  return visibility;
}

/** Two axes across `direction` and the direction itself. */
function frameOf(direction) {
  const z = unit(direction), sizes = z.map((part) => Math.abs(Math.fround(part))), helper = [0, 0, 0];
  helper[sizes.indexOf(Math.min(...sizes))] = 1;
  const x = unit(cross(helper, z));
  return [x, cross(z, x), z];
}

/** Rise of a point's tangent plane towards the light, in metres a texel, along x and y. */
function slopes(normal, k, texel) {
  const scale = -texel / Math.max(normal[k + 2], SLOPE_FLOOR);
  return [normal[k] * scale, normal[k + 1] * scale];
}

function rasterizeDisc({ depth, width, height, texel }, position, normal, k, radius) {
  const x = position[k], y = position[k + 1], z = position[k + 2] - DROP * Math.max(1 - normal[k + 2] / EDGE_ON, 0);
  const cosine = Math.max(normal[k + 2], SLOPE_FLOOR), halfSize = radius / texel + RIM_TEXELS;
  const area = texel * texel, square = radius * radius;
  const fall = DROP / (halfSize * halfSize * area - square), [slopeX, slopeY] = slopes(normal, k, texel);
  const left = Math.max(Math.ceil(x - halfSize), 0), right = Math.min(Math.floor(x + halfSize) + 1, width);
  const bottom = Math.min(Math.floor(y + halfSize) + 1, height);
  for (let row = Math.max(Math.ceil(y - halfSize), 0); row < bottom; row++) {
    const dy = row - y, along = slopeY * dy, above = dy * dy * area - square;
    for (let column = left, at = row * width + left; column < right; column++, at++) {
      const dx = column - x, rise = slopeX * dx + along, beyond = dx * dx * area + above, outside = beyond + rise * rise;
      const plane = z + rise - fall * ((beyond > 0 ? beyond : 0) + (outside > 0 ? cosine * outside : 0));
      if (plane > depth[at]) depth[at] = plane;
    }
  }
}

/** Bilinear visibility of a point from the four texels around it; texels above its plane occlude it. */
function visibilityAt({ depth, width, texel }, position, normal, k, radius) {
  const x = position[k], y = position[k + 1], z = position[k + 2], [slopeX, slopeY] = slopes(normal, k, texel);
  const clearance = Math.max(DEPTH_BIAS * radius, CLEARANCE_TEXELS * texel) / Math.max(normal[k + 2], SLOPE_FLOOR);
  const top = z + (1 + SOFTNESS) * clearance, span = 1 / (2 * SOFTNESS * clearance);
  const column = Math.floor(x), row = Math.floor(y);
  let lit = 0;
  for (let corner = 0; corner < 4; corner++) {
    const c = column + (corner & 1), r = row + (corner >> 1), dx = c - x, dy = r - y;
    const open = (top + slopeX * dx + slopeY * dy - depth[r * width + c]) * span;
    lit += (1 - Math.abs(dx)) * (1 - Math.abs(dy)) * Math.min(Math.max(open, 0), 1);
  }
  return Math.min(lit, 1);
}

/** Lambert and GGX under one sun, whose disc widens the highlight (rnd_runtime/shading/direct.py). */
function shadeSun(sun, { means, normals, albedo, roughness }, count, eye, visibility, radiance) {
  const [lx, ly, lz] = sun.direction, spread = sun.spread ** 2;
  for (let i = 0; i < count; i++) {
    const nx = normals[3 * i], ny = normals[3 * i + 1], nz = normals[3 * i + 2];
    const nDotL = nx * lx + ny * ly + nz * lz, visibleCosine = visibility[i] * nDotL;
    if (!(visibleCosine > 0)) continue;
    let vx = eye[0] - means[3 * i], vy = eye[1] - means[3 * i + 1], vz = eye[2] - means[3 * i + 2];
    const distance = Math.max(Math.hypot(vx, vy, vz), 1e-12);
    vx /= distance;
    vy /= distance;
    vz /= distance;
    const hx = lx + vx, hy = ly + vy, hz = lz + vz, halfSquared = Math.max(hx * hx + hy * hy + hz * hz, 1e-12);
    const nDotV = nx * vx + ny * vy + nz * vz;
    const facing = Math.min((nDotV - TURNED_AWAY) / (AT_SILHOUETTE - TURNED_AWAY), 1);
    if (!(facing > 0)) continue;
    const cx = ny * hz - nz * hy, cy = nz * hx - nx * hz, cz = nx * hy - ny * hx;
    const sineSquared = (cx * cx + cy * cy + cz * cz) / halfSquared;
    const alpha = clampRoughness(roughness[i]) ** 2;
    const specular = ggx(Math.min(alpha * alpha + spread / Math.sqrt(halfSquared), 1), nDotL, nDotV, sineSquared, halfSquared);
    const reflected = specularShare(albedo, i) * specular;
    for (let c = 0; c < 3; c++) radiance[3 * i + c] += facing * visibleCosine * (albedo[3 * i + c] / Math.PI + reflected) * sun.irradiance[c];
  }
}
