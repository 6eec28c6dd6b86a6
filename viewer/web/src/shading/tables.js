// Shading by tables over the normal that depend on the light alone (rnd_runtime/shading/lookup.py).

import { DIFFUSE_SIZE as DIFFUSE, LOBE_WIDTHS, PROBE_SHAPE, SH_DEGREES, SPECULAR_SIZE as SPECULAR } from "../constants.js";
import { specularShare } from "./brdf.js";
import { downsize, texelDirections, texelSolidAngles } from "./light.js";
import { lobeAt } from "./lobe.js";
import { transposed } from "../rotations.js";
import { shBasis, shRotation } from "./sh.js";

/** {diffuse [33²·3·16], specular [7·49²·3]} of a light. */
export function buildSky(light) {
  const [height, width] = PROBE_SHAPE, count = height * width;
  const { radiance } = downsize(light, height, width);
  const directions = texelDirections(height, width), angles = texelSolidAngles(height, width);
  const weighted = new Float64Array(count * 48), basis = new Float64Array(16), flux = new Float64Array(count * 4);
  for (let k = 0; k < count; k++) {
    const angle = angles[Math.floor(k / width)];
    shBasis(directions[3 * k], directions[3 * k + 1], directions[3 * k + 2], basis);
    flux[4 * k] = angle;
    for (let c = 0; c < 3; c++) {
      flux[4 * k + 1 + c] = radiance[3 * k + c] * angle;
      for (let j = 0; j < 16; j++) weighted[48 * k + 16 * c + j] = flux[4 * k + 1 + c] * basis[j];
    }
  }
  return { diffuse: diffuseTable(directions, weighted), specular: specularTable(directions, flux) };
}

function diffuseTable(directions, weighted) {
  const nodes = octahedralNodes(DIFFUSE), table = new Float32Array(DIFFUSE * DIFFUSE * 48), sum = new Float64Array(48);
  for (let i = 0; i < DIFFUSE * DIFFUSE; i++) {
    sum.fill(0);
    for (let k = 0; 3 * k < directions.length; k++) {
      const cosine = nodes[3 * i] * directions[3 * k] + nodes[3 * i + 1] * directions[3 * k + 1] + nodes[3 * i + 2] * directions[3 * k + 2];
      if (cosine > 0) for (let j = 0; j < 48; j++) sum[j] += cosine * weighted[48 * k + j];
    }
    table.set(sum, 48 * i);
  }
  return table;
}

function specularTable(directions, flux) {
  const nodes = octahedralNodes(SPECULAR), count = SPECULAR * SPECULAR;
  const table = new Float32Array(LOBE_WIDTHS.length * count * 3), cosines = new Float64Array(directions.length / 3);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < cosines.length; k++)
      cosines[k] = nodes[3 * i] * directions[3 * k] + nodes[3 * i + 1] * directions[3 * k + 1] + nodes[3 * i + 2] * directions[3 * k + 2];
    LOBE_WIDTHS.forEach((width, level) => {
      let total = 0, red = 0, green = 0, blue = 0;
      for (let k = 0; k < cosines.length; k++) {
        const away = 1 + width - cosines[k], weight = 1 / (away * away);
        total += weight * flux[4 * k];
        red += weight * flux[4 * k + 1];
        green += weight * flux[4 * k + 2];
        blue += weight * flux[4 * k + 3];
      }
      table.set([red / total, green / total, blue / total], 3 * (level * count + i));
    });
  }
  return table;
}

/** Unit directions [size²·3] of the nodes of an octahedral grid. */
function octahedralNodes(size) {
  const nodes = new Float64Array(3 * size * size);
  for (let row = 0; row < size; row++)
    for (let column = 0; column < size; column++) {
      const a = -1 + 2 * column / (size - 1), b = -1 + 2 * row / (size - 1), c = 1 - Math.abs(a) - Math.abs(b);
      const fold = Math.max(-c, 0), x = a - (a >= 0 ? fold : -fold), y = b - (b >= 0 ? fold : -fold);
      const length = Math.hypot(x, y, c);
      nodes.set([x / length, y / length, c / length], 3 * (row * size + column));
    }
  return nodes;
}

