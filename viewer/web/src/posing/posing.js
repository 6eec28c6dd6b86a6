// Node fields → posed Gaussians (formulas in rnd_runtime/posing).

import { DEEPEST, SHORTEST, SH_COUNT, SMALLEST_SQUARE, TWIST_STEPS } from "../constants.js";
import { multiply } from "../rotations.js";

const TERMS = 14, SUM = 12, GREATEST = 13;  // of a node's blend: Σ_j e^(Δ_j − c) B_j, the same without B, and c

// Scratch of one Gaussian
const between = new Float64Array(TERMS), blend = new Float64Array(12), moved = new Float64Array(6);
const a = new Float64Array(9), cofactors = new Float64Array(9), rotation = new Float64Array(9), f = new Float64Array(9);
const widen = new Float64Array(9), turned = new Float64Array(3);

/** Dot product of row `at` of a 3×3 `m` and (x, y, z). */
const row = (m, at, x, y, z) => m[at] * x + m[at + 1] * y + m[at + 2] * z;

export class RestPose {
  /** What does not depend on the pose: `neighbours`, `weights` [N·K], `template` [N·J] logs of skinning weights, `points`,
   *  `normals` [N·3], `factors` [N·9], `limbs` [N·7]; `limits` [3]: largest offset m, floor m², fallback. */
  constructor(count, [neighbours, weights, template, points, factors, normals, limbs, limits]) {
    Object.assign(this, { count, neighbours, weights, template, points, factors, normals, limbs, limits });
    this.posed = [3, 6, 3, SH_COUNT].map((width) => new Float32Array(width * count));
    this.#aboveTheFloor();
  }

  /** The template's floor of each Gaussian [N], and the joints above it, from `starts[i]` on, with the logs of their excess. */
  #aboveTheFloor() {
    const { count, template } = this, width = template.length / count;
    const joints = [], logs = [];
    this.floors = new Float32Array(count);
    this.starts = new Int32Array(count + 1);
    for (let i = 0, from = 0; i < count; i++, from += width) {
      let least = Infinity, top = 0;
      for (let j = from; j < from + width; j++) if (template[j] > -Infinity) least = Math.min(least, template[j]);
      for (let j = from; j < from + width; j++) if (!(template[j] <= least)) top = Math.max(top, template[j] - least);
      for (let j = from; j < from + width; j++) {
        if (template[j] <= least) continue;
        joints.push(j - from);
        logs.push(template[j] - least + Math.log(-Math.expm1(least - template[j])) - top);
      }
      this.floors[i] = Math.exp(-Math.min(top, DEEPEST));
      this.starts[i + 1] = joints.length;
    }
    this.joints = Int32Array.from(joints);
    this.logs = Float32Array.from(logs);
  }

  /** Means, covariances, normals and visibility from the node fields offsets [M·6], visibility [M·S] and logits [M·J], which
   *  may be missing, under `bones` [J·12]; in arrays that the next call overwrites. */
  pose([offsets, visibility, logits], bones) {
    const [means, covariances, normals, coefficients] = this.posed, { points, factors, limbs, normals: rest } = this;
    const [maxOffset, floor, fallback] = this.limits, terms = 6 * visibility.length / offsets.length;
    const nodes = offsets.length / 6, joints = bones.length / 12;
    const changes = logits ?? new Float32Array(nodes * joints), blends = blendsOf(changes, nodes, joints, bones);
    for (let i = 0; i < this.count; i++) {
      this.#blend(i, blends, changes, joints, bones);
      for (let k = 0; k < 9; k++) a[k] = blend[k + Math.floor(k / 3)];
      cofactorsOf(a);
      this.#between(offsets, 6, i, moved, 0);
      for (let k = 0; k < 6; k++) moved[k] = Math.tanh(moved[k]);
      this.#between(visibility, terms, i, coefficients, SH_COUNT * i);
      const limb = 7 * i, u = limbs[limb], v = limbs[limb + 1], w = limbs[limb + 2], kappa = limbs[limb + 6] * widening(u, v, w);

      const p = 3 * i, x = points[p] + maxOffset * moved[0] + kappa * limbs[limb + 3];
      const y = points[p + 1] + maxOffset * moved[1] + kappa * limbs[limb + 4], z = points[p + 2] + maxOffset * moved[2] + kappa * limbs[limb + 5];
      for (let k = 0; k < 3; k++) means[p + k] = row(a, 3 * k, x, y, z) + blend[4 * k + 3];

      quaternionToMatrix(moved[3] / 2, moved[4] / 2, moved[5] / 2);
      multiply(rotation, 0, factors, 9 * i, f, 0);
      for (let k = 0; k < 9; k++) widen[k] = (k % 4 ? 0 : 1 + kappa) - kappa * limbs[limb + Math.floor(k / 3)] * limbs[limb + k % 3];
      multiply(widen, 0, f, 0, rotation, 0);
      multiply(a, 0, rotation, 0, f, 0);
      for (let r = 0, k = 6 * i; r < 3; r++)
        for (let c = r; c < 3; c++, k++)
          covariances[k] = row(f, 3 * r, f[3 * c], f[3 * c + 1], f[3 * c + 2]) + (r === c ? floor : 0);

      const along = kappa * (u * rest[p] + v * rest[p + 1] + w * rest[p + 2]);
      const nx = rest[p] + u * along, ny = rest[p + 1] + v * along, nz = rest[p + 2] + w * along;
      for (let k = 0; k < 3; k++) turned[k] = row(cofactors, 3 * k, nx, ny, nz) + fallback * row(a, 3 * k, nx, ny, nz);
      const length = Math.max(Math.sqrt(turned[0] * turned[0] + turned[1] * turned[1] + turned[2] * turned[2]), SHORTEST);
      for (let k = 0; k < 3; k++) normals[p + k] = turned[k] / length;
    }
    return this.posed;
  }

  /** `fields` [M·width] interpolated for Gaussian i, to `out` from `at` on. */
  #between(fields, width, i, out, at) {
    const { neighbours, weights } = this, own = neighbours.length / this.count;
    for (let j = 0; j < width; j++) out[at + j] = 0;
    for (let near = own * i; near < own * (i + 1); near++) {
      const weight = weights[near], from = width * neighbours[near];
      for (let j = 0; j < width; j++) out[at + j] += weight * fields[from + j];
    }
  }

  /** [A_R | A_T] of Gaussian i, to `blend`: the floor's, interpolated between the nodes, and its own joints'. */
  #blend(i, blends, changes, joints, bones) {
    const { neighbours, weights, floors } = this, own = neighbours.length / this.count;
    this.#between(blends, TERMS, i, between, 0);
    for (let k = 0; k <= SUM; k++) between[k] *= floors[i];
    for (let k = this.starts[i]; k < this.starts[i + 1]; k++) {
      const joint = this.joints[k];
      let log = this.logs[k] - between[GREATEST];
      for (let near = own * i; near < own * (i + 1); near++) log += weights[near] * changes[joints * neighbours[near] + joint];
      const share = Math.exp(log);
      for (let c = 0; c < SUM; c++) between[c] += share * bones[12 * joint + c];
      between[SUM] += share;
    }
    for (let c = 0; c < SUM; c++) blend[c] = between[c] / between[SUM];
  }
}

