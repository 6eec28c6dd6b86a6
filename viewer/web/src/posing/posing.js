// From what the networks say at the nodes to posed Gaussians (rnd_runtime/posing/posing.py, which has the formulas).
//
// Everything is summed in float32 and in the order in which the compiled pass sums it on a machine that multiplies and
// adds at once, rounding once. The bits are the same then, and so is which of two Gaussians at one depth is in front; what
// the page draws differs from the player's picture where that does.

const f32 = Math.fround;
const LOG2_E = f32(Math.LOG2E), SMALLEST_POWER = -126, LARGEST_TANH = 9, SHORTEST = f32(1e-9), SMALLEST_SQUARE = f32(1e-6);
const HARMONICS = 16, NEVER = f32(-1e30), DEEPEST = 60;
const TERMS = 14, SUM = 12, GREATEST = 13;  // of a node's blend: Σ_j e^(Δ_j − c) B_j, the same without B, and c
const TO_WHOLE = 1.5 * 2 ** 52;  // added and taken away again rounds to whole numbers, halves to even ones
// 2^x on [−½, ½] (rnd_runtime/core/simd.py)
const E0 = 1.0000001192092896, E1 = 0.6931471824645996, E2 = 0.2402210682630539, E3 = 0.055503569543361664;
const E4 = 0.009676031768321991, E5 = 0.0013390863314270973;
const POWERS = Float32Array.from({ length: 255 }, (_, k) => 2 ** (k - 127));

// Of one Gaussian at a time
const between = new Float32Array(TERMS), blend = new Float32Array(12), moved = new Float32Array(6), linear = new Float32Array(9), cofactors = new Float32Array(9);
const factor = new Float32Array(9), posedFactor = new Float32Array(9);

/** a·b + c of float32, rounded once. */
const fused = (a, b, c) => f32(a * b + c);

/** e^x; rubbish where it is beyond float32, NaN for NaN. */
function exp(x) {
  const power = Math.max(f32(x * LOG2_E), SMALLEST_POWER), whole = power + TO_WHOLE - TO_WHOLE, rest = power - whole;
  let value = E5;
  value = fused(value, rest, E4);
  value = fused(value, rest, E3);
  value = fused(value, rest, E2);
  value = fused(value, rest, E1);
  value = fused(value, rest, E0);
  return value * POWERS[whole + 127];
}

const tanh = (x) => f32(1 - f32(2 / f32(exp(f32(2 * Math.min(Math.max(x, -LARGEST_TANH), LARGEST_TANH))) + 1)));

/** Row `at` of a 3×3 `a` times (x, y, z). */
const row = (a, at, x, y, z) => fused(a[at + 2], z, fused(a[at], x, f32(a[at + 1] * y)));

/** (x, y, z) times column `at` of a 3×3 `b`. */
const column = (x, y, z, b, at) => fused(z, b[at + 6], fused(x, b[at], f32(y * b[at + 3])));

/** a·b − c·d. */
const minor = (a, b, c, d) => fused(a, b, -f32(c * d));

export class RestPose {
  /** What does not depend on the pose: `neighbours`, `weights` [N·K], `template` [N·J] logs of skinning weights, `points`,
   *  `normals` [N·3], `factors` [N·9], `limbs` [N·7]; `limits` [3]: the largest offset m, the floor m², the fallback. */
  constructor(count, [neighbours, weights, template, points, factors, normals, limbs, limits]) {
    Object.assign(this, { count, neighbours, weights, template, points, factors, normals, limbs, limits });
    this.posed = [3, 6, 3, HARMONICS].map((width) => new Float32Array(width * count));
    this.#aboveTheFloor();
  }

  /** The floor of the template's weights [N], and of every Gaussian the joints that have more: from `starts[i]` on, with the
   *  logs of what is above. */
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

  /** Means, covariances, normals and visibility of node fields offsets [M·6], visibility [M·S] and logits [M·J], which may
   *  be missing, under `bones` [J·12]; in arrays that the next call fills anew. */
  pose([offsets, visibility, logits], bones) {
    const { count, limbs } = this, terms = 6 * visibility.length / offsets.length;
    const [means, covariances, normals, harmonics] = this.posed;
    const nodes = offsets.length / 6, joints = bones.length / 12;
    const changes = logits ?? new Float32Array(nodes * joints), blends = blendsOf(changes, nodes, joints, bones);
    for (let i = 0; i < count; i++) {
      this.#blend(i, blends, changes, joints, bones);
      for (let k = 0; k < 9; k++) linear[k] = blend[k + (k > 5 ? 2 : k > 2 ? 1 : 0)];
      cofactorsOf(linear, cofactors);
      this.#between(offsets, 6, i, moved, 0);
      for (let k = 0; k < 6; k++) moved[k] = tanh(moved[k]);
      this.#between(visibility, terms, i, harmonics, HARMONICS * i);
      const at = 7 * i, kappa = f32(limbs[at + 6] * widening(linear, cofactors, limbs[at], limbs[at + 1], limbs[at + 2]));
      this.#mean(i, linear, blend, moved, kappa, means);
      this.#covariance(i, linear, moved, kappa, covariances);
      this.#normal(i, linear, cofactors, kappa, normals);
    }
    return this.posed;
  }

