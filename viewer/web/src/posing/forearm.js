// Distribution of forearm twists between elbow and wrist (formulas in rnd_runtime/posing/forearm.py).

import { FREE, MAX_SHARE } from "../constants.js";
import { axisAngleToMatrix, multiply, transposed, unit } from "../rotations.js";

const SIDES = ["left", "right"];

/** Twist the forearms of local rotations [J·9] and untwist their hands, in place. */
export function shareTwists({ names, parents, rest }, rotations) {
  for (const side of SIDES) {
    const elbow = names.indexOf(`${side}_elbow`), wrist = names.indexOf(`${side}_wrist`);
    if (elbow < 0 || wrist < 0 || parents[wrist] !== elbow) continue;
    const bone = [0, 1, 2].map((k) => rest[3 * wrist + k] - rest[3 * elbow + k]);
    if (!(Math.hypot(...bone) > 0)) continue;
    const axis = unit(bone);
    const angle = sharedTwist(rotations, 9 * elbow, axis) - sharedTwist(rotations, 9 * wrist, axis);
    if (angle === 0) continue;
    const twist = new Float64Array(9), product = new Float64Array(9);
    axisAngleToMatrix(...axis.map((value) => value * angle), twist, 0);
    multiply(rotations, 9 * elbow, transposed(twist), 0, product, 0);
    rotations.set(product, 9 * elbow);
    multiply(twist, 0, rotations, 9 * wrist, product, 0);
    rotations.set(product, 9 * wrist);
  }
}

/** The share of the twist about `axis` that the rotation at `at` passes to the forearm, radians. */
function sharedTwist(m, at, axis) {
  let along = 0;
  for (let row = 0; row < 3; row++) for (let k = 0; k < 3; k++) along += axis[row] * m[at + 3 * row + k] * axis[k];
  const sine = axis[0] * (m[at + 7] - m[at + 5]) + axis[1] * (m[at + 2] - m[at + 6]) + axis[2] * (m[at + 3] - m[at + 1]);
  const twist = Math.atan2(sine, m[at] + m[at + 4] + m[at + 8] - along);
  const beyond = (Math.abs(twist) - FREE) / (Math.PI - FREE);
  if (beyond <= 0) return 0;
  const share = MAX_SHARE * Math.sin(Math.PI * beyond) ** 2 * Math.max(Math.min(1, 2 * (1 + along)), 0);
  return twist > 0 ? share : -share;
}
