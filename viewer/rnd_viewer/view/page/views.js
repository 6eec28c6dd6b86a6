// Buttons and keys around the view: presets, undo, a path of cameras, full screen, and a link to what is seen.

import { pathOf, preset, viewOf } from "./camera.js";
import { addressWith, stateOfAddress } from "./share.js";

const MAX_UNDO = 50;
const ONE_GESTURE_MS = 500;  // between turns of a wheel
const READ = { seconds: 4 };  // of a message
const $ = (id) => document.getElementById(id);

/**
 * Bind the controls to `state`. `page` has scene(), joints() of the last frame in px of the state's size, redraw(), say() and
 * download(). Returns remember(), which keeps the view for undo; restore(), which takes the address's state; forget() of the path.
 */
export function bindViews(state, page) {
  let keys = [], views = [], turned = 0;
  const now = () => JSON.stringify({ ...viewOf(state), yaw: state.yaw });

  const remember = (event) => {
    const before = turned;
    turned = event?.type === "wheel" ? performance.now() : 0;
    if (turned - before < ONE_GESTURE_MS && turned && before) return;
    if (views.at(-1) !== now()) views = [...views, now()].slice(-MAX_UNDO);
  };
  const undo = () => {
    if (state.truth !== null) return;
    while (views.at(-1) === now()) views.pop();
    Object.assign(state, JSON.parse(views.pop() ?? "{}"));
    page.redraw();
  };
  const look = (name) => {
    if (state.truth !== null) return;
    if (name === "face" && !page.joints()[page.scene().head]) return page.say("this body has no head", { untilFrame: true });
    remember();
    Object.assign(state, preset(name, page.scene().view, state, page.joints(), page.scene().head));
    page.redraw();
  };
  const key = () => {
    keys = [...keys.filter(({ time }) => time !== state.time), { time: state.time, view: viewOf(state) }];
    page.say(`the camera's path has keys at ${keys.map(({ time }) => time.toFixed(2)).sort().join(", ")} s`, READ);
  };
  const path = () => {
    if (!keys.length) key();
    const text = JSON.stringify(pathOf(keys, page.scene().motion, state.width, state.height));
    page.download(new Blob([text], { type: "application/json" }), "camera.json");
    page.say("rnd-play --camera camera.json takes this path", READ);
  };
  const share = () => {
    const address = addressWith(state);
    history.replaceState(null, "", address);
    const told = (how) => page.say(`${how}this page's address now holds what you see`, READ);
    if (navigator.clipboard) navigator.clipboard.writeText(address).then(() => told("copied: "), () => told(""));
    else told("");  // as browsers have it for hosts without https
  };
  const full = () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen().catch(() => page.say("this browser allows no full screen", { wrong: true }));
  };
  const restore = () => {
    const given = stateOfAddress(state);
    if (!(given.light < page.scene().lights.length)) delete given.light;
    Object.assign(state, given, { ground: Boolean(given.ground ?? state.ground) && Boolean(page.scene().ground) });
    return Object.keys(given).length > 0;
  };

  for (const kind of ["pointerdown", "wheel"]) $("stage").addEventListener(kind, remember, { capture: true, passive: true });
  for (const [id, act] of Object.entries({ undo, key, path, share, full })) $(id).addEventListener("click", act);
  for (const button of document.querySelectorAll("[data-preset]")) button.addEventListener("click", () => look(button.dataset.preset));
  $("full").hidden = !document.fullscreenEnabled;
  document.addEventListener("keydown", (event) => {
    const ctrl = event.ctrlKey || event.metaKey;
    if (event.code === "KeyZ" && ctrl && page.scene()) undo();
    if (event.code === "KeyF" && !ctrl && !$("full").hidden && !event.target.matches("select")) full();
  });
  return { remember, restore, forget: () => { keys = []; } };
}
