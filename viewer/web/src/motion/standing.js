// The up axis of a motion whose file does not state it, from how the trunk stands (rnd_runtime/motion/standing.py).

import { CLEAR, LEG, LIES, SHARE, STANDS, UNCLEAR } from "../constants.js";

/** {axis, a key of UP_ROTATIONS, and notes} of trunks and hips [F][3] in the file's world, whose layout has `assumed` up. */
export function upAxis(trunks, hips, assumed) {
  const mean = [0, 1, 2].map((k) => trunks.reduce((sum, trunk) => sum + trunk[k], 0) / trunks.length);
  const along = mean.reduce((best, value, k) => (Math.abs(value) > Math.abs(mean[best]) ? k : best), 0);
  const sign = mean[along] < 0 ? -1 : 1, found = (sign < 0 ? "-" : "") + "xyz"[along], up = "xyz".indexOf(assumed);
  if (mean[up] > UNCLEAR || Math.abs(mean[along]) < CLEAR || found === assumed) return { axis: assumed, notes: [] };
  const heights = hips.map((place) => place[up] / LEG), stands = quantile(hips.map((place) => sign * place[along] / LEG), 0.5);
  const [low, high] = [SHARE, 1 - SHARE].map((share) => quantile(heights, share));
  if (LIES[0] < low && high < LIES[1] && !(STANDS[0] < stands && stands < STANDS[1])) {
    const overrule = found === "y" || found === "z" ? `; --motion-up ${found} overrules` : "";
    return { axis: assumed, notes: [`the trunk lies along ${found}, and ${assumed} stays up, as in its layout${overrule}`] };
  }
  return { axis: found, notes: [`${found} is taken for up, as the trunk stands along it; --motion-up ${assumed} overrules`] };
}

/** Linear interpolation between the values in order, as numpy's. */
function quantile(values, share) {
  const sorted = [...values].sort((a, b) => a - b), at = share * (sorted.length - 1), below = Math.floor(at);
  const above = Math.min(below + 1, sorted.length - 1);
  return sorted[below] + (at - below) * (sorted[above] - sorted[below]);
}
