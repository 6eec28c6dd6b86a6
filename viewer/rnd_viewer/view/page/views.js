// Buttons and keys around the view: presets, undo, a path of cameras, full screen, and a link to what is seen.

import { pathOf, preset, viewAt, viewOf } from "./camera.js";
import { addressWith, stateOfAddress } from "./share.js";

const MAX_UNDO = 50;
const ONE_GESTURE_MS = 500;  // between turns of a wheel
const READ = { seconds: 4 };  // of a message
const HELD_MS = 600;  // by a finger
const $ = (id) => document.getElementById(id);

/**
 * Bind the controls to `state`. `page` has scene(), joints() of the last frame in px of the state's size, redraw(), say() and
 * download(). Returns remember(), which keeps the view for undo; restore(), which takes the address's state, and says whether it holds one;
 * follow(), which takes the path's view at the state's time where that is chosen; forget() of the path.
 */
export function bindViews(state, page) {
  let keys = [], views = [], turned = 0;
  const now = () => JSON.stringify({ seen: { ...viewOf(state), yaw: state.yaw, exposure: state.exposure }, keys });

  const remember = (event) => {
    const before = turned;
    turned = event?.type === "wheel" ? performance.now() : 0;
    if (turned - before < ONE_GESTURE_MS && turned && before) return;
    if (views.at(-1) !== now()) views = [...views, now()].slice(-MAX_UNDO);
  };
  const undo = () => {
    if (state.truth !== null) return;
    while (views.at(-1) === now()) views.pop();
    const before = JSON.parse(views.pop() ?? now());
    Object.assign(state, before.seen);
    if (before.keys.length !== keys.length) tell(before.keys);
    keys = before.keys;
    follow(following());
    page.redraw();
  };
  const look = (name) => {
    if (state.truth !== null) return;
    if (name === "face" && !page.joints()[page.scene().head]) return page.say("this body has no head", { untilFrame: true });
    remember();
    follow(false);
    Object.assign(state, preset(name, page.scene().view, state, page.joints(), page.scene().head));
    page.redraw();
  };
  const tell = (of) => {
    const times = of.map(({ time }) => time).sort((a, b) => a - b).map((time) => time.toFixed(2));
    page.say(`the camera's path has ${times.length ? `keys at ${times.join(", ")} s` : "no keys"}`, READ);
  };
  const key = () => {
    remember();
    keys = [...keys.filter(({ time }) => time !== state.time), { time: state.time, view: viewOf(state) }];
    tell(keys);
  };
  const following = () => $("follow").ariaPressed === "true";
  const follow = (on) => { $("follow").ariaPressed = String(on && keys.length > 0); };
  const toggle = () => {
    follow(!following());
    tell(keys);
    page.redraw();
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
  for (const [id, act] of Object.entries({ undo, key, path, share, full, follow: toggle })) $(id).addEventListener("click", act);
  for (const button of document.querySelectorAll("[data-preset]")) button.addEventListener("click", () => look(button.dataset.preset));
  for (const kind of ["pointerdown", "wheel"]) $("frame").addEventListener(kind, () => follow(false), { passive: true });
  for (const id of ["yaw", "exposure"]) $(id).addEventListener("pointerdown", remember);
  let holding = 0;  // fingers have no tooltips
  document.addEventListener("pointerdown", ({ pointerType, target }) => {
    const titled = target.closest("[title]");
    if (pointerType === "touch" && titled) holding = setTimeout(() => page.say(titled.title, READ), HELD_MS);
  });
  for (const end of ["pointerup", "pointercancel"]) document.addEventListener(end, () => clearTimeout(holding));
  $("full").hidden = !document.fullscreenEnabled;
  document.addEventListener("keydown", (event) => {
    const ctrl = event.ctrlKey || event.metaKey;
    if (event.code === "KeyZ" && ctrl && page.scene()) undo();
    if (event.code === "KeyF" && !ctrl && !$("full").hidden && !event.target.matches("select")) full();
  });
  return {
    remember, restore,
    follow: () => { if (following()) Object.assign(state, viewAt(keys, state.time)); },
    forget: () => {
      keys = [];
      follow(false);
    },
  };
}