/** Cell of the octahedral grid for a direction, and the position in it, into `out`: node, s, t. */
function octahedralCell(x, y, z, size, out) {
  const scale = 1 / Math.max(Math.abs(x) + Math.abs(y) + Math.abs(z), 1e-12);
  let a = x * scale, b = y * scale;
  if (z < 0) [a, b] = [(1 - Math.abs(b)) * (a >= 0 ? 1 : -1), (1 - Math.abs(a)) * (b >= 0 ? 1 : -1)];
  a = (a + 1) / 2 * (size - 1);
  b = (b + 1) / 2 * (size - 1);
  const column = Math.min(Math.max(Math.floor(a), 0), size - 2), row = Math.min(Math.max(Math.floor(b), 0), size - 2);
  out[0] = row * size + column;
  out[1] = a - column;
  out[2] = b - row;
}

/** Radiance [count·3] towards `eye` under `sky`, rotated by the 3×3 `lightToRoot`. */
export function shadeSky(sky, gaussians, count, eye, lightToRoot, radiance) {
  const { means, normals, albedo, roughness, visibility } = gaussians, r = lightToRoot;
  const diffuse = rotated(sky.diffuse, shRotation(transposed(r))), { specular } = sky;
  const n = [0, 0, 0], v = [0, 0, 0], lobe = new Float64Array(8), basis = new Float64Array(16);
  const cell = new Float64Array(3), node = new Float64Array(3), mapSize = 3 * SPECULAR * SPECULAR;
  for (let i = 0; i < count; i++) {
    const dx = eye[0] - means[3 * i], dy = eye[1] - means[3 * i + 1], dz = eye[2] - means[3 * i + 2];
    const distance = Math.max(Math.sqrt(dx * dx + dy * dy + dz * dz), 1e-12);
    for (let k = 0; k < 3; k++) {
      n[k] = r[k] * normals[3 * i] + r[3 + k] * normals[3 * i + 1] + r[6 + k] * normals[3 * i + 2];
      v[k] = (r[k] * dx + r[3 + k] * dy + r[6 + k] * dz) / distance;
    }
    lobeAt(roughness[i], n[0] * v[0] + n[1] * v[1] + n[2] * v[2], n, v, lobe);
    const mx = lobe[1], my = lobe[2], mz = lobe[3], level = lobe[4];
    shBasis(r[0] * mx + r[1] * my + r[2] * mz, r[3] * mx + r[4] * my + r[5] * mz, r[6] * mx + r[7] * my + r[8] * mz, basis);
    let visible = visibility[16 * i] * basis[0];  // averaged over the lobe
    for (let j = 1; j < 16; j++) visible += lobe[4 + SH_DEGREES[j]] * visibility[16 * i + j] * basis[j];
    const reflected = lobe[0] * specularShare(albedo, i) * Math.max(visible, 0);
    const low = Math.min(Math.floor(level), LOBE_WIDTHS.length - 2), up = level - low;
    octahedralCell(mx, my, mz, SPECULAR, cell);
    octahedralCell(n[0], n[1], n[2], DIFFUSE, node);
    const s = node[1], t = node[2], w00 = (1 - s) * (1 - t), w01 = s * (1 - t), w10 = (1 - s) * t, w11 = s * t;
    let a = node[0] * 48, b = a + 48, c = a + DIFFUSE * 48, d = c + 48;  // the cell's corners
    for (let channel = 0; channel < 3; channel++) {
      const corner = 3 * cell[0] + channel + low * mapSize;
      const lower = bilinear(specular, corner, cell[1], cell[2]), upper = bilinear(specular, corner + mapSize, cell[1], cell[2]);
      const specularRadiance = reflected * (lower + up * (upper - lower));
      let irradiance = 0;
      for (let j = 16 * i; j < 16 * i + 16; j++)
        irradiance += visibility[j] * (w00 * diffuse[a++] + w01 * diffuse[b++] + w10 * diffuse[c++] + w11 * diffuse[d++]);
      radiance[3 * i + channel] = Math.max(albedo[3 * i + channel] / Math.PI * irradiance + specularRadiance, 0);
    }
  }
}

function bilinear(table, corner, s, t) {
  const top = table[corner] + s * (table[corner + 3] - table[corner]), next = corner + 3 * SPECULAR;
  return top + t * (table[next] + s * (table[next + 3] - table[next]) - top);
}

/** The diffuse tables for SH coefficients in the root's frame: rows times `rotation` [16·16], by degrees. */
function rotated(diffuse, rotation) {
  const result = new Float32Array(diffuse.length);
  for (let degree = 0; degree < 4; degree++) {
    const first = degree * degree, last = first + 2 * degree + 1;
    for (let row = 0; row < diffuse.length; row += 16)
      for (let target = first; target < last; target++) {
        let sum = 0;
        for (let source = first; source < last; source++) sum += diffuse[row + source] * rotation[16 * source + target];
        result[row + target] = sum;
      }
  }
  return result;
}
