// Frames are rendered by a worker of this page; no server is needed once the files are loaded.

const MAX_CLIP_FRAMES = 900;
const MAX_CLIP_FPS = 30;
const FRAME_QUALITY = 0.95;  // of JPEG, in which frames wait for the recorder
const KEEP_IN_VIEW = " · keep this tab in view";  // browsers limit a hidden tab to about one frame per second
// H.264 of level 4.0 (1024² at 30 fps), then 3.0, then others
const CLIP_TYPES = ["video/mp4;codecs=avc1.42E028", "video/mp4;codecs=avc1.42E01E", "video/webm;codecs=vp9", "video/webm"];

/**
 * Start the worker. Callbacks `on`: scene, frame, progress, clip and error as from rnd-view, held({motion, light}, text) while
 * there is no avatar, missing(reasons) of files in the address, and refused(text) for unusable files. `load` sends files once they are read and the promise `idle()` is fulfilled.
 * Files in the page's address (?avatar=…&motion=…&hdr=…,…) are fetched at once.
 */
export async function connect(on) {
  const worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" });
  const taken = new Map();  // frames that are not for the page: number → {done, failed}
  let answered = false, dead = null;  // why the worker could not start
  worker.onerror = (event) => {
    const what = event.message || "the worker cannot start";
    for (const { failed } of taken.values()) failed(new Error(what));
    taken.clear();
    if (!answered) dead = what;
    on.error(what, false);
  };
  worker.onmessage = ({ data }) => {
    answered = true;
    if (data.kind === "scene") on.scene(data.scene);
    else if (data.kind === "held") on.held(data.held, data.text);
    else if (taken.has(data.number)) settle(taken, data);
    else if (data.kind === "error") (data.number === undefined ? on.refused : on.error)(data.message, false);
    else on.frame(data);
  };
  const render = (number, state) => worker.postMessage({ ask: "render", number, state });
  const load = async (files, idle) => {
    const contents = await Promise.all(files.map(read)).catch((error) => on.refused(error.message));
    await idle?.();
    if (contents && dead) on.refused(dead);
    else if (contents) worker.postMessage({ ask: "load", files: contents }, contents.map(({ bytes }) => bytes.buffer));
  };
  let clipNumber = 0;
  const renderFrame = (state) => new Promise((done, failed) => {
    clipNumber -= 1;  // the page's own numbers are positive
    taken.set(clipNumber, { done, failed });
    render(clipNumber, state);
  });
  const clip = (state, fps, turn, duration) =>
    record(renderFrame, state, { fps: Math.min(fps, MAX_CLIP_FPS), turn, duration }, on).catch((error) => on.error(error.message));

  const named = addressed();
  on.held({}, named.length ? "loading …" : "");
  if (named.length) fetchFiles(named).then(load, on.missing);
  return { render, clip, load, truth() {} };
}

function settle(taken, data) {
  const { done, failed } = taken.get(data.number);
  taken.delete(data.number);
  if (data.kind === "error") failed(new Error(data.message));
  else done(data);
}

async function read(file) {
  const content = await file.arrayBuffer().catch(() => { throw new Error(`${file.name}: expected a file, got a folder, or one that cannot be read`); });
  return { name: file.name, bytes: new Uint8Array(content) };
}

function addressed() {
  const values = new Map(location.search.slice(1).split("&").map((pair) => pair.split(/=(.*)/s, 2)));
  const names = (key) => (values.get(key) ?? "").split(",").filter(Boolean);  // before a name's own comma is decoded
  return ["avatar", "motion", "hdr"].flatMap(names).map((text) => new URLSearchParams(`name=${text}`).get("name"));
}

/** The URL of a name: a complete address, or a path that may contain # % ? and :. */
function addressOf(name) {
  if (/^([a-z][a-z0-9+.-]*:\/\/|blob:|data:)/i.test(name)) return new URL(name);
  const path = name.replaceAll("%", "%25").replaceAll("#", "%23").replaceAll("?", "%3F");
  return new URL(/^[^/]*:/.test(path) ? `./${path}` : path, location.href);
}

function shownName(address) {
  const name = address.pathname.split("/").pop();
  try {
    return decodeURIComponent(name);
  } catch {
    return name;  // not UTF-8
  }
}

/** All of them, or a rejection with the reasons of each that is missing. */
async function fetchFiles(names) {
  const results = await Promise.allSettled(names.map(async (name) => {
    const address = addressOf(name), answer = await fetch(address).catch((error) => { throw new Error(`${name}: ${error.message}`); });
    if (!answer.ok) throw new Error(`${name}: ${answer.status} ${answer.statusText}`);
    return new File([await answer.blob()], shownName(address));
  }));
  const missing = results.filter(({ reason }) => reason).map(({ reason }) => reason.message);
  if (missing.length) throw missing;
  return results.map(({ value }) => value);
}

/** Render all frames, then play them to a recorder in real time: it uses the time of day as timestamps. */
async function record(renderFrame, state, { fps, turn, duration }, on) {
  const type = CLIP_TYPES.find((name) => globalThis.MediaRecorder?.isTypeSupported(name));
  if (!type) throw new Error("this browser cannot record a clip");
  const count = Math.floor(duration * fps + 1e-6) + 1;
  if (count > MAX_CLIP_FRAMES) throw new Error(`a clip has at most ${MAX_CLIP_FRAMES} frames`);
  const canvas = document.createElement("canvas"), context = canvas.getContext("2d");
  Object.assign(canvas, { width: state.width, height: state.height });
  const show = (image) => {
    context.drawImage(image, 0, 0);
    image.close();
  };
  const frames = [];  // compressed: 900 of 1024² pixels would be 3.8 GB
  for (let k = 0; k < count; k++) {
    show((await renderFrame({ ...state, time: k / fps, azimuth: state.azimuth + turn * k / count })).image);
    frames.push(await new Promise((done) => { canvas.toBlob(done, "image/jpeg", FRAME_QUALITY); }));
    on.progress(k + 1, count, KEEP_IN_VIEW);
  }
  show(await createImageBitmap(frames[0]));
  const recorder = new MediaRecorder(canvas.captureStream(), { mimeType: type, videoBitsPerSecond: 12e6 });
  const parts = [];
  recorder.ondataavailable = ({ data }) => parts.push(data);
  const stopped = new Promise((done) => { recorder.onstop = done; });
  recorder.start();
  const started = performance.now();
  for (let k = 0; k < count; k++) {
    show(await createImageBitmap(frames[k]));
    await new Promise((done) => { setTimeout(done, started + 1000 * (k + 1) / fps - performance.now()); });
  }
  recorder.stop();
  await stopped;
  on.clip(new Blob(parts, { type }), `clip.${type.slice(6, type.indexOf(";") < 0 ? undefined : type.indexOf(";"))}`);
}
