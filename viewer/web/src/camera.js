// Pinhole cameras in OpenCV's axes, and the view of a whole motion (rnd_runtime/core/camera.py, playback/framing.py).

import { cameraOf } from "../../rnd_viewer/view/page/camera.js";
import { ELEVATION, FIELD_OF_VIEW, PADDING } from "./constants.js";
import { jointsAt } from "./posing/avatar.js";
import { multiply, rotate, transposed } from "./rotations.js";

const RADIANS = Math.PI / 180;

/** The camera for points in a frame {rotation [9], translation [3]} → world. */
export function inFrame(camera, frame) {
  const rotation = new Float64Array(9), moved = rotate(camera.rotation, frame.translation);
  multiply(camera.rotation, 0, frame.rotation, 0, rotation, 0);
  const translation = moved.map((value, k) => value + camera.translation[k]);
  const position = rotate(transposed(rotation), translation).map((value) => -value);
  return { ...camera, rotation, translation, position };
}

/** rnd-play's front view of `motion` in a square frame. */
export function homeView(skeleton, motion) {
  const frames = Array.from({ length: motion.frames }, (_, f) => jointsAt(skeleton, motion, f / motion.fps));
  const low = [Infinity, Infinity, Infinity], high = low.map((x) => -x), tall = [[...low], [...high]];
  const widen = (points, below, above) => points.forEach((value, k) => {
    below[k % 3] = Math.min(below[k % 3], value);
    above[k % 3] = Math.max(above[k % 3], value);
  });
  for (const joints of frames) widen(joints, low, high);
  widen(skeleton.rest, ...tall);
  const padding = PADDING * Math.max(...tall[1].map((x, k) => x - tall[0][k]));
  const target = low.map((x, k) => (x + high[k]) / 2);
  const fx = motion.rotations[2], fz = motion.rotations[8];  // a body at rest faces +Z
  const azimuth = Math.hypot(fx, fz) > 1e-3 ? Math.atan2(fx, fz) : 0;
  const view = { azimuth, elevation: ELEVATION * RADIANS, distance: 1, target, fov: FIELD_OF_VIEW * RADIANS };
  const { rotation } = cameraOf({ ...view, width: 1, height: 1 });
  let distance = 0;
  for (const joints of frames)
    for (let k = 0; k < joints.length; k += 3) {
      const [x, y, z] = [0, 1, 2].map((row) =>
        [0, 1, 2].reduce((sum, c) => sum + rotation[3 * row + c] * (joints[k + c] - target[c]), 0));
      for (const offset of [x, y])
        distance = Math.max(distance, (Math.abs(offset) * Math.cos(view.fov / 2) + padding) / Math.sin(view.fov / 2) - z);
    }
  return { ...view, distance };
}

/** Pixels and depth [J][3] of `joints` [J·3]. */
export function projectJoints(joints, { rotation, translation, focal, width, height }) {
  return Array.from({ length: joints.length / 3 }, (_, j) => {
    const [x, y, z] = [0, 1, 2].map((row) =>
      [0, 1, 2].reduce((sum, c) => sum + rotation[3 * row + c] * joints[3 * j + c], translation[row]));
    const depth = Math.abs(z) > 1e-6 ? z : 1e-6;
    return [focal * x / depth + width / 2, focal * y / depth + height / 2, z];
  });
}
