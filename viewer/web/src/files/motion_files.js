// Array layouts of motions, read into one record in the file's axes (rnd_runtime/motion/readers/arrays.py).

import {
  AMASS_MEMBERS, DEFAULT_FPS, FPS_LIMITS, FPS_OF_TIMES, MANY_BEYOND_A_TURN, MAX_ANGLE, MAX_DISTANCE, MAX_HEIGHT, MAX_SPEED, NAMES_BY_COUNT, ORTHOGONAL, ORDERS, SMPLX_REST_ROOT, SMPL_REST_ROOT, TIMES, UNEVEN,
} from "../constants.js";
import { refusal, short, sizes } from "../errors.js";
import { Npz } from "./npz.js";
import { axisAngleToMatrix, cross, dot, matrixToAxisAngle, multiply, rotate, transposed } from "../rotations.js";

const [MIN_FPS, MAX_FPS] = FPS_LIMITS;
const FINGERS = 30;

/** {name, rotations [F·J·9] local, translations [F·3] m relative to the root's rest position, restRoot [3] m of the file's
 *  skeleton or null, frames, joints, jointNames, fps, up ("y" or "z"), upStated, notes}; throws for anything but a person's motion. */
export function readMotionFile(bytes, name) {
  const members = new Npz(bytes, name, "motion"), notes = [];
  const easymocap = members.firstOf("Rh", "Rh_all") !== undefined;
  const { frames, joints, angles } = readAngles(members, notes);
  const jointNames = readNames(members, joints);
  checkAngles(angles, jointNames, name, notes);
  const rotations = new Float64Array(frames * joints * 9);
  for (let k = 0; k < frames * joints; k++)
    axisAngleToMatrix(angles[3 * k], angles[3 * k + 1], angles[3 * k + 2], rotations, 9 * k);
  const named = members.has("joint_names"), split = members.has("pose_body") && !members.has("poses");
  const whole = (joints === 52 || joints === 55) && members.has("poses") && !named;
  const amass = whole || (split && !named && members.firstOf(...AMASS_MEMBERS) !== undefined);
  const smplRoot = joints === 55 || (split && amass) ? SMPLX_REST_ROOT : SMPL_REST_ROOT;
  let translations = new Float64Array(3 * frames);
  if (easymocap) translations = rotateAboutOrigin(members, rotations, frames, joints, smplRoot);
  else if (members.firstOf("trans", "transl")) translations = perFrame(members, frames, "trans", "transl");
  else notes.push("no trans in the file: the root stays in place");
  checkTranslations(translations, name);
  if (members.has("betas")) notes.push("the file's betas are ignored: the avatar keeps its own shape");
  checkOrder(members, frames);
  const fps = readFrameRate(members, frames, notes), stated = readUpAxis(members), up = stated ?? (amass || easymocap ? "z" : "y");
  const unit = likelyUnit(translations, frames, fps, up === "z" ? 2 : 1);
  if (unit) notes.push(`trans is higher or faster than a person in metres: these look like ${unit}`);
  const restRoot = amass || easymocap ? smplRoot : null;
  return { name, rotations, translations, restRoot, frames, joints, jointNames, fps, up, upStated: stated !== null, notes };
}

/** Axis-angles [F·J·3] rad with the root first: {frames, joints, angles}. */
function readAngles(members, notes) {
  const { file } = members, key = members.firstOf("poses", "poses_all", "pose_body", "body_pose");
  if (!key) {
    const expected = "a member called poses, poses_all, pose_body or body_pose";
    throw refusal("motion", { expected, got: members.names.join(", ") || "an empty archive", file });
  }
  const { shape, numbers } = axisAnglesOf(members.numbers(key), key, file), [frames, width] = shape;
  const flat = shape.length === 2 && width % 3 === 0, byJoint = shape.length === 3 && shape[2] === 3;
  if (!flat && !byJoint) throw refusal(`shape of ${key}`, { expected: "F×3J, F×J×3 or F×J×3×3", got: sizes(shape), file });
  if (frames === 0) throw refusal(key, { expected: "at least one frame", got: "none", file });
  const joints = flat ? width / 3 : width;
  if ((joints !== 21 && joints !== 23) || members.has("joint_names")) return { frames, joints, angles: numbers };
  return joined(frames, [readRoot(members, frames, notes), numbers, ...readFingers(members, frames, joints, notes)]);
}

