// avatar.onnx: metadata, skeleton, and posing by onnxruntime and posing.js (rnd_runtime/avatar, motion/skeleton.py).

import * as ort from "./ort/ort.wasm.min.mjs";
import {
  ADVICE_KEY, CONSTANT_OUTPUTS, LARGEST_ALBEDO, METADATA_KEY, MIN_PIXELS_PER_METRE, NODE_LOGITS, NODE_OUTPUTS, POSED_OUTPUTS, REST_OUTPUTS,
  SCHEMA,
} from "../constants.js";
import { refusal } from "../errors.js";
import { shareTwists } from "./forearm.js";
import { Levels } from "./levels.js";
import { motionWindow, poseAt } from "../motion/motion.js";
import { OnnxFile } from "../files/onnx.js";
import { RestPose } from "./posing.js";
import { multiply, rotate } from "../rotations.js";

const EVERYTHING = -2;  // below every n·v
const MAKING = 0.02;  // s that the levels of detail which are still missing may take of a frame

export class Avatar {
  /** Read the file; other files are refused. */
  static async load(bytes, name) {
    const file = new OnnxFile(bytes), text = file.metadata.get(METADATA_KEY);
    if (!text) throw new Error(`${name} is not an RnD avatar`);
    const about = JSON.parse(text);
    if (about.schema !== SCHEMA) throw new Error(`${name}: schema ${about.schema}, expected ${SCHEMA}`);
    ort.env.wasm.wasmPaths = new URL("./ort/", import.meta.url).href;
    // threads need the headers COOP and COEP, which static hosts may not send
    ort.env.wasm.numThreads = globalThis.crossOriginIsolated ? Math.min(navigator.hardwareConcurrency, 4) : 1;
    const avatar = new Avatar();
    avatar.name = name;
    avatar.cull = advisedCull(file);
    avatar.gaussians = about.gaussians;
    avatar.windowPoses = about.window_poses;
    avatar.windowSeconds = about.window_seconds;
    const { names, parents, rest_joints: rest } = about.skeleton;
    avatar.skeleton = { names, parents, rest: Float64Array.from(rest.flat()) };
    avatar.trainedLight = new Float32Array(Uint8Array.from(atob(about.trained_light), (c) => c.charCodeAt(0)).buffer);
    [avatar.opacities, avatar.albedo, avatar.roughness] = await constants(file, CONSTANT_OUTPUTS);
    avatar.albedo.forEach((value, k) => { avatar.albedo[k] = Math.min(value, LARGEST_ALBEDO); });
    const posesItself = [...NODE_OUTPUTS, ...REST_OUTPUTS].every((name) => file.outputs.has(name));
    avatar.outputs = posesItself ? [...NODE_OUTPUTS, NODE_LOGITS].filter((name) => file.outputs.has(name)) : POSED_OUTPUTS;
    if (posesItself) {
      const known = await constants(file, REST_OUTPUTS);
      avatar.rest = new RestPose(about.gaussians, known);
      avatar.spacing = about.spacing_m;
      avatar.dynamicNodes = about.variant?.dynamic_nodes ?? 0;
    }
    [avatar.session, avatar.inputs] = await sessionOf(file, avatar.outputs);
    return avatar;
  }

  /** Release onnxruntime's memory; the avatar is unusable afterwards. */
  release() { return this.session.release(); }

  /** Outputs of the networks at `time` of `motion`, for `posed`. */
  async encode(motion, time) {
    const { window, velocity } = motionWindow(motion, time, this.windowPoses, this.windowSeconds);
    const now = poseAt(motion, time);
    const joints = boneTransforms(this.skeleton, now.rotations, now.translation).joints;
    const place = this.skeleton.rest.subarray(0, 3), rotation = now.rotations.slice(0, 9), turned = rotate(rotation, place);
    const root = { rotation, translation: turned.map((value, k) => place[k] + now.translation[k] - value) };
    now.rotations.set([1, 0, 0, 0, 1, 0, 0, 0, 1]);
    shareTwists(this.skeleton, now.rotations);
    const { bones } = boneTransforms(this.skeleton, now.rotations, [0, 0, 0]);
    const count = this.skeleton.names.length, others = count - 1;
    const given = {
      pose_window: new ort.Tensor("float32", window, [this.windowPoses, others, 6]),
      joint_velocity: new ort.Tensor("float32", velocity, [others, 3]),
      bone_transforms: new ort.Tensor("float32", bones, [count, 3, 4]),
    };
    const taken = Object.fromEntries(this.inputs.map((name) => [name, given[name]]));
    const made = await this.session.run(taken, this.outputs);
    return { values: this.outputs.map((name) => made[name].data), bones, root, joints };
  }

