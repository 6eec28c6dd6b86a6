// Motions: poses of a file on an avatar's skeleton (rnd_runtime/motion/motion.py), and the encoder's window (posing/window.py).

import { SMPL_REST_ROOT, STAND_INS, TURNS, UP_ROTATIONS } from "../constants.js";
import { refusal } from "../errors.js";
import { pointAt, rotationsAt } from "./interpolation.js";
import { matrixToAxisAngle, multiply, rotate, transposedTimes } from "../rotations.js";
import { upAxis } from "./standing.js";

/** A record of motion_files.js for `skeleton` ({names, rest}), Y up: {rotations [F·J·9], translations [F·3] m, frames, joints,
 *  fps, duration in s, name, notes}. */
export function fitMotion(record, skeleton) {
  const { name, frames, fps } = record, notes = [], translations = record.translations.slice();
  const rotations = matchJoints(record, skeleton, notes), axis = upOf(record, rotations, skeleton.names.length, notes);
  notes.unshift(...record.notes);
  const motion = { name, rotations, translations, frames, joints: skeleton.names.length, fps, duration: (frames - 1) / fps, notes };
  const restRoot = record.restRoot ?? (axis === "y" ? null : SMPL_REST_ROOT);
  if (restRoot) placeRoot(motion, restRoot, UP_ROTATIONS[axis].flat(), skeleton);
  return motion;
}

/** The file's up axis: what it states, or how the trunk stands; its notes come before the others. */
function upOf({ up, upStated, restRoot, translations, frames }, rotations, joints, notes) {
  if (upStated) return up;
  const rest = restRoot ?? SMPL_REST_ROOT, trunks = [], hips = [];
  for (let f = 0; f < frames; f++) {
    trunks.push([1, 4, 7].map((k) => rotations[9 * f * joints + k]));
    hips.push([0, 1, 2].map((k) => rest[k] + translations[3 * f + k]));
  }
  const found = upAxis(trunks, hips, up);
  notes.unshift(...found.notes);
  return found.axis;
}

/** A motion of one frame in the rest pose. */
export function restMotion(skeleton) {
  const joints = skeleton.names.length;
  const rotations = Float64Array.from({ length: 9 * joints }, (_, k) => (k % 9 % 4 === 0 ? 1 : 0));
  return { name: "at rest", rotations, translations: new Float64Array(3), frames: 1, joints, fps: 30, duration: 0, notes: [] };
}

/** Translations relative to the avatar's rest position, from those relative to `restRoot`. */
function placeRoot({ rotations, translations, frames, joints }, restRoot, world, skeleton) {
  const product = new Float64Array(9);
  for (let f = 0; f < frames; f++) {
    const p = [0, 1, 2].map((k) => restRoot[k] + translations[3 * f + k]);
    const placed = rotate(world, p);
    for (let k = 0; k < 3; k++) translations[3 * f + k] = placed[k] - skeleton.rest[k];
    multiply(world, 0, rotations, 9 * f * joints, product, 0);
    rotations.set(product, 9 * f * joints);
  }
}

/** The record's rotations in the order of `skeleton`; missing joints are at rest and noted, a joint above the root rotates it. */
function matchJoints({ name: file, rotations, frames, joints, jointNames }, skeleton, notes) {
  const columns = new Map(jointNames.map((name, column) => [name, column]));
  for (const [hand, finger] of Object.entries(STAND_INS))
    if (!columns.has(hand) && columns.has(finger)) columns.set(hand, columns.get(finger));
  if (!columns.has(skeleton.names[0])) columns.set(skeleton.names[0], 0);  // the root by any name
  const missing = skeleton.names.filter((name) => !columns.has(name));
  if (skeleton.names.length - missing.length < Math.min(2, skeleton.names.length)) {
    const some = (names) => `${names.slice(0, 4).join(", ")}, …`;
    const expected = `some of the avatar's (${some(skeleton.names)})`;
    throw refusal("joints of the motion", { expected, got: some(jointNames), file });
  }
  const above = skeleton.names.every((name) => columns.get(name) !== 0) && firstTurns(rotations, frames, joints);
  if (above) notes.push(`${jointNames[0]}, above ${skeleton.names[0]}, rotates all below it`);
  if (missing.length) notes.push(`joints that the motion lacks stay at rest: ${missing.join(", ")}`);
  const result = new Float64Array(frames * skeleton.names.length * 9);
  const root = columns.get(skeleton.names[0]);
  for (let f = 0; f < frames; f++) {
    skeleton.names.forEach((name, joint) => {
      const to = 9 * (f * skeleton.names.length + joint), column = columns.get(name);
      if (column === undefined) result[to] = result[to + 4] = result[to + 8] = 1;
      else result.set(rotations.subarray(9 * (f * joints + column), 9 * (f * joints + column) + 9), to);
    });
    const first = 9 * f * joints;
    if (above) multiply(rotations, first, rotations, first + 9 * root, result, 9 * f * skeleton.names.length);
  }
  return result;
}

/** Whether the file's first joint rotates. */
function firstTurns(rotations, frames, joints) {
  for (let f = 0; f < frames; f++)
    for (let k = 0; k < 9; k++)
      if (Math.abs(rotations[9 * f * joints + k] - (k % 4 === 0 ? 1 : 0)) > TURNS) return true;
  return false;
}

/** Local rotations [J·9] and the root's translation [3] at `time` seconds, clamped to the motion. */
export function poseAt(motion, time) {
  const position = Math.min(Math.max(time * motion.fps, 0), motion.frames - 1);
  return { rotations: rotationsAt(motion, position), translation: pointAt(motion.translations, motion.frames, position) };
}

/** The last `poses` poses up to `time` over `seconds`, without the root: 6D rotations and joint velocities (window.py). */
export function motionWindow(motion, time, poses, seconds) {
  const spacing = seconds / Math.max(poses - 1, 1), others = motion.joints - 1;
  const steps = Array.from({ length: Math.max(poses, 2) }, (_, k) =>
    poseAt(motion, time - spacing * (Math.max(poses - 1, 1) - k)).rotations);
  const window = new Float32Array(poses * others * 6), velocity = new Float32Array(others * 3);
  steps.slice(-poses).forEach((rotations, row) => {
    for (let joint = 0; joint < others; joint++)
      for (let k = 0; k < 6; k++)  // the first two columns, one after the other
        window[(row * others + joint) * 6 + k] = rotations[9 * (joint + 1) + 3 * (k % 3) + (k < 3 ? 0 : 1)];
  });
  const difference = new Float64Array(9), [last, now] = steps.slice(-2);
  for (let joint = 0; joint < others; joint++) {
    transposedTimes(last, 9 * (joint + 1), now, 9 * (joint + 1), difference, 0);
    matrixToAxisAngle(difference, 0).forEach((value, k) => { velocity[3 * joint + k] = value / spacing; });
  }
  return { window, velocity };
}
