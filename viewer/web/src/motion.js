// Motion files, as rnd_runtime/motion_files.py and motion.py read them, and the window an avatar's skinning looks at.

import { readNpz } from "./npz.js";
import { pointAt, rotationsAt } from "./interpolation.js";
import { axisAngleToMatrix, matrixToAxisAngle, multiply, transposedTimes } from "./rotations.js";

const SMPL = [
  "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle", "spine3",
  "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow",
  "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
];
const HANDS = ["left", "right"].flatMap((side) =>
  ["index", "middle", "pinky", "ring", "thumb"].flatMap((finger) => [1, 2, 3].map((k) => `${side}_${finger}${k}`)));
const NAMES = {
  22: SMPL.slice(0, 22), 24: SMPL, 52: [...SMPL.slice(0, 22), ...HANDS],
  55: [...SMPL.slice(0, 22), "jaw", "left_eye", "right_eye", ...HANDS],
};
const STAND_INS = { left_hand: "left_index1", right_hand: "right_index1" };
// Where SMPL's mean body has its pelvis: files of that family place the origin instead.
const SMPL_REST_ROOT = [-0.0018, -0.2233, 0.0282], SMPLX_REST_ROOT = [0.0031, -0.3514, 0.012];
const Z_UP_TO_Y_UP = new Float64Array([1, 0, 0, 0, 0, 1, 0, -1, 0]);
const DEFAULT_FPS = 60;

/** The motion in `bytes` for `skeleton` ({names, rest}), Y up: {rotations, translations, frames, joints, fps, duration, …}. */
export function readMotion(bytes, name, skeleton) {
  const members = readNpz(bytes), notes = [];
  const first = (...names) => names.find((key) => members[key]?.numbers);
  const poses = readPoses(members, first, notes);
  const { frames, angles } = poses;
  const names = members.joint_names?.strings ?? NAMES[poses.joints];
  if (!names || names.length !== poses.joints) throw new Error(`${name}: ${poses.joints} joints and no joint_names`);
  const rotations = new Float64Array(frames * poses.joints * 9);
  for (let k = 0; k < frames * poses.joints; k++)
    axisAngleToMatrix(angles[3 * k], angles[3 * k + 1], angles[3 * k + 2], rotations, 9 * k);
  if (!angles.every(Number.isFinite)) throw new Error(`${name}: poses must be finite numbers`);

  const amass = (poses.joints === 52 || poses.joints === 55) && !members.joint_names;
  const easymocap = Boolean(first("Rh", "Rh_all"));
  const smplRoot = poses.joints === 55 ? SMPLX_REST_ROOT : SMPL_REST_ROOT;
  let translations = new Float64Array(3 * frames);
  const shift = perFrame(members, first(...(easymocap ? ["Th", "Th_all"] : ["trans", "transl"])), frames);
  if (shift) translations.set(shift);
  else notes.push("no trans in the file: the root stays in place");
  if (easymocap) turnAboutOrigin(members, first, rotations, translations, poses, smplRoot);
  const zUp = (members.up_axis?.strings?.join("").toLowerCase() ?? (amass || easymocap ? "z" : "y")) === "z";
  const restRoot = amass || easymocap ? smplRoot : zUp ? SMPL_REST_ROOT : null;
  if (restRoot) placeRoot(rotations, translations, poses, restRoot, zUp, skeleton);

  const rate = first("mocap_framerate", "mocap_frame_rate", "fps");
  const fps = rate ? members[rate].numbers[0] : DEFAULT_FPS;
  if (!rate) notes.push(`no frame rate in the file: ${DEFAULT_FPS} frames per second assumed`);
  if (!(fps > 0)) throw new Error(`${name}: ${rate} must be above 0`);
  const matched = match(rotations, frames, names, skeleton, notes, name);
  return { name, rotations: matched, translations, frames, joints: skeleton.names.length, fps, duration: (frames - 1) / fps, notes };
}

/** One frame: the pose at rest. */
export function restMotion(skeleton) {
  const joints = skeleton.names.length;
  const rotations = Float64Array.from({ length: 9 * joints }, (_, k) => (k % 9 % 4 === 0 ? 1 : 0));
  return { name: "at rest", rotations, translations: new Float64Array(3), frames: 1, joints, fps: 30, duration: 0, notes: [] };
}

