// Poses between the frames of a motion: cubic Hermite paths (rnd_runtime/motion/interpolation.py).

import { LARGEST_MOVE, LARGEST_STEP } from "../constants.js";
import { axisAngleToMatrix, cross, dot, matrixToAxisAngle, multiply, transposedTimes } from "../rotations.js";

const rotation = new Float64Array(9);

/** Rotations [J·9] at `position`, in frames from 0 to frames − 1. */
export function rotationsAt({ rotations, frames, joints }, position) {
  const before = Math.min(Math.floor(position), frames - 1), t = position - before, at = (frame) => 9 * frame * joints;
  if (t === 0) return rotations.slice(at(before), at(before + 1));
  const result = new Float64Array(9 * joints), innerStart = before > 0, innerEnd = before + 2 < frames;
  for (let joint = 0; joint < joints; joint++) {
    const stepFrom = (frame) => {  // log(R_frameᵀ R_{frame + 1})
      transposedTimes(rotations, at(frame) + 9 * joint, rotations, at(frame + 1) + 9 * joint, rotation, 0);
      return matrixToAxisAngle(rotation, 0);
    };
    const step = stepFrom(before);
    const previous = innerStart ? stepFrom(before - 1) : step, following = innerEnd ? stepFrom(before + 1) : step;
    const [x, y, z] = hermite(previous, step, following, innerStart, innerEnd, t);
    axisAngleToMatrix(x, y, z, rotation, 0);
    multiply(rotations, at(before) + 9 * joint, rotation, 0, result, 9 * joint);
  }
  return result;
}

/** The point [3] at `position` of `points` [frames·3]. */
export function pointAt(points, frames, position) {
  const before = Math.min(Math.floor(position), frames - 1), t = position - before;
  if (t === 0) return [...points.slice(3 * before, 3 * before + 3)];
  const innerStart = before > 0, innerEnd = before + 2 < frames;
  const stepFrom = (frame) => [0, 1, 2].map((axis) => points[3 * frame + 3 + axis] - points[3 * frame + axis]);
  const step = stepFrom(before);
  const previous = innerStart ? stepFrom(before - 1) : step, following = innerEnd ? stepFrom(before + 1) : step;
  const straight = [previous, step, following].some((move) => dot(move, move) > LARGEST_MOVE * LARGEST_MOVE);
  return step.map((move, axis) => {
    const start = 0.5 * (previous[axis] + move), end = 0.5 * (move + following[axis]);
    const moved = straight ? t * move : cubic(move, ...endSlopes(move, start, end, innerStart, innerEnd), t);
    return points[3 * before + axis] + moved;
  });
}

/** The cubic from 0 to `step` with slopes `start` and `end`. */
const cubic = (step, start, end, t) => t * (start + t * (3 * step - 2 * start - end + t * (start + end - 2 * step)));

/** Slopes of a natural spline: the curvature vanishes at the motion's ends. */
function endSlopes(step, start, end, innerStart, innerEnd) {
  if (innerEnd && !innerStart) return [1.5 * step - 0.5 * end, end];
  if (innerStart && !innerEnd) return [start, 1.5 * step - 0.5 * start];
  return [start, end];
}

/** φ(t) [3] from the steps [3] rad around it. */
function hermite(previous, step, following, innerStart, innerEnd, t) {
  const square = dot(step, step);
  if (Math.max(square, dot(previous, previous), dot(following, following)) > LARGEST_STEP * LARGEST_STEP)
    return step.map((s) => t * s);
  const v = step.map((s, k) => 0.5 * (s + following[k]));  // at the second frame, in the tangent space of the first
  const c = cross(step, v), d = cross(step, c), angle = Math.sqrt(square);
  const bend = angle < 1e-2 ? 1 / 12 : 1 / square - (1 + Math.cos(angle)) / (2 * angle * Math.sin(angle));
  return step.map((s, k) => {
    const end = v[k] + 0.5 * c[k] + bend * d[k];
    return cubic(s, ...endSlopes(s, 0.5 * (previous[k] + s), end, innerStart, innerEnd), t);
  });
}

