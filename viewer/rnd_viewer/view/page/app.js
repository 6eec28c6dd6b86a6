// The page: controls define a state, an engine renders it.

import { fitted } from "./camera.js";
import { connect } from "./engine.js";
import { bindFiles, showHeld, showMissing } from "./files.js";
import { Fit } from "./fit.js";
import { lightGizmo } from "./gizmo.js";
import { orbit, wrapped } from "./orbit.js";
import { drawSkeleton } from "./skeleton.js";
import { bindViews } from "./views.js";

const IN_FLIGHT = 2;  // one frame is shown while the next is rendered
const LONG_MS = 1000;  // time after which a pending frame is announced
const MAX_CLIP_FPS = 60;
const RADIANS = Math.PI / 180;
const PICTURE_QUALITY = 0.95;
const SHADES = {
  ao: "ambient occlusion: the fastest, without cast shadows",
  table: "the whole map, with soft shadows",
  "table+sun": "the whole map, and a sun with a highlight and a sharp shadow of its own",
  "lights:16": "16 directional lights in place of the map",
  "lights:128": "128 directional lights in place of the map",
  brute: "every texel of the map: as in training, and slow",
};
const $ = (id) => document.getElementById(id);

const state = {
  time: 0, width: 512, height: 512, azimuth: 0, elevation: 0, distance: 3, target: [0, 1, 0], fov: 0.6,
  light: 0, yaw: 0, exposure: 0, shade: "table+sun", output: "lit", background: "#808080", tone: "srgb", ground: true, gaussians: null, truth: null,
};
let scene = null, engine = null, playing = false, playedSince = 0;
let number = 0, shown = 0, wanted = false, flying = new Map();
let waiting = [];  // {number, done, failed} of awaited frames
let clipMade = null;  // while a clip is made: {promise, resolve} of its end
let times = {}, rates = [], shownAt = 0;
let passing = true, fading = 0;  // the next frame clears the message; or a timer does
let joints = [];  // of the last frame, px of the state's size
const fit = new Fit($("stage").firstElementChild, state, redraw);

const views = bindViews(state, { scene: () => scene, joints: () => joints, redraw, say, download });
const drawLight = lightGizmo($("gizmo"), state, views.remember, redraw);

function redraw() {
  wanted = true;
  fit.moved = performance.now();
}

function step(now) {
  if (playing && scene.motion.duration > 0) {
    state.time = ((now - playedSince) / 1000) % scene.motion.duration;
    wanted = true;
  }
  if (scene && !playing && flying.size === 0 && fit.isCoarse(now)) wanted = true;
  if (wanted && scene && flying.size < IN_FLIGHT) {
    wanted = false;
    views.follow();
    ask(false);
    showState();
  }
  requestAnimationFrame(step);
}

function ask(exact) {
  number += 1;
  flying.set(number, performance.now());
  const moves = playing || performance.now() - fit.moved < 100;
  engine.render(number, exact ? { ...state } : fit.asked(state, moves), exact);
  return number;
}

function show(frame) {
  if (frame.number < shown) return frame.image.close?.();  // decoded after a later frame
  shown = frame.number;
  const sent = flying.get(frame.number) ?? performance.now();  // missing if the frame before failed
  for (const old of [...flying.keys()]) if (old <= frame.number) flying.delete(old);
  const canvas = $("frame"), context = canvas.getContext("2d");
  if (canvas.width !== frame.width || canvas.height !== frame.height) {
    canvas.width = frame.width;
    canvas.height = frame.height;
  }
  if (frame.image instanceof ImageData) context.putImageData(frame.image, 0, 0);
  else context.drawImage(frame.image, 0, 0);
  frame.image.close?.();
  drawSkeleton($("overlay"), frame, scene.parents, $("skeleton").checked);
  showNotes(frame.notes);
  $("gizmo").hidden = state.truth !== null || !frame.sun;
  if (frame.sun) drawLight(frame.sun);
  joints = frame.joints.map(([x, y, z]) => [x * state.width / frame.width, y * state.height / frame.height, z]);
  const now = performance.now();
  if (flying.size) fit.observe(now - Math.max(shownAt, sent));
  shownAt = now;
  rates = [...rates.filter((at) => now - at < 1000), now];
  times = frame.times;
  times["to the page and back"] = Math.max(now - sent - Object.values(times).reduce((a, b) => a + b, 0), 0);
  for (const one of waiting) if (one.number <= frame.number) one.done(frame);
  waiting = waiting.filter((one) => one.number > frame.number);
  if ($("message").textContent && passing) say("");
}

