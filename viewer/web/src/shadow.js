// Suns: a hard shadow from a depth map splatted from the Gaussians (rnd_runtime/shadow.py), and their own shading.

import { clampRoughness, ggx } from "./brdf.js";

const RESOLUTION = 384, DISC_SIGMAS = 1.4, CASTING_OPACITY = 0.5;
const TURNED_AWAY = -0.2, AT_SILHOUETTE = 0;  // n·v over which suns fade out on what faces away (shading.py)
const CLEARANCE_TEXELS = Math.fround(0.35), COSINE_FLOOR = Math.fround(0.1);  // and of a disc's radius, once

/** Add to `radiance` [count·3] what `suns` ({direction in the root's frame, irradiance, spread}) lay on the Gaussians. */
export function addSuns(suns, gaussians, count, eye, grown, radiance) {
  const radii = suns.length ? discRadii(gaussians, count, grown) : null;
  for (const sun of suns) shadeSun(sun, gaussians, count, eye, sunVisibility(sun.direction, gaussians, count, radii), radiance);
}

// Whether a texel lies inside a disc, and whether something rises above a plane, are yes or no: every step that leads to
// such an answer is rounded to 32 bits where rnd_runtime rounds it, else some answers differ, and a pixel with them.
const f = Math.fround, sum3 = (a, b, c) => f(f(a + b) + c);

/** Disc radius [count] m of each Gaussian in a depth map; `grown`: by how much its covariance is multiplied. */
function discRadii({ covariances, opacities }, count, grown) {
  const factor = f(grown), variance = (k) => f(factor * covariances[k]);
  return Float32Array.from({ length: count }, (_, i) => opacities[i] > CASTING_OPACITY
    ? DISC_SIGMAS * Math.sqrt(sum3(variance(6 * i), variance(6 * i + 3), variance(6 * i + 5)) / 2) : 0);
}

/** Visibility [count]; a Gaussian with a number that is not finite neither casts nor receives. */
function sunVisibility(direction, { means, normals }, count, radii) {
  const frame = frameOf(direction), position = new Float32Array(3 * count), normal = new Float32Array(3 * count);
  const visibility = new Float32Array(count), lower = [Infinity, Infinity], upper = [-Infinity, -Infinity];
  for (let i = 0; i < count; i++) {
    const mx = means[3 * i], my = means[3 * i + 1], mz = means[3 * i + 2];
    const nx = normals[3 * i], ny = normals[3 * i + 1], nz = normals[3 * i + 2];
    if (!Number.isFinite(mx + my + mz + nx + ny + nz + radii[i])) continue;  // its normal stays 0, which faces no light
    for (let axis = 0; axis < 3; axis++) {
      const [fx, fy, fz] = frame[axis], k = 3 * i + axis;
      position[k] = sum3(f(fx * mx), f(fy * my), f(fz * mz));
      normal[k] = sum3(f(fx * nx), f(fy * ny), f(fz * nz));
      if (axis < 2) {
        lower[axis] = Math.min(lower[axis], position[k]);
        upper[axis] = Math.max(upper[axis], position[k]);
      }
    }
  }
  const spans = [0, 1].map((axis) => f(Math.max(upper[axis] - lower[axis], 0))), extent = Math.max(...spans);
  const texel = f((extent > 0 ? extent : 1) / (RESOLUTION - 3));  // centres at integers, one empty row all around
  const [width, height] = spans.map((span) => Math.floor(f(span / texel)) + 3);
  const map = { depth: new Float32Array(width * height).fill(-Infinity), width, height, texel };
  for (let i = 0; i < count; i++) {
    if (!(normal[3 * i + 2] > 0)) continue;
    for (let axis = 0; axis < 2; axis++) position[3 * i + axis] = f(f(position[3 * i + axis] - lower[axis]) / texel) + 1;
    if (radii[i] > 0) drawDisc(map, position, normal, 3 * i, radii[i]);
  }
  for (let i = 0; i < count; i++) if (normal[3 * i + 2] > 0) visibility[i] = lookUp(map, position, normal, 3 * i, radii[i]);
  return visibility;
}