  #mean(i, a, blend, moved, kappa, means) {
    const { points, limbs } = this, [largest] = this.limits, p = 3 * i, lever = 7 * i + 3;
    const x = fused(kappa, limbs[lever], fused(largest, moved[0], points[p]));
    const y = fused(kappa, limbs[lever + 1], fused(largest, moved[1], points[p + 1]));
    const z = fused(kappa, limbs[lever + 2], fused(largest, moved[2], points[p + 2]));
    for (let k = 0; k < 3; k++) means[p + k] = row(a, 3 * k, x, y, z) + blend[4 * k + 3];
  }

  #covariance(i, a, moved, kappa, covariances) {
    const { limbs } = this, floor = this.limits[1], at = 7 * i, ux = limbs[at], uy = limbs[at + 1], uz = limbs[at + 2];
    const f = posedFactor, wide = f32(1 + kappa);
    turned(moved, this.factors, 9 * i, factor);
    for (let c = 0; c < 3; c++) {
      const along = column(f32(kappa * ux), f32(kappa * uy), f32(kappa * uz), factor, c);
      factor[c] = minor(wide, factor[c], ux, along);
      factor[3 + c] = minor(wide, factor[3 + c], uy, along);
      factor[6 + c] = minor(wide, factor[6 + c], uz, along);
    }
    for (let r = 0; r < 9; r += 3)
      for (let c = 0; c < 3; c++) f[r + c] = column(a[r], a[r + 1], a[r + 2], factor, c);
    const k = 6 * i;
    covariances[k] = fused(f[2], f[2], fused(f[0], f[0], f32(f[1] * f[1]))) + floor;
    covariances[k + 1] = fused(f[2], f[5], fused(f[0], f[3], f32(f[1] * f[4])));
    covariances[k + 2] = fused(f[2], f[8], fused(f[1], f[7], f32(f[0] * f[6])));
    covariances[k + 3] = fused(f[5], f[5], fused(f[3], f[3], f32(f[4] * f[4]))) + floor;
    covariances[k + 4] = fused(f[5], f[8], fused(f[4], f[7], f32(f[3] * f[6])));
    covariances[k + 5] = squared(f[6], f[7], f[8]) + floor;
  }

  #normal(i, a, cofactors, kappa, normals) {
    const { normals: rest, limbs } = this, fallback = this.limits[2], p = 3 * i, at = 7 * i;
    const along = f32(kappa * row(limbs, at, rest[p], rest[p + 1], rest[p + 2]));
    const x = fused(limbs[at], along, rest[p]), y = fused(limbs[at + 1], along, rest[p + 1]), z = fused(limbs[at + 2], along, rest[p + 2]);
    const u = fused(fallback, row(a, 0, x, y, z), row(cofactors, 0, x, y, z));
    const v = fused(fallback, row(a, 3, x, y, z), row(cofactors, 3, x, y, z));
    const w = fused(fallback, row(a, 6, x, y, z), row(cofactors, 6, x, y, z));
    const scale = f32(1 / Math.max(f32(Math.sqrt(squared(u, v, w))), SHORTEST));
    normals[p] = u * scale;
    normals[p + 1] = v * scale;
    normals[p + 2] = w * scale;
  }

  /** Fields [width] of Gaussian i in `fields` [M·width], to `out` from `at` on. */
  #between(fields, width, i, out, at) {
    const { neighbours, weights } = this, own = neighbours.length / this.count, last = own * (i + 1);
    let near = own * i, from = width * neighbours[near], weight = weights[near];
    for (let j = 0; j < width; j++) out[at + j] = weight * fields[from + j];
    while (++near < last) {
      from = width * neighbours[near];
      weight = weights[near];
      for (let j = 0; j < width; j++) out[at + j] = weight * fields[from + j] + out[at + j];
    }
  }

  /** [A_R | A_T] of Gaussian i, to `blend`: the floor's, interpolated between the nodes, and its own joints'. */
  #blend(i, blends, changes, joints, bones) {
    const { neighbours, weights, floors } = this, own = neighbours.length / this.count, first = own * i, last = first + own;
    this.#between(blends, TERMS, i, between, 0);
    const greatest = between[GREATEST], floor = floors[i];
    for (let k = 0; k <= SUM; k++) between[k] *= floor;
    for (let k = this.starts[i], end = this.starts[i + 1]; k < end; k++) {
      const log = this.logs[k], joint = this.joints[k], bone = 12 * joint;
      let change = -greatest;
      for (let near = first; near < last; near++) change = fused(weights[near], changes[joints * neighbours[near] + joint], change);
      const share = log < 0.5 * NEVER ? 0 : f32(exp(f32(change + log)));
      for (let c = 0; c < SUM; c++) between[c] = share * bones[bone + c] + between[c];
      between[SUM] += share;
    }
    const scale = f32(1 / between[SUM]);
    for (let c = 0; c < SUM; c++) blend[c] = between[c] * scale;
  }
}

