// Reads files and renders states; states and answers are those of rnd-view.

import { CLAY, COSINE_LOBE, LARGEST_SKY, MARGIN, NEAR, PROBE_SHAPE } from "./constants.js";
import { taken } from "./arrays.js";
import { Avatar } from "./posing/avatar.js";
import { cameraOf } from "../../rnd_viewer/view/page/camera.js";
import { homeView, inFrame, projectJoints } from "./camera.js";
import { inFile, refusal } from "./errors.js";
import { groundLight, groundOf, groundShadow } from "./ground/ground.js";
import { brightestDirection, downsize, lightNotes, readLight } from "./shading/light.js";
import { fitMotion, restMotion } from "./motion/motion.js";
import { readMotionFile } from "./files/motion_files.js";
import { fineView } from "./raster/far.js";
import { project } from "./raster/project.js";
import { multiply, transposed } from "./rotations.js";
import { shBasis } from "./shading/sh.js";
import { makeShader } from "./shading/shader.js";
import { Splatter } from "./raster/splat.js";

const SIZE = [512, 512], SIZES = [64, 1024], PICTURE = 2048;  // px: default, least and largest; of a saved image

// of a camera that sees no ground
const NO_SHADOW = Object.fromEntries(["ground", "sun0", "sun1"].map((name) => [`to_${name}`, new Float32Array(9)]));

let splatter = new Splatter();
// record: the motion in its file's axes (null: at rest); ground: its height m, once drawn; lights: {name, light, notes, shaders: Map of
// shade → function, ground: once drawn}
let scene = { avatar: null, record: null, motion: null, ground: null, lights: [] };
let posed = null, shownSky = null;

/** Load files [{name, bytes}], all or none, and post the new scene. */
async function load(files) {
  const before = scene, next = { ...scene, ground: null }, opened = [];
  let answer = null;
  try {
    for (const file of files) await take(file, next, opened).catch((error) => { throw inFile(error, file.name); });
    if (next.avatar) {
      const { skeleton } = next.avatar;
      next.motion = next.record ? fitMotion(next.record, skeleton) : restMotion(skeleton);
      const count = next.lights.length, dropped = files.some(({ name }) => /\.(hdr|exr)$/i.test(name));
      let light;  // undefined: unchanged
      if (!before.avatar && count > 1) light = 1;  // as in rnd-view: the first but the avatar's own
      else if (dropped) light = count - 1;
      answer = { kind: "scene", scene: description(next, light) };
    }
    const light = next.lights.map(({ name }) => name).join(", ");
    answer ??= { kind: "held", held: { motion: next.record?.name, light }, text: "an avatar (.onnx) is still missing" };
    scene = next;
    posed = null;
  } finally {
    for (const avatar of [before.avatar, ...opened]) if (avatar && avatar !== scene.avatar) await avatar.release();
  }
  postMessage(answer);
}

/** Read one file into the scene `next`; avatars go to `opened` too. */
async function take({ name, bytes }, next, opened) {
  const kind = name.toLowerCase().split(".").pop();
  if (kind === "onnx") {
    next.avatar = await Avatar.load(bytes, name);
    opened.push(next.avatar);
    const own = { height: PROBE_SHAPE[0], width: PROBE_SHAPE[1], radiance: next.avatar.trainedLight }, others = next.lights.filter((light) => !light.own);
    next.lights = [{ own: true, ...lightEntry("the avatar's own", own) }, ...others];
  } else if (kind === "npz") next.record = readMotionFile(bytes, name);
  else if (kind === "hdr" || kind === "exr") {
    next.lights = [...next.lights.filter((light) => light.own || light.name !== name), lightEntry(name, readLight(bytes, name))];
  } else throw refusal("kind of file", { expected: ".onnx, .npz, .hdr or .exr", got: `.${kind}`, file: name });
}

const lightEntry = (name, light) => ({ name, light, notes: lightNotes(light), sun: brightestDirection(light), shaders: new Map() });