  /** The level of detail, see `Levels`, for what was encoded at `size` pixels per metre; null: the avatar itself. */
  level({ values }, size) {
    if (!this.rest) return null;
    const { rest, opacities, albedo, roughness, spacing, cull, dynamicNodes, gaussians: count } = this, nodes = values[0].length / 6;
    const fewer = [0, nodes].includes(dynamicNodes) && nodes !== count;
    this.levels ??= new Levels({ ...rest, opacities, albedo, roughness }, { spacing, nodes, fewer, cull });
    return this.levels.at(size, MAKING);
  }

  /** The Gaussians of what was encoded, as rnd_runtime/core/gaussians.py has them, in the frame of the `root`: {rotation [9],
   *  translation [3]} → world; `rootJoints` [J·3] m in that frame, `joints` [J·3] m in the world. At a `level` of detail they
   *  are fewer, and its shadows and pixels coarser: `detail` of the avatar's along each side, `least` pixels per metre (see `fineView`). */
  posed({ values, bones, root, joints }, level = null) {
    const { rest, opacities, albedo, roughness, cull } = level ?? this, fields = level ? values.map((value) => level.ofItsNodes(value)) : values;
    const posed = rest ? rest.pose(fields, bones) : values, rootJoints = moved(bones, this.skeleton.rest);
    const detail = level ? this.spacing / level.spacing : 1, least = level ? Math.min(1 / level.spacing, MIN_PIXELS_PER_METRE) : MIN_PIXELS_PER_METRE;
    const outputs = Object.fromEntries(POSED_OUTPUTS.map((name, k) => [name, posed[k]]));
    return { count: opacities.length, ...outputs, opacities, albedo, roughness, cull, detail, least, root, rootJoints, joints };
  }
}

/** The n·v of the file's advice below which Gaussians are culled (PlayerAdvice of rnd_runtime/avatar/file.py). */
function advisedCull(file) {
  const advice = JSON.parse(file.metadata.get(ADVICE_KEY) ?? "{}"), cull = advice?.cull ?? -1;
  if (advice?.constructor !== Object || !(typeof cull === "number" && cull >= -1 && cull <= 1))
    throw refusal("metadata 'rnd_player'", { expected: "an object whose cull is -1 to 1", got: JSON.stringify(advice) });
  return cull > -1 ? cull : EVERYTHING;
}

/** A session that computes only `outputs` of `file`, and the names of its inputs. */
async function sessionOf(file, outputs) {
  const { model, inputs } = file.cut(outputs);
  return [await ort.InferenceSession.create(model, { executionProviders: ["wasm"], graphOptimizationLevel: "all" }), inputs];
}

/** Constant values of `file`. */
async function constants(file, names) {
  const [session] = await sessionOf(file, names);
  try {
    const values = await session.run({}, names);
    return names.map((name) => values[name].data.slice());
  } finally {
    await session.release();
  }
}

/** Bones [J·12], rest pose → posed, and joint positions [J·3]. */
function boneTransforms(skeleton, rotations, translation) {
  const { parents, rest } = skeleton, count = parents.length;
  const turns = new Float64Array(9 * count), joints = new Float64Array(3 * count), bones = new Float32Array(12 * count);
  for (let k = 0; k < count; k++) {
    const parent = parents[k];
    if (parent < 0) {
      turns.set(rotations.subarray(0, 9), 0);
      for (let i = 0; i < 3; i++) joints[i] = rest[i] + translation[i];
    } else {
      multiply(turns, 9 * parent, rotations, 9 * k, turns, 9 * k);
      for (let i = 0; i < 3; i++) {
        joints[3 * k + i] = joints[3 * parent + i];
        for (let j = 0; j < 3; j++) joints[3 * k + i] += turns[9 * parent + 3 * i + j] * (rest[3 * k + j] - rest[3 * parent + j]);
      }
    }
    for (let i = 0; i < 3; i++) {
      let shift = joints[3 * k + i];
      for (let j = 0; j < 3; j++) {
        bones[12 * k + 4 * i + j] = turns[9 * k + 3 * i + j];
        shift -= turns[9 * k + 3 * i + j] * rest[3 * k + j];
      }
      bones[12 * k + 4 * i + 3] = shift;
    }
  }
  return { bones, joints };
}

/** Joints `rest` [J·3] moved by `bones` [J·12]. */
function moved(bones, rest) {
  return rest.map((_, at) => {
    const k = 3 * Math.floor(at / 3), row = 4 * k + 4 * (at % 3);
    return bones[row] * rest[k] + bones[row + 1] * rest[k + 1] + bones[row + 2] * rest[k + 2] + bones[row + 3];
  });
}

/** Joint positions [J·3] m at `time`. */
export function jointsAt(skeleton, motion, time) {
  const now = poseAt(motion, time);
  return boneTransforms(skeleton, now.rotations, now.translation).joints;
}
