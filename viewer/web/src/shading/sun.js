// Separation of a light probe into sky and suns (rnd_runtime/shading/directional.py): sky + suns = map.

import { median } from "../arrays.js";
import { CAP, LAMP, LARGEST, MIN_SHARE, MAX_PEAKS, RING, RING_AREA } from "../constants.js";
import { downsize, luminance, texelDirections, texelSolidAngles } from "./light.js";

const LIMIT = 2;  // suns

/** {sky: light, suns: [{direction, irradiance, spread}]}, strongest first. */
export function extractSuns(light) {
  const map = light.height > LARGEST[0] ? downsize(light, ...LARGEST) : light;
  const { height, width } = map, radiance = Float64Array.from(map.radiance);
  const angles = texelSolidAngles(height, width), directions = texelDirections(height, width);
  const bright = new Float64Array(height * width);  // luminance, -Infinity at rejected peaks
  let total = 0;
  for (let k = 0; k < height * width; k++) {
    bright[k] = luminance(radiance[3 * k], radiance[3 * k + 1], radiance[3 * k + 2]);
    total += bright[k] * angles[Math.floor(k / width)];
  }
  const suns = [], least = MIN_SHARE * total;
  for (let tried = 0; tried < MAX_PEAKS && suns.length < LIMIT; tried++) {
    let peak = 0;
    for (let k = 1; k < height * width; k++) if (bright[k] > bright[peak]) peak = k;
    if (!(bright[peak] * RING_AREA >= least)) break;
    const [x, y, z] = directions.subarray(3 * peak, 3 * peak + 3);
    const found = peakAround({ radiance, directions, angles, height, width }, [x, y, z]);
    if (!found) break;
    if (!(luminance(...found.sun.irradiance) >= Math.max(least, 1e-30))) {
      if (found.sun.spread > LAMP) break;
      for (let k = 0; k < height * width; k++)
        if (directions[3 * k] * x + directions[3 * k + 1] * y + directions[3 * k + 2] * z > Math.cos(CAP)) bright[k] = -Infinity;
      continue;
    }
    for (const [k, ...value] of found.sky) {
      radiance.set(value, 3 * k);
      bright[k] = Math.min(bright[k], luminance(...value));
    }
    suns.push(found.sun);
  }
  suns.sort((a, b) => luminance(...b.irradiance) - luminance(...a.irradiance));
  return { sky: { ...map, radiance: Float32Array.from(radiance) }, suns };
}

/** The peak near `centre` above its surroundings, and the texels [index, r, g, b] without it. */
function peakAround({ radiance, directions, angles, height, width }, centre) {
  let sun = null, sky = [];
  for (let pass = 0; pass < 3; pass++) {  // the brightest texel is not the centre of a lamp
    const inside = [], ring = [[], [], []];
    const polar = Math.acos(Math.min(Math.max(centre[1], -1), 1));
    const first = Math.max(Math.floor((polar - RING) / Math.PI * height), 0);
    const last = Math.min(Math.ceil((polar + RING) / Math.PI * height) + 1, height);
    for (let k = first * width; k < last * width; k++) {
      const cosine = directions[3 * k] * centre[0] + directions[3 * k + 1] * centre[1] + directions[3 * k + 2] * centre[2];
      if (cosine > Math.cos(CAP)) inside.push(k);
      else if (cosine > Math.cos(RING)) for (let c = 0; c < 3; c++) ring[c].push(radiance[3 * k + c]);
    }
    if (!inside.length || !ring[0].length) return null;  // the map is too coarse for a sun
    const background = ring.map(median);
    const irradiance = [0, 0, 0], mean = [0, 0, 0];
    let weights = 0;
    sky = inside.map((k) => {
      const left = [0, 1, 2].map((c) => Math.fround(Math.min(radiance[3 * k + c], background[c])));
      const flux = left.map((value, c) => (radiance[3 * k + c] - value) * angles[Math.floor(k / width)]);
      const weight = luminance(...flux);
      for (let c = 0; c < 3; c++) {
        irradiance[c] += flux[c];
        mean[c] += weight * directions[3 * k + c];
      }
      weights += weight;
      return [k, ...left];
    });
    const length = Math.hypot(...mean);
    if (!(length > 0)) return null;
    centre = mean.map((value) => value / length);
    sun = { direction: centre, irradiance, spread: Math.sqrt(Math.max(2 * (1 - length / weights), 0)) };
  }
  return { sun, sky };
}