/** The scene for the page; `light` is the index of the new light, undefined if unchanged. */
function description({ avatar, motion, lights }, light) {
  return {
    avatar: avatar.name, gaussians: avatar.gaussians, parents: avatar.skeleton.parents,
    motion: { name: motion.name, duration: motion.duration, fps: motion.fps },
    lights: lights.map(({ name }) => name), light,
    head: avatar.skeleton.names.indexOf("head"), fit: true, size: SIZE, sizes: SIZES, picture: PICTURE, raster: splatter.name, view: homeView(avatar.skeleton, motion),
    truths: [], ground: true, notes: motion.notes,
  };
}

async function render({ number, state }) {
  const clock = lap(), { avatar, motion } = scene, lit = state.output === "lit" || state.output === "light";
  const grounded = lit && state.ground && state.background !== "none";
  if (grounded && scene.ground === null) {
    posed = null;  // whose arrays it fills
    scene.ground = await groundOf(avatar, motion);
    clock("ground");
  }
  if (!posed || posed.time !== state.time) {
    posed = { time: state.time, encoded: await avatar.encode(motion, state.time) };
    clock("encoders");
  }
  const camera = cameraOf(state), level = state.gaussians === null ? avatar.level(posed.encoded, sizeOf(camera, posed.encoded.joints)) : null;
  if (!posed.gaussians || posed.level !== level) {
    Object.assign(posed, { level, gaussians: avatar.posed(posed.encoded, level) });
    clock("posing");
  }
  const whole = posed.gaussians.count, count = Math.min(state.gaussians ?? whole, whole), grown = whole / count;
  const gaussians = fewer(posed.gaussians, count), beside = inFrame(camera, gaussians.root);
  const features = lit
    ? radianceOf(state, gaussians, count, beside.position, grown) : material(state.output, gaussians, count, beside);
  clock("shading");
  const view = fineView(beside, gaussians.rootJoints, gaussians.least), records = project(gaussians, count, features, view.camera, grown, gaussians.cull);
  clock("sorting");
  if (splatter.isLost()) {  // the driver was reset
    splatter = new Splatter();
    shownSky = null;
  }
  const shadow = grounded ? shadowOf(state, posed.gaussians, beside) : null;
  if (shadow) splatter.setGround(shadow.maps);
  if (grounded) clock("ground");
  splatter.draw(records, view, state.width, state.height, { ...look(state, camera), ...NO_SHADOW, ...shadow?.uniforms });
  if (splatter.isLost()) throw new Error("the browser took WebGL2 away while it drew; it is asked for again with the next frame");
  const image = splatter.canvas.transferToImageBitmap();
  clock("splatting");
  const joints = projectJoints(gaussians.joints, camera);
  const { notes, sun } = scene.lights[state.light];
  const answer = { kind: "frame", number, width: state.width, height: state.height, image, joints, notes, sun, gaussians: count, times: clock.times };
  postMessage(answer, [image]);
}

/** Pixels per metre at a body with `joints` [J·3] m in the world, the first of which is the root's; Infinity where it is too near. */
function sizeOf({ rotation: r, translation: t, focal }, [x, y, z]) {
  const depth = r[6] * x + r[7] * y + r[8] * z + t[2] - MARGIN;
  return depth > NEAR ? focal / depth : Infinity;
}

/** `count` Gaussians at even steps through the file, which is in spatial order. */
function fewer(gaussians, count) {
  const total = gaussians.count, kept = { ...gaussians, count };
  if (count === total) return gaussians;
  const rows = Int32Array.from({ length: count }, (_, i) => Math.floor(i * total / count));
  for (const name of ["means", "covariances", "normals", "visibility", "opacities", "albedo", "roughness"])
    kept[name] = taken(gaussians[name], gaussians[name].length / total, rows);
  return kept;
}

