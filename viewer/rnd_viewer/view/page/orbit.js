// Pointer and wheel → the camera's orbit and the light's rotation.

const LIMIT = 89 * Math.PI / 180;
const PER_PIXEL = 0.01;  // rad
const NEAREST = 0.2, FARTHEST = 100;  // m

/**
 * Let `element` change `state` (azimuth, elevation, distance, target, yaw in rad and m), then call `changed`. Beside a truth,
 * whose camera and light are shown, it does nothing.
 */
export function orbit(element, state, changed) {
  const fingers = new Map();  // pointer → its last position
  element.addEventListener("contextmenu", (event) => event.preventDefault());
  element.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    element.setPointerCapture(event.pointerId);
  });
  for (const end of ["pointerup", "pointercancel"])
    element.addEventListener(end, (event) => fingers.delete(event.pointerId));
  element.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last || state.truth !== null) return;
    const apart = spread(fingers), dx = event.clientX - last[0], dy = event.clientY - last[1];
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (fingers.size > 1) {  // the other finger moves by itself: half of this one's way is the pair's
      approach(state, apart / Math.max(spread(fingers), 1));
      pan(state, dx / 2, dy / 2, element.clientHeight);
    }
    else if (event.shiftKey) state.yaw = wrapped(state.yaw + dx * PER_PIXEL);
    else if (event.buttons & 2 || event.ctrlKey) pan(state, dx, dy, element.clientHeight);
    else {
      state.azimuth = wrapped(state.azimuth - dx * PER_PIXEL);
      state.elevation = Math.min(Math.max(state.elevation + dy * PER_PIXEL, -LIMIT), LIMIT);
    }
    changed();
  });
  element.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (state.truth !== null) return;
    approach(state, Math.exp(event.deltaY * 1e-3));
    changed();
  }, { passive: false });
}

function approach(state, factor) {
  state.distance = Math.min(Math.max(state.distance * factor, NEAREST), FARTHEST);
}

/** Pixels between the first two fingers. */
function spread(fingers) {
  const [a, b] = [...fingers.values()];
  return b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
}

/** An angle in (−π, π]. */
export function wrapped(angle) {
  return angle - 2 * Math.PI * Math.ceil((angle - Math.PI) / (2 * Math.PI));
}

function pan(state, dx, dy, height) {
  const metres = 2 * state.distance * Math.tan(state.fov / 2) / height;
  const sa = Math.sin(state.azimuth), ca = Math.cos(state.azimuth);
  const se = Math.sin(state.elevation), ce = Math.cos(state.elevation);
  const right = [ca, 0, -sa], up = [-se * sa, ce, -se * ca];
  state.target = state.target.map((x, k) => x + metres * (up[k] * dy - right[k] * dx));
}