/** The blend of every node that is interpolated for the floor, [M·14]. */
function blendsOf(changes, nodes, joints, bones) {
  const blends = new Float64Array(TERMS * nodes);
  for (let m = 0; m < nodes; m++) {
    const from = joints * m, at = TERMS * m, greatest = Math.max(...changes.subarray(from, from + joints));
    for (let j = 0; j < joints; j++) {
      const share = Math.exp(changes[from + j] - greatest);
      for (let c = 0; c < SUM; c++) blends[at + c] += share * bones[12 * j + c];
      blends[at + SUM] += share;
    }
    blends[at + GREATEST] = greatest;
  }
  return blends;
}

/** det(A) A⁻ᵀ, to `cofactors`. */
function cofactorsOf(m) {
  for (let r = 0; r < 3; r++)
    for (let c = 0; c < 3; c++) {
      const below = 3 * ((r + 1) % 3), last = 3 * ((r + 2) % 3), right = (c + 1) % 3, far = (c + 2) % 3;
      cofactors[3 * r + c] = m[below + right] * m[last + far] - m[below + far] * m[last + right];
    }
}

/** κ / share of the blend `a` about a limb's axis: its widening there, less 1. */
function widening(ux, uy, uz) {
  const square = (m) => row(m, 0, ux, uy, uz) ** 2 + row(m, 3, ux, uy, uz) ** 2 + row(m, 6, ux, uy, uz) ** 2;
  let pinched = Math.min(Math.sqrt(square(cofactors)) / Math.max(square(a), SMALLEST_SQUARE), 1), factor = 1;
  for (let step = 0; step < TWIST_STEPS; step++) {  // Newton–Schulz
    const half = (3 - pinched) / 2;
    factor *= half;
    pinched *= half * half;
  }
  return factor - 1;
}

/** The rotation of the quaternion normalize(1, x, y, z), to `rotation`. */
function quaternionToMatrix(x, y, z) {
  const s = 2 / (1 + x * x + y * y + z * z);
  rotation.set([1 - s * (y * y + z * z), s * (x * y - z), s * (x * z + y), s * (x * y + z), 1 - s * (x * x + z * z),
    s * (y * z - x), s * (x * z - y), s * (y * z + x), 1 - s * (x * x + y * y)]);
}
