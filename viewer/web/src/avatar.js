// avatar.onnx: its metadata, its skeleton, and posing it with onnxruntime (rnd_runtime/avatar_file.py, avatar.py, skeleton.py).

import * as ort from "./ort/ort.wasm.min.mjs";
import { LARGEST_ALBEDO } from "./brdf.js";
import { refusal } from "./errors.js";
import { motionWindow, poseAt } from "./motion.js";
import { multiply, rotate } from "./rotations.js";

const METADATA_PROPS = 14;  // field of onnx.ModelProto: repeated {1: key, 2: value}
const SCHEMA = "rnd-avatar/1";
const POSED = ["means", "covariances", "normals", "visibility"], CONSTANT = ["opacities", "albedo", "roughness"];

// What the metadata may say (AvatarMetadata of rnd_runtime/avatar_file.py): true for a value, an object for one inside.
const FIELDS = {
  schema: true, gaussians: true, spacing_m: true, window_poses: true, window_seconds: true, trained_light: true,
  body_license: true, checkpoint_sha256: true, conventions: true, generator: true,
  skeleton: { names: true, parents: true, rest_joints: true },
  variant: { encoder: true, precision: true, nodes: true, dynamic_nodes: true, visibility_degree: true },
};
const DEFAULTED = ["variant", ...Object.keys(FIELDS.variant)];

export class Avatar {
  /** Read the file; throws with a reason when it is no avatar of ours. */
  static async load(bytes, name) {
    const text = metadata(bytes).get("rnd_avatar");
    if (!text) throw new Error(`${name} is not an RnD avatar`);
    const about = JSON.parse(text);
    if (about.schema !== SCHEMA) throw new Error(`${name}: schema ${about.schema}, expected ${SCHEMA}`);
    checkFields(about, FIELDS, "metadata");
    ort.env.wasm.wasmPaths = new URL("./ort/", import.meta.url).href;
    // Threads need the headers COOP and COEP, which a static host may not send.
    ort.env.wasm.numThreads = globalThis.crossOriginIsolated ? Math.min(navigator.hardwareConcurrency, 4) : 1;
    const avatar = new Avatar();
    avatar.name = name;
    avatar.gaussians = about.gaussians;
    avatar.windowPoses = about.window_poses;
    avatar.windowSeconds = about.window_seconds;
    const { names, parents, rest_joints: rest } = about.skeleton;
    avatar.skeleton = { names, parents, rest: Float64Array.from(rest.flat()) };
    avatar.trainedLight = new Float32Array(Uint8Array.from(atob(about.trained_light), (c) => c.charCodeAt(0)).buffer);
    avatar.session = await ort.InferenceSession.create(bytes, { executionProviders: ["wasm"], graphOptimizationLevel: "all" });
    await avatar.readConstants().catch(async (error) => {
      await avatar.release();
      throw error;
    });
    return avatar;
  }

  /** Give onnxruntime's memory back; the avatar cannot pose any more. */
  release() { return this.session.release(); }

  async readConstants() {
    const joints = this.skeleton.names.length, others = joints - 1;
    const window = Float32Array.from({ length: this.windowPoses * others * 6 }, (_, k) => (k % 6 === 0 || k % 6 === 4 ? 1 : 0));
    const bones = Float32Array.from({ length: joints * 12 }, (_, k) => (k % 12 % 5 === 0 ? 1 : 0));
    const still = await this.run(window, new Float32Array(3 * others), bones, CONSTANT);
    [this.opacities, this.albedo, this.roughness] = CONSTANT.map((name) => still[name].data.slice());
    this.albedo.forEach((value, k) => { this.albedo[k] = Math.min(value, LARGEST_ALBEDO); });
  }

  async run(window, velocity, bones, outputs) {
    const joints = this.skeleton.names.length, others = joints - 1;
    return this.session.run({
      pose_window: new ort.Tensor("float32", window, [this.windowPoses, others, 6]),
      joint_velocity: new ort.Tensor("float32", velocity, [others, 3]),
      bone_transforms: new ort.Tensor("float32", bones, [joints, 3, 4]),
    }, outputs);
  }

  /** The Gaussians at `time` of `motion`, as rnd_runtime/gaussians.py has them, in the frame of the `root`: {rotation [9],
   *  translation [3]} → world; and joints [J·3] m in the world. */
  async pose(motion, time) {
    const { window, velocity } = motionWindow(motion, time, this.windowPoses, this.windowSeconds);
    const now = poseAt(motion, time);
    const joints = boneTransforms(this.skeleton, now.rotations, now.translation).joints;
    const place = this.skeleton.rest.subarray(0, 3), rotation = now.rotations.slice(0, 9), turned = rotate(rotation, place);
    const root = { rotation, translation: turned.map((value, k) => place[k] + now.translation[k] - value) };
    now.rotations.set([1, 0, 0, 0, 1, 0, 0, 0, 1]);
    const { bones } = boneTransforms(this.skeleton, now.rotations, [0, 0, 0]);
    const posed = await this.run(window, velocity, bones, POSED);
    const [means, covariances, normals, visibility] = POSED.map((name) => posed[name].data);
    const { opacities, albedo, roughness } = this;
    return { count: this.gaussians, means, covariances, normals, visibility, opacities, albedo, roughness, root, joints };
  }
}

/** Refuse an object that has other fields than `known`, or lacks one without a default. */
function checkFields(value, known, what) {
  if (value === null || typeof value !== "object") throw refusal(what, { expected: "an object", got: typeof value });
  const strange = Object.keys(value).find((name) => !Object.hasOwn(known, name));
  if (strange !== undefined) throw refusal(what, { got: `unknown field \`${strange}\`` });
  for (const [name, inner] of Object.entries(known)) {
    if (value[name] === undefined) {
      if (!DEFAULTED.includes(name)) throw refusal(what, { got: `no field \`${name}\`` });
    } else if (inner !== true) checkFields(value[name], inner, `${what}.${name}`);
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

/** Joint positions [J·3] m at `time`. */
export function jointsAt(skeleton, motion, time) {
  const now = poseAt(motion, time);
  return boneTransforms(skeleton, now.rotations, now.translation).joints;
}

/** The strings in a model's metadata_props: one walk over the fields of its protocol buffer. */
function metadata(bytes) {
  const found = new Map();
  for (const [field, value] of fields(bytes)) {
    if (field !== METADATA_PROPS || !value) continue;
    const entry = new Map(fields(value));
    const decoder = new TextDecoder();
    if (entry.get(1)) found.set(decoder.decode(entry.get(1)), decoder.decode(entry.get(2) ?? new Uint8Array()));
  }
  return found;
}

/** [field, bytes or null] of a protocol buffer message; null where the field is a number. */
function* fields(bytes) {
  let at = 0;
  const varint = () => {
    let value = 0;
    for (let shift = 1; ; shift *= 128) {
      if (at >= bytes.length) throw new Error("the .onnx file is cut short");
      const byte = bytes[at++];
      value += (byte & 127) * shift;
      if (byte < 128) return value;
    }
  };
  while (at < bytes.length) {
    const tag = varint(), wire = tag % 8, field = Math.floor(tag / 8);
    if (wire === 2) {
      const length = varint();
      if (at + length > bytes.length) throw new Error("the .onnx file is cut short");
      yield [field, bytes.subarray(at, at += length)];
    } else {
      if (wire === 0) varint();
      else if (wire === 1) at += 8;
      else if (wire === 5) at += 4;
      else throw new Error("not an .onnx file");
      yield [field, null];
    }
  }
}
