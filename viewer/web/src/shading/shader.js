// Relighting posed Gaussians: the modes of rnd_runtime/shading/shader.py.

import { buildAmbient, shadeAmbient } from "./ambient.js";
import { allTexels, medianCut, shadeLights } from "./sum.js";
import { rotate } from "../rotations.js";
import { addSuns } from "./shadow.js";
import { buildSky, shadeSky } from "./tables.js";
import { extractSuns } from "./sun.js";

/**
 * The shader of a light and the mode `shade`: a function (gaussians, count, eye, lightToRoot, covarianceScale) → radiance [count·3];
 * `covarianceScale` scales covariances.
 */
export function makeShader(light, shade) {
  const { sky, suns } = shade === "table+sun" ? extractSuns(light) : { sky: light, suns: [] };
  const [prepared, shadeUnder] = prepare(sky, shade);
  return (gaussians, count, eye, lightToRoot, covarianceScale) => {
    const radiance = new Float32Array(3 * count);
    shadeUnder(prepared, gaussians, count, eye, lightToRoot, radiance);
    const rotated = suns.map((sun) => ({ ...sun, direction: rotate(lightToRoot, sun.direction) }));
    addSuns(rotated, gaussians, count, eye, covarianceScale, radiance);
    return radiance;
  };
}

function prepare(light, shade) {
  if (shade === "ao") return [buildAmbient(light), shadeAmbient];
  if (shade.startsWith("table")) return [buildSky(light), shadeSky];
  return [shade === "brute" ? allTexels(light) : medianCut(light, Number(shade.split(":")[1])), shadeLights];
}