/** Announce a frame that takes long; the frame clears the message. */
function announceSlowFrame() {
  const since = Math.max(Math.min(...flying.values()), shownAt);  // infinite without pending frames
  if (!$("message").textContent && performance.now() - since > LONG_MS) say("rendering …", { untilFrame: true });
}

/** Notes on the scene and on the light of a frame. */
function showNotes(ofLight = []) {
  const text = [...scene.notes, ...ofLight].join(" · ");
  if ($("notes").textContent !== text) $("notes").textContent = text;
}

function showTimes() {
  const now = performance.now();
  rates = rates.filter((at) => now - at < 1000);
  const rows = Object.entries(times).map(([name, ms]) => [name, `${ms.toFixed(1)} ms`]);
  rows.push(["frames/s", playing || rates.length > 1 ? String(rates.length) : "–"]);
  $("times").replaceChildren(...rows.map((cells) => {
    const row = document.createElement("tr");
    for (const text of cells) row.appendChild(document.createElement("td")).textContent = text;
    return row;
  }));
}

function showState() {
  const truth = state.truth === null ? null : scene.truths[state.truth];  // of another motion, perhaps
  $("time").value = truth?.time ?? state.time;
  $("clock").textContent = truth ? `${truth.time.toFixed(2)} s` : `${state.time.toFixed(2)} of ${scene.motion.duration.toFixed(2)} s`;
  const { yaw, exposure } = truth ? { yaw: 0, exposure: 0 } : state;
  $("yaw").value = yaw / RADIANS;
  $("yaw").nextElementSibling.textContent = `${Math.round(yaw / RADIANS)}°`;
  $("exposure").value = exposure;
  $("exposure").nextElementSibling.textContent = `${exposure > 0 ? "+" : ""}${exposure.toFixed(1)}`;
  $("size").value = state.height;
  $("size").nextElementSibling.textContent = String(state.height);
  $("gaussians").nextElementSibling.textContent = String(state.gaussians ?? scene.gaussians);
  for (const name of ["light", "shade", "tone"]) $(name).value = String(state[name]);
  showBackground();
  for (const name of ["shade", "tone"]) $(name).title = $(name).selectedOptions[0]?.title ?? "";
  for (const button of $("output").children) button.ariaPressed = String(button.dataset.value === state.output);
  $("play").textContent = playing ? "❚❚" : "▶";
}

/** A colour is one of the list, or is chosen beside it. */
function showBackground() {
  const choosing = $("background").value === "colour" && state.background.startsWith("#");
  const named = !choosing && [...$("background").options].some(({ value }) => value === state.background);
  $("background").value = named ? state.background : "colour";
  $("colour").parentElement.hidden = named;
  if (!named) $("colour").value = state.background;
}

function play(on) {
  playing = on && scene.motion.duration > 0;
  playedSince = performance.now() - 1000 * state.time;
  redraw();
}

/** Show a message until the next one, with `untilFrame` until the next frame, or for some `seconds`. */
function say(text, { wrong = false, untilFrame = false, seconds = 0 } = {}) {
  passing = untilFrame;
  clearTimeout(fading);
  if (seconds) fading = setTimeout(() => say(""), 1000 * seconds);
  $("message").textContent = text;
  $("message").classList.toggle("wrong", wrong);
}

function options(select, entries) {
  select.replaceChildren(...entries.map(([value, text, title = ""]) => Object.assign(new Option(text, value), { title })));
}

function home() {
  Object.assign(state, fitted(scene.view, state));
  redraw();
}

/** Reset camera, light rotation and exposure. */
function reset() {
  views.remember();
  Object.assign(state, { yaw: 0, exposure: 0 });
  home();
}

