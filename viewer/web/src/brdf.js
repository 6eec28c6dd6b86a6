// GGX with exact Smith and Schlick, metallic 0 (rnd_runtime/brdf.py).

export const ROUGHNESS_LOW = 0.09, ROUGHNESS_HIGH = 0.99;
const F0 = 0.04, COSINE_FLOOR = 1e-4;
export const LARGEST_ALBEDO = 1 - F0 - (1 - F0) / 21;

export const clampRoughness = (roughness) => Math.min(Math.max(roughness, ROUGHNESS_LOW), ROUGHNESS_HIGH);

/** D·F·G / (4 n·l n·v) from α², cosines, sin²θ_h and |l + v|². */
export function ggx(alphaSquared, nDotL, nDotV, sineSquared, halfSquared) {
  const lobe = sineSquared + alphaSquared * (1 - sineSquared);
  const l = Math.max(nDotL, COSINE_FLOOR), v = Math.max(nDotV, COSINE_FLOOR);
  const masking = l * Math.sqrt(alphaSquared + (1 - alphaSquared) * v * v);
  const shadowing = v * Math.sqrt(alphaSquared + (1 - alphaSquared) * l * l);
  const grazing = Math.max(1 - 0.5 * Math.sqrt(halfSquared), 0), squared = grazing * grazing;
  const fresnel = F0 + (1 - F0) * squared * squared * grazing;
  return 0.5 / Math.PI * alphaSquared * fresnel / (lobe * lobe * (masking + shadowing));
}