function radianceOf(state, gaussians, count, eye, grown) {
  const entry = scene.lights[state.light];
  if (!entry.shaders.has(state.shade)) entry.shaders.set(state.shade, makeShader(entry.light, state.shade));
  const shown = state.output === "light" ? { ...gaussians, albedo: new Float32Array(3 * count).fill(CLAY) } : gaussians;
  const lightToRoot = new Float64Array(9);
  multiply(transposed(gaussians.root.rotation), 0, lightToWorld(state.yaw), 0, lightToRoot, 0);
  const radiance = entry.shaders.get(state.shade)(shown, count, eye, lightToRoot, grown);
  const gain = 2 ** state.exposure;
  return gain === 1 ? radiance : radiance.map((value) => value * gain);
}

/** Three features [count·3] of a material map. */
function material(output, { albedo, normals, roughness, visibility }, count, { rotation }) {
  if (output === "albedo") return albedo;
  const features = new Float32Array(3 * count), basis = new Float64Array(16);
  for (let i = 0; i < count; i++) {
    const [x, y, z] = normals.subarray(3 * i, 3 * i + 3);
    if (output === "normal")
      for (let k = 0; k < 3; k++) features[3 * i + k] = rotation[3 * k] * x + rotation[3 * k + 1] * y + rotation[3 * k + 2] * z;
    else if (output === "roughness") features[3 * i] = roughness[i];
    else {
      shBasis(x, y, z, basis);
      let sum = 0;
      for (let j = 0; j < 16; j++) sum += visibility[16 * i + j] * COSINE_LOBE[j] * basis[j];
      features[3 * i] = Math.min(Math.max(sum, 0), 1);
    }
  }
  return features;
}

/** Of the whole body, as in rnd-view. */
function shadowOf(state, gaussians, camera) {
  const entry = scene.lights[state.light];
  entry.ground ??= groundLight(entry.light);
  return groundShadow(entry.ground, gaussians, camera, scene.ground, lightToWorld(state.yaw));
}

/** Uniforms of blend.frag. */
function look(state, { rotation: r, focal, width, height }) {
  const show = { normal: 1, roughness: 2, visibility: 2 }[state.output] ?? 0, gain = 2 ** state.exposure;
  const curved = Number(state.tone === "neutral" && state.output !== "albedo");
  if (state.background !== "hdr") {
    const hex = /^#([0-9a-f]{2})([0-9a-f]{2})([0-9a-f]{2})$/i.exec(state.background);
    return { show, curved, background: 0, colour: hex ? hex.slice(1).map((text) => linear(parseInt(text, 16) / 255)) : [0, 0, 0] };
  }
  if (shownSky !== scene.lights[state.light]) {
    shownSky = scene.lights[state.light];
    const { light } = shownSky;
    splatter.setSky(light.height > LARGEST_SKY ? downsize(light, LARGEST_SKY, 2 * LARGEST_SKY) : light);
  }
  const rotation = lightToWorld(state.yaw), pixelToLight = [];
  for (let row = 0; row < 3; row++) {  // lightToWorldᵀ · rotationᵀ · K⁻¹
    const [x, y, z] = [0, 1, 2].map((axis) => rotation[row] * r[3 * axis] + rotation[3 + row] * r[3 * axis + 1] + rotation[6 + row] * r[3 * axis + 2]);
    pixelToLight.push(x / focal, y / focal, z - (x * width + y * height) / 2 / focal);
  }
  return { show, curved, background: 1, gain, pixel_to_light: pixelToLight };
}

const linear = (srgb) => (srgb <= 0.04045 ? srgb / 12.92 : ((srgb + 0.055) / 1.055) ** 2.4);

/** Rotates the light about +Y, from +X towards +Z. */
function lightToWorld(yaw) {
  const c = Math.cos(yaw), s = Math.sin(yaw);
  return [c, 0, -s, 0, 1, 0, s, 0, c];
}

function lap() {
  let last = performance.now();
  const clock = (name) => {
    const now = performance.now();
    clock.times[name] = now - last;
    last = now;
  };
  clock.times = {};
  return clock;
}

let queue = Promise.resolve();  // one at a time, in order
onmessage = ({ data }) => {
  queue = queue.then(() => (data.ask === "load" ? load(data.files) : render(data)))
    .catch((error) => postMessage({ kind: "error", number: data.number, message: error.message ?? String(error) }));
};
