// Coarser versions of an avatar, for bodies of few pixels (formulas in rnd_runtime/posing/levels.py).

import {
  COLOUR_WEIGHT, CULLED_LEVELS, CURVE_BITS, GROWTH, KEPT, LEVEL_SPACING, MIN_COSINE, MIN_GAUSSIANS, NODE_SPACING, PARTNER_REACH,
  PARTNER_WINDOW,
} from "../constants.js";
import { median, taken } from "../arrays.js";
import { principalAxes } from "../rotations.js";
import { onFewerNodes } from "./fewer_nodes.js";
import { RestPose } from "./posing.js";

// Numbers of a Gaussian in each array of a surface; neighbours, their weights and the template are as wide as the avatar has them
const WIDTHS = { points: 3, normals: 3, factors: 9, limbs: 7, opacities: 1, albedo: 3, roughness: 1 };
const MEANS = ["points", "normals", "opacities", "albedo", "roughness"];  // the other arrays of a pair are the heavier one's

/**
 * Levels with fewer Gaussians, the nodes of the last of CULLED_LEVELS and its culling; made one after another, when they are needed.
 * A pair that is merged becomes one more row of the arrays, and a level is a list of rows.
 */
export class Levels {
  /** Of a `surface`: {count, neighbours, weights, template, limits, …WIDTHS}, whose Gaussians are `spacing` m apart; `nodes`: how many
   *  the networks have, `fewer`: whether some may be left out; `cull`: the avatar's. */
  constructor(surface, { spacing, nodes, fewer, cull }) {
    const [share, least] = fewer ? CULLED_LEVELS.at(-1) : [1, cull];
    Object.assign(this, { surface, spacing, nodes, share, cull: Math.max(cull, least) });
    const coarser = (each) => NODE_SPACING / (spacing * Math.sqrt(surface.count / Math.ceil(nodes / each)));
    this.greatest = fewer ? Math.min(...CULLED_LEVELS.map(([each]) => coarser(each))) : Infinity;
    this.lists = [Int32Array.from({ length: surface.count }, (_, i) => i)];
    this.chosen = null;
  }

  /** The level for a body of `size` pixels per metre, of those that can be made within `seconds`; null: the whole avatar. */
  at(size, seconds) {
    const deadline = performance.now() + 1000 * seconds;
    if (!(size < LEVEL_SPACING / this.spacing)) return null;
    while (size <= this.#greatest(this.lists.length - 1) && performance.now() < deadline && this.#add());
    let number = this.lists.length - 1;
    while (number && size > this.#greatest(number)) number--;
    if (!number) return null;
    if (this.chosen?.number !== number) this.chosen = this.#made(number);
    return this.chosen;
  }

  /** Pixels per metre up to which a level may be taken. */
  #greatest(number) { return Math.min(LEVEL_SPACING / this.#spacing(number), this.greatest); }

  #spacing(number) { return this.spacing * Math.sqrt(this.surface.count / this.lists[number].length); }

  /** Make one more level; false where there is none. */
  #add() {
    const rows = this.lists.at(-1);
    if (rows.length <= MIN_GAUSSIANS) return false;
    this.pool ??= this.#grown();
    const pairs = pairsOf(this.pool, rows), gone = new Set(pairs.map(([, b]) => b)), merged = new Map();
    for (const [a, b] of pairs) merged.set(a, this.#merge(rows[a], rows[b]));
    const left = rows.map((row, i) => merged.get(i) ?? row).filter((_, i) => !gone.has(i));
    if (left.length === rows.length) return false;
    this.lists.push(left);
    return true;
  }

  /** The surface's arrays on fewer nodes, with room for all pairs that may come. */
  #grown() {
    const { surface, share } = this, onNodes = share > 1 ? onFewerNodes(surface, this.nodes, share) : surface, pool = { count: surface.count };
    this.widths = { ...WIDTHS };
    for (const name of ["neighbours", "weights", "template"]) this.widths[name] = onNodes[name].length / surface.count;
    for (const [name, width] of Object.entries(this.widths)) {
      pool[name] = new onNodes[name].constructor(2 * width * surface.count);
      pool[name].set(onNodes[name]);
    }
    return pool;
  }

  /** A row of the pair of rows `a` and `b`. */
  #merge(a, b) {
    const { pool } = this, row = pool.count++, first = covariance(pool.factors, a), second = covariance(pool.factors, b);
    const areas = [first, second].map((square) => area(principalAxes(square).values));
    const weights = [a, b].map((each, k) => Math.max(areas[k] * pool.opacities[each], 1e-30)), share = weights[0] / (weights[0] + weights[1]);
    const heavier = share >= 0.5 ? a : b, mean = (one, other) => share * one + (1 - share) * other;
    const apart = [0, 1, 2].map((c) => pool.points[3 * b + c] - pool.points[3 * a + c]);
    const spread = first.map((value, k) => mean(value, second[k]) + share * (1 - share) * apart[Math.floor(k / 3)] * apart[k % 3]);
    for (const [name, width] of Object.entries(this.widths)) pool[name].copyWithin(width * row, width * heavier, width * (heavier + 1));
    for (const name of MEANS)
      for (let width = WIDTHS[name], c = 0; c < width; c++) pool[name][width * row + c] = mean(pool[name][width * a + c], pool[name][width * b + c]);
    const normal = pool.normals.subarray(3 * row, 3 * row + 3), length = Math.max(Math.hypot(...normal), 1e-9);
    normal.forEach((value, c) => { normal[c] = value / length; });
    const { values, axes } = principalAxes(spread), growth = Math.max((areas[0] + areas[1]) / Math.max(area(values), 1e-30), 1) ** GROWTH;
    for (let k = 0; k < 9; k++) pool.factors[9 * row + k] = axes[k] * Math.sqrt(Math.max(values[k % 3], 0) * (k % 3 ? growth : 1));
    return row;
  }