function readPoses(members, first, notes) {
  const key = first("poses", "poses_all", "pose_body", "body_pose");
  if (!key) throw new Error("the motion has no member called poses, poses_all, pose_body or body_pose");
  const { shape, numbers } = members[key], frames = shape[0];
  const joints = numbers.length / frames / 3;
  if (!(frames > 0) || !Number.isInteger(joints)) throw new Error(`${key} must be F×3J or F×J×3`);
  if ((joints !== 21 && joints !== 23) || members.joint_names) return { frames, joints, angles: numbers };
  const root = perFrame(members, first("root_orient", "global_orient"), frames);
  if (!root) notes.push("no root orientation in the file: the root stays upright");
  const angles = new Float64Array(frames * (joints + 1) * 3);
  for (let f = 0; f < frames; f++) {
    if (root) angles.set(root.subarray(3 * f, 3 * f + 3), f * (joints + 1) * 3);
    angles.set(numbers.subarray(f * joints * 3, (f + 1) * joints * 3), f * (joints + 1) * 3 + 3);
  }
  return { frames, joints: joints + 1, angles };
}

function perFrame(members, key, frames) {
  if (!key) return null;
  if (members[key].numbers.length !== 3 * frames) throw new Error(`${key} must be ${frames}×3, as many frames as poses`);
  return members[key].numbers;
}

/** EasyMocap's Rh turns about the origin: transl = Th + Rh·J0 − J0. */
function turnAboutOrigin(members, first, rotations, translations, { frames, joints }, root) {
  const angles = perFrame(members, first("Rh", "Rh_all"), frames), turn = new Float64Array(9), turned = new Float64Array(9);
  for (let f = 0; f < frames; f++) {
    axisAngleToMatrix(angles[3 * f], angles[3 * f + 1], angles[3 * f + 2], turn, 0);
    multiply(turn, 0, rotations, 9 * f * joints, turned, 0);
    rotations.set(turned, 9 * f * joints);
    for (let k = 0; k < 3; k++)
      translations[3 * f + k] += turn[3 * k] * root[0] + turn[3 * k + 1] * root[1] + turn[3 * k + 2] * root[2] - root[k];
  }
}

function placeRoot(rotations, translations, { frames, joints }, restRoot, zUp, skeleton) {
  const turned = new Float64Array(9);
  for (let f = 0; f < frames; f++) {
    const p = [0, 1, 2].map((k) => restRoot[k] + translations[3 * f + k]);
    const placed = zUp ? [p[0], p[2], -p[1]] : p;
    for (let k = 0; k < 3; k++) translations[3 * f + k] = placed[k] - skeleton.rest[k];
    if (!zUp) continue;
    multiply(Z_UP_TO_Y_UP, 0, rotations, 9 * f * joints, turned, 0);
    rotations.set(turned, 9 * f * joints);
  }
}

function match(rotations, frames, names, skeleton, notes, file) {
  const columns = new Map(names.map((name, column) => [name, column]));
  for (const [hand, finger] of Object.entries(STAND_INS))
    if (!columns.has(hand) && columns.has(finger)) columns.set(hand, columns.get(finger));
  columns.set(skeleton.names[0], 0);
  const missing = skeleton.names.filter((name) => !columns.has(name));
  if (skeleton.names.length - missing.length < Math.min(2, skeleton.names.length))
    throw new Error(`${file}: none of its joints is the avatar's`);
  if (missing.length) notes.push(`joints that the motion lacks stay at rest: ${missing.join(", ")}`);
  const result = new Float64Array(frames * skeleton.names.length * 9);
  for (let f = 0; f < frames; f++)
    skeleton.names.forEach((name, joint) => {
      const to = 9 * (f * skeleton.names.length + joint), column = columns.get(name);
      if (column === undefined) result[to] = result[to + 4] = result[to + 8] = 1;
      else result.set(rotations.subarray(9 * (f * names.length + column), 9 * (f * names.length + column) + 9), to);
    });
  return result;
}

/** Local rotations [J·9] and the root's translation [3] at `time` seconds; the end poses beyond the ends. */
export function poseAt(motion, time) {
  const place = Math.min(Math.max(time * motion.fps, 0), motion.frames - 1);
  return { rotations: rotationsAt(motion, place), translation: pointAt(motion.translations, motion.frames, place) };
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
  const turn = new Float64Array(9), [last, now] = steps.slice(-2);
  for (let joint = 0; joint < others; joint++) {
    transposedTimes(last, 9 * (joint + 1), now, 9 * (joint + 1), turn, 0);
    matrixToAxisAngle(turn, 0).forEach((value, k) => { velocity[3 * joint + k] = value / spacing; });
  }
  return { window, velocity };
}