function setScene(description) {
  const first = scene === null;
  const moved = first || JSON.stringify(scene.view) !== JSON.stringify(description.view);
  scene = description;
  $("title").textContent = scene.avatar;
  $("subtitle").textContent = `${scene.gaussians} Gaussians · ${scene.motion.name} · ${scene.raster}`;
  options($("light"), scene.lights.map((name, index) => [index, name]));
  options($("shade"), Object.entries(SHADES).map(([name, title]) => [name, name, title]));
  $("zone").hidden = true;
  options($("truth-index"), scene.truths.map((truth, index) => [index, truth.label]));
  $("compare").hidden = scene.truths.length === 0;
  $("ground").parentElement.hidden = !scene.ground;
  state.ground = Boolean(scene.ground) && $("ground").checked;
  $("time").step = 1 / scene.motion.fps;
  $("time").max = scene.motion.duration + 0.5 / scene.motion.fps;  // the end of a slider must be on one of its steps
  for (const part of document.querySelectorAll("fieldset, #screenshot")) part.disabled = false;
  freeMotion();
  state.time = Math.min(state.time, scene.motion.duration);
  state.light = scene.light ?? Math.min(state.light, scene.lights.length - 1);
  setGaussians();
  [$("size").min, $("size").max] = scene.sizes;
  if (first) [state.width, state.height] = scene.size;
  if (first) $("fit").checked = Boolean(scene.fit);
  fit.start($("fit").checked, scene.sizes);
  if (moved) home();
  if (moved) views.forget();
  if (first && !restore() && !matchMedia("(prefers-reduced-motion)").matches) play(true);
  showNotes();
  say(first ? "loading …" : "", { untilFrame: true });
  redraw();
}

/** Take the state that the page's address holds; whether it holds one. */
function restore() {
  const given = views.restore();
  $("ground").checked = state.ground;
  $("gaussians").value = 100 * (state.gaussians ?? scene.gaussians) / scene.gaussians;
  return given;
}

/** The slider's share of this avatar's Gaussians. */
function setGaussians() {
  const percent = Number($("gaussians").value);
  state.gaussians = percent < 100 ? Math.max(Math.round(scene.gaussians * percent / 100), 1) : null;
}

async function setTruth() {
  const on = $("truth-on").checked, index = Number($("truth-index").value);
  state.truth = on ? index : null;
  $("truth-pane").hidden = !on;
  $("truth-name").textContent = on ? scene.truths[index].label : "";
  for (const name of ["light", "yaw", "exposure"]) $(name).disabled = on;  // the image's own light is shown
  say("");
  freeMotion();
  if (on) {
    play(false);
    engine.truth(index);
  }
  redraw();
}

function showTruth(index, bitmap) {
  if (index !== state.truth) return bitmap?.close();  // another one was requested meanwhile
  const canvas = $("truth"), { label, width, height } = scene.truths[index];
  canvas.dataset.index = index;
  canvas.width = bitmap?.width ?? width;  // and it is blank
  canvas.height = bitmap?.height ?? height;
  if (!bitmap) return say(`${label}: this browser cannot decode the image`, { wrong: true });
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  bitmap.close();
}