/** Rotation matrices F×J×3×3 as axis-angles F×J×3; others unchanged. */
function axisAnglesOf({ shape, numbers }, key, file) {
  if (shape.length !== 4 || shape[2] !== 3 || shape[3] !== 3) return { shape, numbers };
  if (!numbers.length) throw refusal(`shape of ${key}`, { expected: "F×J×3×3", got: sizes(shape), file });
  const count = numbers.length / 9, angles = new Float64Array(3 * count), product = new Float64Array(9);
  for (let k = 0; k < count; k++) {
    const rows = numbers.subarray(9 * k, 9 * k + 9), transpose = transposed(rows);
    multiply(rows, 0, transpose, 0, product, 0);
    const off = Math.max(...product.map((value, i) => Math.abs(value - (i % 4 === 0 ? 1 : 0))));
    if (!(off < ORTHOGONAL && dot(cross(rows.slice(0, 3), rows.slice(3, 6)), rows.slice(6)) > 0)) {
      const frame = Math.floor(k / shape[1]), what = `${key}: joint ${k % shape[1]}`;
      throw refusal(what, { expected: "rotation matrices", got: "others", file, frame });
    }
    angles.set(matrixToAxisAngle(rows, 0), 3 * k);
  }
  return { shape: shape.slice(0, 3), numbers: angles };
}

/** The root's axis-angles [F·3] for a body without them. */
function readRoot(members, frames, notes) {
  if (members.firstOf("root_orient", "global_orient")) return perFrame(members, frames, "root_orient", "global_orient");
  if (!members.firstOf("Rh", "Rh_all")) notes.push("no root orientation in the file: the root stays upright");
  return new Float64Array(3 * frames);
}

/** Poses of thirty finger joints for a body of 21, if given: the parts of [F·90]. */
function readFingers(members, frames, bodyJoints, notes) {
  if (bodyJoints !== 21 || !members.firstOf("pose_hand", "left_hand_pose")) return [];
  const sides = members.has("pose_hand") ? ["pose_hand"] : ["left_hand_pose", "right_hand_pose"];
  const poses = sides.map((side) => members.numbers(side));
  const widths = poses.map(({ shape, numbers }) => (shape.length > 1 && shape[0] === frames ? numbers.length / frames : NaN));
  if (widths.every((width) => width === 3 * FINGERS / sides.length)) return poses.map(({ numbers }) => numbers);
  notes.push("hands stay at rest: they are not given as 15 joints each");
  return [];
}

/** Concatenation of parts [F·3J] of F poses. */
function joined(frames, parts) {
  const widths = parts.map((part) => part.length / frames), width = widths.reduce((a, b) => a + b);
  const angles = new Float64Array(frames * width);
  for (let f = 0; f < frames; f++) {
    let at = f * width;
    parts.forEach((part, k) => {
      angles.set(part.subarray(f * widths[k], (f + 1) * widths[k]), at);
      at += widths[k];
    });
  }
  return { frames, joints: width / 3, angles };
}

function readNames(members, joints) {
  const given = members.has("joint_names"), { file } = members;
  const names = given ? members.strings("joint_names") : NAMES_BY_COUNT[joints];
  if (names?.length !== joints) {
    const expected = given ? `${names.length} joints (${3 * names.length} columns)`
      : "22, 24, 52 or 55 joints (66, 72, 156 or 165 columns), or joint_names beside them";
    throw refusal("joints of the motion", { expected, got: `${joints} joints (${3 * joints} columns)`, file });
  }
  if (new Set(names).size !== joints) throw refusal("joint_names", { expected: "each name once", got: names.join(", "), file });
  return names;
}

/** [F·3] of the first member present; EasyMocap has F×1×3. */
function perFrame(members, frames, ...names) {
  const { file } = members, key = members.firstOf(...names);
  if (!key) throw refusal(`${names[0]} is missing`, { got: members.names.join(", "), file });
  const { shape, numbers } = members.numbers(key);
  const flat = shape.length === 3 && shape[1] === 1 ? [shape[0], shape[2]] : shape;
  if (flat.length !== 2 || flat[0] !== frames || flat[1] !== 3)
    throw refusal(`shape of ${key}`, { expected: `${frames}×3, as many frames as poses`, got: sizes(flat), file });
  return numbers;
}

/** EasyMocap's Rh rotates about the origin: rotates the roots of `rotations` [F·J·9], returns transl = Th + Rh·J0 − J0. */
function rotateAboutOrigin(members, rotations, frames, joints, restRoot) {
  const angles = perFrame(members, frames, "Rh", "Rh_all"), rotation = new Float64Array(9), product = new Float64Array(9);
  const translations = perFrame(members, frames, "Th", "Th_all");
  for (let f = 0; f < frames; f++) {
    axisAngleToMatrix(angles[3 * f], angles[3 * f + 1], angles[3 * f + 2], rotation, 0);
    multiply(rotation, 0, rotations, 9 * f * joints, product, 0);
    rotations.set(product, 9 * f * joints);
    rotate(rotation, restRoot).forEach((value, k) => { translations[3 * f + k] += value - restRoot[k]; });
  }
  return translations;
}

