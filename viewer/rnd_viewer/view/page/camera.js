// Views of the page: a pinhole camera in OpenCV's axes (rnd_runtime/core/camera.py), presets, and a path through keys.

const RADIANS = Math.PI / 180;
const FACE = 0.6;  // m, height of the image around a face
const PRESETS = { front: 0, side: 90, back: 180 };  // degrees to the body's left
const VIEW = ["azimuth", "elevation", "distance", "target", "fov"];

/** What of a state is its view. */
export const viewOf = (state) => structuredClone(Object.fromEntries(VIEW.map((name) => [name, state[name]])));

/** The camera of a state: {width, height, focal, centre [2], rotation [9], translation [3], position [3]}. */
export function cameraOf({ azimuth, elevation, distance, target, fov, width, height }) {
  const flat = Math.cos(elevation);
  const back = [flat * Math.sin(azimuth), Math.sin(elevation), flat * Math.cos(azimuth)];
  const position = target.map((x, k) => x + distance * back[k]), forward = back.map((x) => -x);
  const length = Math.hypot(forward[2], forward[0]);  // right = forward × (0, 1, 0)
  const right = [-forward[2] / length, 0, forward[0] / length];
  const down = [
    forward[1] * right[2] - forward[2] * right[1],
    forward[2] * right[0] - forward[0] * right[2],
    forward[0] * right[1] - forward[1] * right[0],
  ];
  const rotation = [...right, ...down, ...forward];
  const translation = [0, 1, 2].map((row) =>
    -(rotation[3 * row] * position[0] + rotation[3 * row + 1] * position[1] + rotation[3 * row + 2] * position[2]));
  return { width, height, focal: 0.5 * height / Math.tan(0.5 * fov), centre: [width / 2, height / 2], rotation, translation, position };
}

/** The first view `home`, farther away where the image is narrow. */
export const fitted = (home, { width, height }) => ({ ...structuredClone(home), distance: home.distance / Math.min(1, width / height) });

/** The view `name` of presets; `joints` [J][3] are px, px and m of a frame in the view of `state`, `head` is one of them. */
export function preset(name, home, state, joints, head) {
  if (name !== "face") return { ...fitted(home, state), azimuth: home.azimuth + PRESETS[name] * RADIANS };
  const { focal, centre, rotation: r, translation: t } = cameraOf(state), [px, py, z] = joints[head];
  const seen = [(px - centre[0]) * z / focal - t[0], (py - centre[1]) * z / focal - t[1], z - t[2]];
  const target = [0, 1, 2].map((k) => r[k] * seen[0] + r[3 + k] * seen[1] + r[6 + k] * seen[2]);
  target[1] += FACE / 8;  // the joint is where the neck ends
  const view = { ...home, target, elevation: 0, distance: FACE / 2 / Math.tan(home.fov / 2) };
  return fitted(view, state);
}

/** The view at `time` of a path through `keys` [{time, view}]. */
export function viewAt(keys, time) {
  const sorted = [...keys].sort((a, b) => a.time - b.time), times = sorted.map(({ time }) => time), turn = 2 * Math.PI;
  const rows = sorted.map(({ view }) => [view.azimuth, view.elevation, view.distance, ...view.target, view.fov]);
  for (let k = 1; k < rows.length; k++) rows[k][0] -= turn * Math.round((rows[k][0] - rows[k - 1][0]) / turn);
  const [azimuth, elevation, distance, x, y, z, fov] = rows[0].map((_, c) => between(times, rows.map((row) => row[c]), time));
  return { azimuth, elevation, distance, target: [x, y, z], fov };
}

/** Cameras for rnd-play, one a frame, of the path through `keys`: {cameras: [{width, height, K, world_to_camera}]}. */
export function pathOf(keys, { fps, duration }, width, height) {
  const count = Math.floor(duration * fps + 1e-4) + 1;
  return { cameras: Array.from({ length: count }, (_, frame) => {
    const { focal, centre, rotation: r, translation: t } = cameraOf({ ...viewAt(keys, frame / fps), width, height });
    const world = [0, 3, 6].map((row) => [...r.slice(row, row + 3), t[row / 3]]);
    return { width, height, K: [[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]], world_to_camera: [...world, [0, 0, 0, 1]] };
  }) };
}

/** The value at `time` of a cubic through `values` at `times`, its slopes those of the neighbours' chords; constant outside. */
function between(times, values, time) {
  const last = times.length - 1, next = times.findIndex((at) => at > time);
  if (next === 0 || next < 0) return values[next < 0 ? last : 0];
  const from = next - 1, span = times[next] - times[from], u = (time - times[from]) / span;
  const slope = (k) => {
    const [a, b] = [Math.max(k - 1, 0), Math.min(k + 1, last)];
    return (values[b] - values[a]) / (times[b] - times[a]) * span;
  };
  const [p, q] = [values[from], values[next]], v = 1 - u;
  return v * v * (1 + 2 * u) * p + u * u * (3 - 2 * u) * q + u * v * v * slope(from) - u * u * v * slope(next);
}
