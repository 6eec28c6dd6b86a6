// A small sphere under the light: its brightest direction is a sun that a drag takes around the vertical axis.

import { cameraOf } from "./camera.js";
import { wrapped } from "./orbit.js";

const RADIUS = 0.72;  // of the sphere, in halves of the canvas

/** Let a drag on `canvas` change `state.yaw`; `began` and `changed` are told. Returns draw(sun [3]), the light's at yaw 0. */
export function lightGizmo(canvas, state, began, changed) {
  let seen = null;  // towards the sun: right, down and forward of the camera
  let last = null;
  canvas.addEventListener("pointerdown", (event) => {
    event.stopPropagation();  // the camera stays
    canvas.setPointerCapture(event.pointerId);
    last = event.clientX;
    began();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { last = null; });
  canvas.addEventListener("pointermove", (event) => {
    if (last === null || !seen || state.truth !== null) return;
    const moved = (event.clientX - last) / (RADIUS * canvas.clientWidth / 2);
    last = event.clientX;
    state.yaw = wrapped(state.yaw + (seen[2] > 0 ? moved : -moved));  // behind the sphere it goes the other way
    changed();
  });
  return (sun) => {
    const context = canvas.getContext("2d"), half = canvas.width / 2, radius = RADIUS * half;
    const { rotation: r } = cameraOf({ ...state, width: 1, height: 1 }), c = Math.cos(state.yaw), s = Math.sin(state.yaw);
    const [x, y, z] = [c * sun[0] - s * sun[2], sun[1], s * sun[0] + c * sun[2]];
    seen = [0, 3, 6].map((row) => r[row] * x + r[row + 1] * y + r[row + 2] * z);
    const at = [half + radius * seen[0], half + radius * seen[1]], front = seen[2] < 0;
    const glow = context.createRadialGradient(...at, 0, ...at, (front ? 1.6 : 1.2) * radius);
    glow.addColorStop(0, front ? "#fff" : "#6f747c");
    glow.addColorStop(1, "#24272b");
    const disc = (centre, size, fill) => {
      context.beginPath();
      context.arc(...centre, size, 0, 2 * Math.PI);
      context.fillStyle = fill;
      context.fill();
    };
    context.clearRect(0, 0, canvas.width, canvas.height);
    if (!front) disc(at, 0.16 * half, "#f2b25c");
    context.globalAlpha = front ? 1 : 0.8;  // a sun behind the sphere shines through
    disc([half, half], radius, glow);
    context.globalAlpha = 1;
    if (front) disc(at, 0.16 * half, "#f2b25c");
  };
}
