// A light of sixteen SH coefficients times each Gaussian's occlusion (rnd_runtime/shading/ambient.py).

import { COSINE_LOBE, PROBE_SHAPE, SH_DEGREES } from "../constants.js";
import { specularShare } from "./brdf.js";
import { downsize, texelDirections, texelSolidAngles } from "./light.js";
import { lobeAt } from "./lobe.js";
import { shBasis, shRotation } from "./sh.js";

/** SH coefficients [16·3] of a light's radiance. */
export function buildAmbient(light) {
  const [height, width] = PROBE_SHAPE, { radiance } = downsize(light, height, width);
  const directions = texelDirections(height, width), angles = texelSolidAngles(height, width);
  const coefficients = new Float64Array(48), basis = new Float64Array(16);
  for (let k = 0; k < height * width; k++) {
    shBasis(directions[3 * k], directions[3 * k + 1], directions[3 * k + 2], basis);
    for (let j = 0; j < 16; j++)
      for (let c = 0; c < 3; c++) coefficients[3 * j + c] += radiance[3 * k + c] * angles[Math.floor(k / width)] * basis[j];
  }
  return coefficients;
}

/** Radiance [count·3] towards `eye` under the coefficients, rotated by the 3×3 `lightToRoot`. */
export function shadeAmbient(coefficients, { means, normals, albedo, roughness, visibility }, count, eye, lightToRoot, radiance) {
  const light = times(shRotation(lightToRoot), coefficients), lobe = new Float64Array(8);
  const atNormal = new Float64Array(16), atLobe = new Float64Array(16), n = [0, 0, 0], v = [0, 0, 0];
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) {
      n[k] = normals[3 * i + k];
      v[k] = eye[k] - means[3 * i + k];
    }
    const distance = Math.max(Math.hypot(...v), 1e-12);
    for (let k = 0; k < 3; k++) v[k] /= distance;
    lobeAt(roughness[i], n[0] * v[0] + n[1] * v[1] + n[2] * v[2], n, v, lobe);
    shBasis(...n, atNormal);
    shBasis(lobe[1], lobe[2], lobe[3], atLobe);
    let occlusion = 0;
    for (let j = 0; j < 9; j++) {
      atNormal[j] *= COSINE_LOBE[j];
      occlusion += atNormal[j] * visibility[16 * i + j];
    }
    const energy = lobe[0] * specularShare(albedo, i);
    for (let c = 0; c < 3; c++) {
      let diffuse = 0, specular = 0;
      for (let j = 0; j < 16; j++) {
        specular += (j < 1 ? 1 : lobe[4 + SH_DEGREES[j]]) * atLobe[j] * light[3 * j + c];
        if (j < 9) diffuse += atNormal[j] * light[3 * j + c];
      }
      radiance[3 * i + c] = Math.max(occlusion, 0) * (albedo[3 * i + c] * Math.max(diffuse, 0) + energy * Math.max(specular, 0));
    }
  }
}

/** M [16·16] times coefficients [16·3]. */
function times(matrix, coefficients) {
  const result = new Float64Array(48);
  for (let i = 0; i < 16; i++)
    for (let j = 0; j < 16; j++)
      for (let c = 0; c < 3; c++) result[3 * i + c] += matrix[16 * i + j] * coefficients[3 * j + c];
  return result;
}