/** Two axes across `direction` and the direction itself. */
function frameOf(direction) {
  const z = unit(direction.map(f)), sizes = z.map(Math.abs), helper = [0, 0, 0];
  helper[sizes.indexOf(Math.min(...sizes))] = 1;
  const x = unit(cross(helper, z));
  return [x, cross(z, x), z];
}

function unit(v) {
  const length = f(Math.sqrt(sum3(f(v[0] * v[0]), f(v[1] * v[1]), f(v[2] * v[2]))));
  return v.map((value) => f(value / length));
}

function cross(a, b) {
  const minor = (i, j) => f(f(a[i] * b[j]) - f(a[j] * b[i]));
  return [minor(1, 2), minor(2, 0), minor(0, 1)];
}

/** Rise of a point's tangent plane towards the light, in metres a texel, along x and y. */
function slopes(normal, k, texel) {
  const scale = f(-texel / Math.max(normal[k + 2], COSINE_FLOOR));
  return [f(normal[k] * scale), f(normal[k + 1] * scale)];
}

function drawDisc({ depth, width, height, texel }, position, normal, k, radius) {
  const x = position[k], y = position[k + 1], z = position[k + 2], reach = f(radius / texel), square = f(radius * radius);
  const [slopeX, slopeY] = slopes(normal, k, texel);
  const right = Math.min(Math.floor(f(x + reach)) + 1, width), bottom = Math.min(Math.floor(f(y + reach)) + 1, height);
  for (let row = Math.max(Math.ceil(f(y - reach)), 0); row < bottom; row++)
    for (let column = Math.max(Math.ceil(f(x - reach)), 0); column < right; column++) {
      const dx = f(column - x), dy = f(row - y), rise = f(f(slopeX * dx) + f(slopeY * dy)), at = row * width + column;
      const across = f(f(f(f(dx * dx) + f(dy * dy)) * texel) * texel);
      if (f(across + f(rise * rise)) <= square && f(z + rise) > depth[at]) depth[at] = z + rise;
    }
}

/** Bilinear share of the four texels around a point in which nothing rises above its plane. */
function lookUp({ depth, width, texel }, position, normal, k, radius) {
  const x = position[k], y = position[k + 1], z = position[k + 2], [slopeX, slopeY] = slopes(normal, k, texel);
  const clearance = f(Math.max(radius, f(CLEARANCE_TEXELS * texel)) / Math.max(normal[k + 2], COSINE_FLOOR));
  const column = Math.floor(x), row = Math.floor(y);
  let lit = 0;
  for (let corner = 0; corner < 4; corner++) {
    const c = column + (corner & 1), r = row + (corner >> 1), dx = f(c - x), dy = f(r - y);
    const plane = f(sum3(z, f(slopeX * dx), f(slopeY * dy)) + clearance);
    if (!(depth[r * width + c] > plane)) lit += (1 - Math.abs(dx)) * (1 - Math.abs(dy));
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
    const nDotV = nx * vx + ny * vy + nz * vz;
    const facing = Math.min((nDotV - TURNED_AWAY) / (AT_SILHOUETTE - TURNED_AWAY), 1);
    if (!(facing > 0)) continue;
    const cx = ny * hz - nz * hy, cy = nz * hx - nx * hz, cz = nx * hy - ny * hx;
    const sineSquared = (cx * cx + cy * cy + cz * cz) / halfSquared;
    const alpha = clampRoughness(roughness[i]) ** 2;
    const shine = ggx(Math.min(alpha * alpha + spread / Math.sqrt(halfSquared), 1), nDotL, nDotV, sineSquared, halfSquared);
    for (let c = 0; c < 3; c++) radiance[3 * i + c] += facing * arriving * (albedo[3 * i + c] / Math.PI + shine) * sun.irradiance[c];
  }
}
