// GGX with Smith's separable masking and Schlick, metallic 0 (rnd_runtime/shading/brdf.py).

import { COSINE_FLOOR, F0, ROUGHNESS_RANGE } from "../constants.js";

export const clampRoughness = (roughness) => Math.min(Math.max(roughness, ROUGHNESS_RANGE[0]), ROUGHNESS_RANGE[1]);

/** Share of the specular term that Gaussian `i` of `albedo` keeps: black is a cavity, or crushed by the camera. */
export const specularShare = (albedo, i) =>
  Math.min(Math.max(albedo[3 * i], albedo[3 * i + 1], albedo[3 * i + 2]) / F0, 1);

/** D·F·G / (4 n·l n·v) from α², cosines, sin²θ_h and |l + v|². */
export function ggx(alphaSquared, nDotL, nDotV, sineSquared, halfSquared) {
  const lobe = sineSquared + alphaSquared * (1 - sineSquared);
  const l = Math.max(nDotL, COSINE_FLOOR), v = Math.max(nDotV, COSINE_FLOOR);
  const shadowing = l + Math.sqrt(alphaSquared + (1 - alphaSquared) * l * l);
  const masking = v + Math.sqrt(alphaSquared + (1 - alphaSquared) * v * v);
  const grazing = Math.max(1 - 0.5 * Math.sqrt(halfSquared), 0), squared = grazing * grazing;
  const fresnel = F0 + (1 - F0) * squared * squared * grazing;
  return alphaSquared * fresnel / (Math.PI * lobe * lobe * shadowing * masking);
}
