// Suns: a hard shadow from a depth map splatted from the Gaussians (rnd_runtime/shadow.py), and their own shading.

import { clampRoughness, ggx } from "./brdf.js";

const RESOLUTION = 384, DISC_SIGMAS = 1.4, CASTING_OPACITY = 0.5;
const CLEARANCE = 1, CLEARANCE_TEXELS = 0.35, COSINE_FLOOR = 0.1;

/** Add to `radiance` [count·3] what `suns` ({direction in the world, irradiance, spread}) lay on the Gaussians. */
export function addSuns(suns, gaussians, count, eye, grown, radiance) {
  const radii = discRadii(gaussians, count, grown);
  for (const sun of suns) shadeSun(sun, gaussians, count, eye, sunVisibility(sun.direction, gaussians, count, radii), radiance);
}

/** Disc radius [count] m of each Gaussian in a depth map; `grown`: by how much its covariance is multiplied. */
function discRadii({ covariances, opacities }, count, grown) {
  return Float32Array.from({ length: count }, (_, i) => opacities[i] > CASTING_OPACITY
    ? DISC_SIGMAS * Math.sqrt(grown * (covariances[6 * i] + covariances[6 * i + 3] + covariances[6 * i + 5]) / 2) : 0);
}

function sunVisibility(direction, { means, normals }, count, radii) {
  const frame = frameOf(direction), position = new Float32Array(3 * count), normal = new Float32Array(3 * count);
  const visibility = new Float32Array(count), lower = [Infinity, Infinity], upper = [-Infinity, -Infinity];
  for (let i = 0; i < count; i++)
    for (let axis = 0; axis < 3; axis++) {
      const [fx, fy, fz] = frame[axis], k = 3 * i + axis;
      position[k] = fx * means[3 * i] + fy * means[3 * i + 1] + fz * means[3 * i + 2];
      normal[k] = fx * normals[3 * i] + fy * normals[3 * i + 1] + fz * normals[3 * i + 2];
      if (axis < 2) {
        lower[axis] = Math.min(lower[axis], position[k]);
        upper[axis] = Math.max(upper[axis], position[k]);
      }
    }
  const extent = Math.max(upper[0] - lower[0], upper[1] - lower[1]);
  const texel = (extent > 0 ? extent : 1) / (RESOLUTION - 3);  // centres at integers, one empty row all around
  const width = Math.floor((upper[0] - lower[0]) / texel) + 3, height = Math.floor((upper[1] - lower[1]) / texel) + 3;
  const map = { depth: new Float32Array(width * height).fill(-Infinity), width, height, texel };
  for (let i = 0; i < count; i++) {
    if (!(normal[3 * i + 2] > 0)) continue;
    position[3 * i] = (position[3 * i] - lower[0]) / texel + 1;
    position[3 * i + 1] = (position[3 * i + 1] - lower[1]) / texel + 1;
    if (radii[i] > 0) drawDisc(map, position, normal, 3 * i, radii[i]);
  }
  for (let i = 0; i < count; i++) if (normal[3 * i + 2] > 0) visibility[i] = lookUp(map, position, normal, 3 * i, radii[i]);
  return visibility;
}

/** Two axes across `direction` and the direction itself. */
function frameOf(direction) {
  const z = direction, sizes = z.map(Math.abs);
  const helper = [0, 0, 0];
  helper[sizes.indexOf(Math.min(...sizes))] = 1;
  const x = cross(helper, z), length = Math.hypot(...x), unit = x.map((value) => value / length);
  return [unit, cross(z, unit), z];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function drawDisc({ depth, width, height, texel }, position, normal, k, radius) {
  const x = position[k], y = position[k + 1], z = position[k + 2], reach = radius / texel;
  const scale = -texel / Math.max(normal[k + 2], COSINE_FLOOR), slopeX = normal[k] * scale, slopeY = normal[k + 1] * scale;
  const right = Math.min(Math.floor(x + reach) + 1, width), bottom = Math.min(Math.floor(y + reach) + 1, height);
  for (let row = Math.max(Math.ceil(y - reach), 0); row < bottom; row++)
    for (let column = Math.max(Math.ceil(x - reach), 0); column < right; column++) {
      const dx = column - x, dy = row - y, rise = slopeX * dx + slopeY * dy, at = row * width + column;
      if ((dx * dx + dy * dy) * texel * texel + rise * rise <= radius * radius && z + rise > depth[at]) depth[at] = z + rise;
    }
}

/** Bilinear share of the four texels around a point in which nothing rises above its plane. */
function lookUp({ depth, width, texel }, position, normal, k, radius) {
  const x = position[k], y = position[k + 1], z = position[k + 2], steep = Math.max(normal[k + 2], COSINE_FLOOR);
  const slopeX = -texel * normal[k] / steep, slopeY = -texel * normal[k + 1] / steep;
  const clearance = Math.max(CLEARANCE * radius, CLEARANCE_TEXELS * texel) / steep;
  const column = Math.floor(x), row = Math.floor(y);
  let lit = 0;
  for (let corner = 0; corner < 4; corner++) {
    const c = column + (corner & 1), r = row + (corner >> 1), dx = c - x, dy = r - y;
    if (!(depth[r * width + c] > z + slopeX * dx + slopeY * dy + clearance)) lit += (1 - Math.abs(dx)) * (1 - Math.abs(dy));
  }
  return Math.min(lit, 1);
}

/** Lambert and GGX under one sun, whose disc widens the highlight (shading.py, _add_suns). */
function shadeSun(sun, { means, normals, albedo, roughness }, count, eye, visibility, radiance) {
  const [lx, ly, lz] = sun.direction, spread = sun.spread ** 2;
  for (let i = 0; i < count; i++) {
    const nx = normals[3 * i], ny = normals[3 * i + 1], nz = normals[3 * i + 2];
    const nDotL = nx * lx + ny * ly + nz * lz, arriving = visibility[i] * nDotL;
    if (!(arriving > 0)) continue;
    let vx = eye[0] - means[3 * i], vy = eye[1] - means[3 * i + 1], vz = eye[2] - means[3 * i + 2];
    const distance = Math.max(Math.hypot(vx, vy, vz), 1e-12);
    vx /= distance;
    vy /= distance;
    vz /= distance;
    const hx = lx + vx, hy = ly + vy, hz = lz + vz, halfSquared = Math.max(hx * hx + hy * hy + hz * hz, 1e-12);
    const cx = ny * hz - nz * hy, cy = nz * hx - nx * hz, cz = nx * hy - ny * hx;
    const sineSquared = (cx * cx + cy * cy + cz * cz) / halfSquared;
    const alpha = clampRoughness(roughness[i]) ** 2;
    const shine = ggx(Math.min(alpha * alpha + spread / Math.sqrt(halfSquared), 1), nDotL, nx * vx + ny * vy + nz * vz,
      sineSquared, halfSquared);
    for (let c = 0; c < 3; c++) radiance[3 * i + c] += arriving * (albedo[3 * i + c] / Math.PI + shine) * sun.irradiance[c];
  }
}