/** Of every node what is interpolated for the floor, [M·14]. */
function blendsOf(changes, nodes, joints, bones) {
  const blends = new Float32Array(TERMS * nodes);
  for (let m = 0; m < nodes; m++) {
    const from = joints * m, at = TERMS * m;
    let greatest = changes[from];
    for (let j = 1; j < joints; j++) greatest = Math.max(greatest, changes[from + j]);
    for (let j = 0; j < joints; j++) {
      const share = f32(exp(f32(changes[from + j] - greatest)));
      for (let c = 0; c < SUM; c++) blends[at + c] = share * bones[12 * j + c] + blends[at + c];
      blends[at + SUM] += share;
    }
    blends[at + GREATEST] = greatest;
  }
  return blends;
}

/** det(A) A⁻ᵀ. */
function cofactorsOf(a, cofactors) {
  cofactors[0] = minor(a[4], a[8], a[5], a[7]);
  cofactors[1] = minor(a[5], a[6], a[3], a[8]);
  cofactors[2] = minor(a[3], a[7], a[4], a[6]);
  cofactors[3] = minor(a[7], a[2], a[8], a[1]);
  cofactors[4] = minor(a[8], a[0], a[6], a[2]);
  cofactors[5] = minor(a[6], a[1], a[7], a[0]);
  cofactors[6] = minor(a[1], a[5], a[2], a[4]);
  cofactors[7] = minor(a[2], a[3], a[0], a[5]);
  cofactors[8] = minor(a[0], a[4], a[1], a[3]);
}

const squared = (x, y, z) => fused(z, z, fused(y, y, f32(x * x)));

/** |M u|². */
const square = (m, ux, uy, uz) => squared(row(m, 0, ux, uy, uz), row(m, 3, ux, uy, uz), row(m, 6, ux, uy, uz));

/** By how much a blend is to be widened about the limb's axis u, less 1. */
function widening(a, cofactors, ux, uy, uz) {
  const length = Math.max(square(a, ux, uy, uz), SMALLEST_SQUARE);
  const kept = Math.min(f32(f32(Math.sqrt(square(cofactors, ux, uy, uz))) / length), 1);
  // three steps of Newton–Schulz
  const first = f32(0.5 * f32(3 - kept)), once = f32(f32(kept * first) * first);
  const second = f32(0.5 * f32(3 - once)), third = f32(0.5 * fused(-f32(once * second), second, 3));
  return fused(f32(first * second), third, -1);
}

/** R(v) F [9] with v in `moved`, from 3 on; R of the quaternion normalize(1, v/2). */
function turned(moved, factors, at, out) {
  const x = f32(0.5 * moved[3]), y = f32(0.5 * moved[4]), z = f32(0.5 * moved[5]);
  const xx = f32(x * x), yy = f32(y * y), zz = f32(z * z), xy = f32(x * y), xz = f32(x * z), yz = f32(y * z);
  const scale = f32(2 / f32(f32(f32(1 + xx) + yy) + zz)), times = (value) => f32(scale * f32(value));
  const r0 = fused(-scale, f32(yy + zz), 1), r1 = times(xy - z), r2 = times(xz + y);
  const r3 = times(xy + z), r4 = fused(-scale, f32(xx + zz), 1), r5 = times(yz - x);
  const r6 = times(xz - y), r7 = times(yz + x), r8 = fused(-scale, f32(xx + yy), 1);
  for (let c = 0; c < 3; c++) {
    out[c] = fused(r2, factors[at + 6 + c], fused(r1, factors[at + 3 + c], f32(r0 * factors[at + c])));
    out[3 + c] = column(r3, r4, r5, factors, at + c);
    out[6 + c] = column(r6, r7, r8, factors, at + c);
  }
}