function download(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** A promise of the current state's frame, by default with exact pixels. */
function frame(exact = true) {
  return new Promise((done, failed) => { waiting.push({ number: ask(exact), done, failed }); });
}

async function screenshot() {
  const truth = state.truth === null ? null : scene.truths[state.truth].label.replaceAll(/[^\p{L}\p{N}._-]+/gu, "_");
  const [kind, times] = $("picture").value.split(" "), [least, largest] = scene.sizes, most = scene.picture ?? largest, { width, height } = state;
  const name = `avatar_${truth ?? `${state.time.toFixed(2)}s`}.${kind}`, grown = Math.min(times, most / Math.max(width, height));
  Object.assign(state, { width: Math.max(Math.round(grown * width), least), height: Math.max(Math.round(grown * height), least) });
  const drawn = frame().catch(() => null);
  Object.assign(state, { width, height });
  if (!await drawn) return;  // the page says why
  const canvas = document.createElement("canvas");
  Object.assign(canvas, { width: $("frame").width, height: $("frame").height });
  canvas.getContext("2d").drawImage($("frame"), 0, 0);
  canvas.getContext("2d").drawImage($("overlay"), 0, 0, canvas.width, canvas.height);
  canvas.toBlob((blob) => download(blob, name), `image/${kind}`, PICTURE_QUALITY);
  if (grown < times) say(`saved with ${canvas.width} × ${canvas.height} pixels, the most here; rnd-play --size makes larger ones`, { seconds: 4 });
  if (times > 1) redraw();
}

function clip() {
  play(false);
  clipMade = {};
  clipMade.promise = new Promise((done) => { clipMade.resolve = done; });
  freeMotion();
  say("making a clip …");
  const turn = $("turntable").checked ? 2 * Math.PI : 0;
  const fps = Math.min(Math.max(scene.motion.fps, 1), MAX_CLIP_FPS);
  engine.clip({ ...state }, fps, turn, scene.motion.duration);
}

function endClip() {
  clipMade?.resolve();
  clipMade = null;
  freeMotion();
}

/** Disable controls of motion, camera and clips while a ground-truth image with its own pose and camera is shown. */
function freeMotion() {
  const compared = state.truth !== null, still = !scene?.motion.duration;
  $("play").disabled = $("time").disabled = compared || still;
  $("clip").disabled = clipMade !== null || compared || still;
  $("hint").hidden = compared;
  $("clip").title = compared ? "a clip films the motion: switch “ground truth beside” off" : "";
}

function slider(id, apply) {
  $(id).addEventListener("input", () => { apply(Number($(id).value)); redraw(); });
}

function bind() {
  slider("yaw", (degrees) => { state.yaw = wrapped(degrees * RADIANS); });
  slider("exposure", (stops) => { state.exposure = stops; });
  slider("size", (pixels) => {
    fit.start($("fit").checked = false, scene.sizes);
    const [width, height] = scene.size, [least, most] = scene.sizes;
    Object.assign(state, { width: Math.min(Math.max(Math.round(pixels * width / height), least), most), height: pixels });
  });
  slider("gaussians", setGaussians);
  slider("time", (seconds) => { state.time = Math.min(seconds, scene.motion.duration); play(false); });
  for (const name of ["shade", "tone"])
    $(name).addEventListener("change", () => { state[name] = $(name).value; redraw(); });
  for (const name of ["background", "colour"]) $(name).addEventListener("input", () => {
    const { value } = $("background");
    state.background = value === "colour" ? $("colour").value : value;
    redraw();
  });
  $("light").addEventListener("change", () => { state.light = Number($("light").value); redraw(); });
  $("output").addEventListener("click", (event) => {
    if (!event.target.dataset.value) return;
    state.output = event.target.dataset.value;
    redraw();
  });
  $("fit").addEventListener("change", () => fit.start($("fit").checked, scene.sizes));
  $("skeleton").addEventListener("change", redraw);
  $("ground").addEventListener("change", () => { state.ground = $("ground").checked; redraw(); });
  $("truth-on").addEventListener("change", setTruth);
  $("truth-index").addEventListener("change", setTruth);
  $("play").addEventListener("click", () => play(!playing));
  $("screenshot").addEventListener("click", screenshot);
  $("clip").addEventListener("click", clip);
  document.addEventListener("keydown", (event) => {
    if (event.target.matches("select") || !scene || event.ctrlKey || event.metaKey || event.altKey) return;
    if (state.truth !== null) return;  // see freeMotion
    if (event.code === "Space") {
      if (event.target.matches("button, [type=checkbox], [type=file]")) return;  // which it presses
      event.preventDefault();
      play(!playing);
    } else if (event.code === "KeyR") reset();
    else if (event.code === "Comma" || event.code === "Period") {
      const frames = event.code === "Comma" ? -1 : 1;
      state.time = Math.min(Math.max(state.time + frames / scene.motion.fps, 0), scene.motion.duration);
      play(false);
    }
  });
  orbit($("stage"), state, redraw);
}

function fail(text, endsClip = true) {
  say(text, { wrong: true, untilFrame: !(endsClip && clipMade) });
  playing = false;  // or every frame would fail
  if (scene) showState();
  if (endsClip) endClip();
  flying.clear();
  for (const one of waiting) one.failed(new Error(text));
  waiting = [];
}

const handlers = {
  scene: setScene,
  frame: show,
  truth: showTruth,
  message: (text) => say(text, { untilFrame: true }),
  progress: (done, of, note = "") => say(`making a clip: ${done} of ${of}${note}`),
  clip: (blob, name, notes = []) => { endClip(); say(notes.join(" · ")); download(blob, name); },
  refused: (text) => say(text, { wrong: true }),
  held: (held, text) => { showHeld(held); say(text); },
  missing: (reasons) => { showMissing(reasons); say(`${reasons.length} of the address's files are missing`, { wrong: true }); },
  error: fail,
};

bind();
engine = await connect(handlers);
const idle = async () => { while (clipMade) await clipMade.promise; };  // a clip is of one scene
if (engine.load) bindFiles(engine.load, idle, () => clipMade !== null, say);
requestAnimationFrame(step);
setInterval(() => {
  if (scene) showTimes();
  announceSlowFrame();
}, 250);
window.rnd = { state, fit, redraw, frame, play, scene: () => scene, times: () => times, rate: () => rates.length };