  /** {number, spacing m, cull, rest, opacities, albedo, roughness, ofItsNodes} of a level; the last takes its nodes' values from all. */
  #made(number) {
    const rows = this.lists[number], arrays = Object.entries(this.widths).map(([name, width]) => [name, taken(this.pool[name], width, rows)]);
    const { neighbours, weights, template, points, normals, factors, limbs, opacities, albedo, roughness } = Object.fromEntries(arrays);
    const rest = new RestPose(rows.length, [neighbours, weights, template, points, factors, normals, limbs, this.surface.limits]);
    const kept = Int32Array.from({ length: Math.ceil(this.nodes / this.share) }, (_, k) => this.share * k);
    const ofItsNodes = (values) => taken(values, values.length / this.nodes, kept);
    return { number, spacing: this.#spacing(number), cull: this.cull, rest, opacities, albedo, roughness, ofItsNodes };
  }
}

/** F · Fᵀ [9] of the factors of a row. */
function covariance(factors, row) {
  const f = factors.subarray(9 * row, 9 * row + 9);
  return Array.from({ length: 9 }, (_, k) => [0, 1, 2].reduce((sum, c) => sum + f[3 * Math.floor(k / 3) + c] * f[3 * (k % 3) + c], 0));
}

/** σ₁ σ₂ of the two greatest of ascending variances [3]. */
const area = ([, middle, greatest]) => Math.sqrt(Math.max(middle * greatest, 0));

/** Places [a, b] in `rows` of each pair that is merged. */
function pairsOf(pool, rows) {
  const order = zCurve(pool.points, rows), count = rows.length;
  const along = order.map((place) => rows[place]), take = (values) => Float64Array.from(taken(values, 3, along));
  const { partner, cost } = match(take(pool.points), take(pool.normals), take(pool.albedo), count), first = [];
  for (let i = 0; i < count; i++) if (partner[i] > i) first.push(i);
  first.sort((a, b) => cost[a] - cost[b]);  // stable
  return first.slice(0, Math.round((1 - KEPT) * count)).map((i) => [order[i], order[partner[i]]]);
}

/** Order of the places in `rows` along a Z-curve (Morton 1966). */
function zCurve(points, rows) {
  const low = [0, 0, 0].fill(Infinity), high = low.map((x) => -x);
  for (const row of rows)
    for (let c = 0; c < 3; c++) {
      low[c] = Math.min(low[c], points[3 * row + c]);
      high[c] = Math.max(high[c], points[3 * row + c]);
    }
  const size = Math.max(...high.map((value, c) => value - low[c]), 1e-9), scale = (2 ** CURVE_BITS - 1) / size;
  const keys = Float64Array.from(rows, (row, place) => {
    let code = 0;
    for (let c = 0; c < 3; c++) {
      const cell = Math.trunc((points[3 * row + c] - low[c]) * scale);
      for (let bit = 0; bit < CURVE_BITS; bit++) code |= ((cell >> bit) & 1) << (3 * bit + c);
    }
    return code * rows.length + place;
  }).sort();
  return Int32Array.from(keys, (key) => key % rows.length);
}

/** For each point the most alike free one within the window, else −1, and the cost of the pair, m². */
function match(points, normals, albedo, count) {
  const nearest = new Float64Array(count).fill(Infinity), partner = new Int32Array(count).fill(-1), cost = new Float64Array(count).fill(Infinity);
  const squared = (values, i, j) => {
    const x = values[i] - values[j], y = values[i + 1] - values[j + 1], z = values[i + 2] - values[j + 2];
    return x * x + y * y + z * z;
  };
  const alike = (i, j) => normals[i] * normals[j] + normals[i + 1] * normals[j + 1] + normals[i + 2] * normals[j + 2] > MIN_COSINE;
  for (let i = 0; i < count; i++)
    for (let j = i + 1, last = Math.min(i + PARTNER_WINDOW, count - 1); j <= last; j++) {
      if (!alike(3 * i, 3 * j)) continue;
      const square = squared(points, 3 * i, 3 * j);
      if (square < nearest[i]) nearest[i] = square;
      if (square < nearest[j]) nearest[j] = square;
    }
  const reach = PARTNER_REACH * PARTNER_REACH * median(nearest);
  for (let i = 0; i < count; i++) {
    if (partner[i] >= 0) continue;
    let best = reach, chosen = -1;
    for (let j = i + 1, last = Math.min(i + PARTNER_WINDOW, count - 1); j <= last; j++) {
      let square = squared(points, 3 * i, 3 * j);
      if (partner[j] >= 0 || square >= best) continue;
      square *= 1 + COLOUR_WEIGHT * squared(albedo, 3 * i, 3 * j);
      if (square < best && alike(3 * i, 3 * j)) [best, chosen] = [square, j];
    }
    if (chosen < 0) continue;
    partner[i] = chosen;
    partner[chosen] = i;
    cost[i] = cost[chosen] = best;
  }
  return { partner, cost };
}