function checkAngles(axisAngles, names, file, notes) {
  const angles = Float64Array.from({ length: axisAngles.length / 3 }, (_, k) => Math.hypot(...axisAngles.subarray(3 * k, 3 * k + 3)));
  const wild = angles.findIndex((angle) => angle > MAX_ANGLE);
  if (wild >= 0) {
    const expected = `an axis-angle of at most ${MAX_ANGLE} rad`, frame = Math.floor(wild / names.length);
    throw refusal(`poses: ${names[wild % names.length]}`, { expected, got: short(angles[wild]), file, frame, hint: "are these degrees?" });
  }
  const beyond = angles.filter((angle) => angle > 2 * Math.PI).length / angles.length;
  if (beyond > MANY_BEYOND_A_TURN)
    notes.push(`${(100 * beyond).toFixed()}% of the rotations are beyond a whole turn: are these degrees instead of radians?`);
}

function checkTranslations(translations, file) {
  const far = translations.findIndex((value) => Math.abs(value) > MAX_DISTANCE);
  if (far < 0) return;
  const frame = Math.floor(far / 3), distance = Math.max(...translations.subarray(3 * frame, 3 * frame + 3).map(Math.abs));
  const expected = `metres, at most ${MAX_DISTANCE} from the origin`;
  throw refusal("trans", { expected, got: short(distance), file, frame, hint: "are these millimetres?" });
}

/** [F] of a member; empty where it is missing or no number of each frame, as names of images. */
function numberOfEach(members, member, frames) {
  try {
    const { numbers } = members.has(member) ? members.numbers(member) : { numbers: [] };
    return numbers.length === frames ? numbers : [];
  } catch {
    return [];
  }
}

/** Refuses times or frame numbers that do not increase from frame to frame. */
function checkOrder(members, frames) {
  for (const member of ORDERS) {
    const numbers = numberOfEach(members, member, frames);
    const back = numbers.findIndex((value, frame) => frame > 0 && !(value - numbers[frame - 1] > 0));
    if (back < 0) continue;
    const expected = "numbers that increase from frame to frame", hint = "sort the frames, and remove those that occur twice";
    throw refusal(member, { expected, got: `${short(numbers[back])} after ${short(numbers[back - 1])}`, file: members.file, frame: back, hint });
  }
}

/** Frames per second of even times in seconds; null without, with a note on uneven ones. */
function rateOfTimes(members, frames, notes) {
  const [low, high] = FPS_OF_TIMES;
  for (const member of TIMES) {
    const steps = Array.from(numberOfEach(members, member, frames)).map((time, frame, times) => time - times[frame - 1]).slice(1);
    const step = steps.length ? median([...steps]) : NaN;
    if (!(low * step <= 1 && 1 <= high * step)) continue;
    if (steps.some((other) => Math.abs(other - step) > UNEVEN * step))
      notes.push(`${member} are uneven: the frames are played one after the other`);
    return Math.round(1000 / step) / 1000;
  }
  return null;
}

function readFrameRate(members, frames, notes) {
  const byTimes = rateOfTimes(members, frames, notes), key = members.firstOf("mocap_framerate", "mocap_frame_rate", "fps");
  if (!key && byTimes) return byTimes;
  if (!key) {
    notes.push(`no frame rate in the file: ${DEFAULT_FPS} frames per second assumed`);
    return DEFAULT_FPS;
  }
  const { numbers } = members.numbers(key);
  if (numbers.length === 1 && numbers[0] >= MIN_FPS && numbers[0] <= MAX_FPS) return numbers[0];
  const few = Array.from(numbers.subarray(0, 4), (value) => (Number.isInteger(value) ? value.toFixed(1) : String(value)));
  throw refusal(key, { expected: `frames per second, ${MIN_FPS} to ${MAX_FPS}`, got: `[${few.join(", ")}]`, file: members.file });
}

function readUpAxis(members) {
  if (!members.has("up_axis")) return null;
  const up = members.strings("up_axis").join("").toLowerCase();
  if (up !== "y" && up !== "z") throw refusal("up_axis", { expected: "y or z", got: up, file: members.file });
  return up;
}

/** The unit of `translations` that are not a person's in metres; "" of those that may be. */
function likelyUnit(translations, frames, fps, up) {
  const heights = [], speeds = [];
  for (let f = 0; f < frames; f++) {
    heights.push(Math.abs(translations[3 * f + up]));
    if (f > 0) speeds.push(fps * Math.hypot(...[0, 1, 2].map((k) => translations[3 * f + k] - translations[3 * f - 3 + k])));
  }
  const height = median(heights);
  if (height > MAX_HEIGHT) return height < 10 * MAX_HEIGHT ? "centimetres" : "millimetres";
  return frames > 1 && median(speeds) > MAX_SPEED ? "millimetres or centimetres" : "";
}

function median(values) {
  values.sort((a, b) => a - b);
  const half = values.length >> 1;
  return values.length % 2 ? values[half] : (values[half - 1] + values[half]) / 2;
}
