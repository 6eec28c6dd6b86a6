// The body's shadow on the ground, as the share of the ground's irradiance that is blocked (rnd_runtime/ground/shadow.py, standing.py).

import { CELL, CELLS, FRAMES, MIN_ELEVATION, REACH, SKY_DIRECTIONS, STANDING } from "../constants.js";
import { dot, rotate, transposed } from "../rotations.js";
import { downsize, sampleLight } from "../shading/light.js";
import { discRadii } from "../shading/shadow.js";
import { extractSuns } from "../shading/sun.js";
import { skyMap } from "./sky.js";
import { standIn } from "./stand_in.js";
import { sunMap } from "./sun.js";

const LOWEST = 0.05;  // percentile of heights: a few Gaussians may stray
const DIRECTIONS = Array.from({ length: SKY_DIRECTIONS }, (_, k) => {  // Malley's method
  const radius = Math.sqrt((k + 0.5) / SKY_DIRECTIONS), azimuth = (k + 0.5) * Math.PI * (3 - Math.sqrt(5));
  return [radius * Math.sin(azimuth), Math.sqrt(1 - radius * radius), radius * Math.cos(azimuth)];
});

/** Height m of the ground under the feet of `avatar` in `motion`. */
export async function groundOf(avatar, motion) {
  const lowest = [];
  for (let k = 0; k < FRAMES; k++) {
    const { means, count, root } = avatar.posed(await avatar.encode(motion, k / (FRAMES - 1) * motion.duration));
    const [x, y, z] = root.rotation.subarray(3, 6), heights = new Float64Array(count);
    for (let i = 0; i < count; i++) heights[i] = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + root.translation[1];
    lowest.push(percentile(heights.filter(Number.isFinite), LOWEST));
  }
  return percentile(Float64Array.from(lowest), STANDING);
}

function percentile(values, percent) {
  const sorted = values.sort(), at = (sorted.length - 1) * percent / 100, below = Math.floor(at);
  return sorted[below] + (at - below) * (sorted[Math.min(below + 1, sorted.length - 1)] - sorted[below]);
}

/** A light's sky and suns, for `groundShadow`. */
export function groundLight(light) {
  const { sky, suns } = extractSuns(light);
  return { sky: downsize(sky, 16, 32), suns };
}

/** Maps of blocked shares {width, values} for blend.frag, with `to_…` [9], (column, row, 1) → a map's row, column and 1, times a depth.
 *  The body is in the frame of its `root`, as is `camera`; `height` m is the ground's; `lightToWorld` [9]. Null where nothing is lit. */
export function groundShadow({ sky, suns }, gaussians, camera, height, lightToWorld) {
  const { root, rootJoints, count } = gaussians, rootToLocal = transposed(root.rotation);
  const up = rotate(rootToLocal, [0, 1, 0]), offset = height - root.translation[1], axes = axesOf(up);
  const radiance = DIRECTIONS.map((direction) => sampleLight(sky, rotate(transposed(lightToWorld), direction)));
  const risen = suns.map((sun) => ({ ...sun, direction: rotate(lightToWorld, sun.direction) })).filter(({ direction }) => direction[1] > Math.sin(MIN_ELEVATION));
  const ofSky = radiance.map((values) => values.map((value) => value * Math.PI / SKY_DIRECTIONS));
  const irradiance = [0, 1, 2].map((c) => [...ofSky.map((values) => values[c]), ...risen.map((sun) => sun.irradiance[c] * sun.direction[1])].reduce((a, b) => a + b));
  const most = Math.max(...irradiance), total = irradiance.map((value) => Math.max(value, 1e-12 * most));
  const body = standIn(gaussians, discRadii(gaussians, count, 1), axes, offset), many = body.discs.length / 4;
  if (!(most > 0) || !many) return null;

  const inAxes = (direction) => axes.map((axis) => dot(axis, rotate(rootToLocal, direction)));
  const centre = [0, 1].map((axis) => body.discs.reduce((sum, value, k) => sum + (k % 4 === axis ? value : 0), 0) / many);
  const toPlane = imageToPlane(camera, axes, offset), toMap = (toCells) => [...toCells.map((row) => combined(row, toPlane)), toPlane[2]].flat();
  const feet = axes.slice(0, 2).map((axis) => dot(axis, rootJoints.subarray(0, 3)));
  const below = up.map((x, c) => feet[0] * axes[0][c] + feet[1] * axes[1][c] + offset * x);
  const pixel = Math.max(dot(camera.rotation.subarray(6, 9), below) + camera.translation[2], 0.1) / camera.focal;

  const maps = { ground: { width: CELLS, values: skyMap(body.discs, centre, DIRECTIONS.map(inAxes), ofSky.flatMap((values) => values.map((value, c) => value / total[c]))) } };
  const uniforms = { to_ground: toMap([0, 1].map((axis) => [Number(axis === 0) / CELL, Number(axis === 1) / CELL, -(centre[axis] - REACH) / CELL - 0.5])) };
  risen.forEach((sun, k) => {
    const { values, columns, toCells } = sunMap(body, inAxes(sun.direction), sun.spread, pixel);
    maps[`sun${k}`] = { width: columns, values };
    uniforms[`to_sun${k}`] = toMap(toCells);
    uniforms[`share${k}`] = sun.irradiance.map((value, c) => value * sun.direction[1] / total[c]);
  });
  return { maps, uniforms };
}

/** Two unit vectors in the plane across `normal`, and the normal. */
function axesOf([x, y, z]) {
  let first = [-y, x, 0];
  if (Math.abs(x) <= Math.min(Math.abs(y), Math.abs(z))) first = [0, -z, y];
  else if (Math.abs(y) <= Math.abs(z)) first = [z, 0, -x];
  const [a, b, c] = first.map((value) => value / Math.hypot(...first));
  return [[a, b, c], [y * c - z * b, z * a - x * c, x * b - y * a], [x, y, z]];
}

/** [3][3], (column, row, 1) → (x, y, 1) in the plane's axes, m, times a depth, positive where the plane is seen. */
function imageToPlane({ rotation, position, focal, centre }, axes, offset) {
  const turned = axes.map((axis) => [0, 1, 2].map((k) => dot(axis, rotation.subarray(3 * k, 3 * k + 3))));  // axes · rotationᵀ
  const rays = turned.map(([x, y, z]) => [x / focal, y / focal, z - (x * centre[0] + y * centre[1]) / focal]);
  const above = dot(axes[2], position) - offset, seen = rays[2].map((value) => (above > 0 ? -value : value));
  return [...[0, 1].map((k) => rays[k].map((value, c) => value * Math.abs(above) + dot(axes[k], position) * seen[c])), seen];
}

/** The row vector `weights` · `rows`. */
const combined = (weights, rows) => rows[0].map((_, c) => weights.reduce((sum, weight, k) => sum + weight * rows[k][c], 0));
