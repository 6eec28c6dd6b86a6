// Bodies of few pixels on a finer grid, averaged by blend.frag (rnd_runtime/playback/far.py).

import { MARGIN, MAX_FACTOR, NEAR } from "../constants.js";

/** What to render of `camera` for a body around `points` [N·3] m of its frame: {camera, factor, corner, extent}. The image's
 *  `extent` px from `corner` on has `factor`² pixels of the finer camera in each of its own, so that they are `least` a metre or
 *  more; 1: it is `camera` itself. */
export function fineView(camera, points, least) {
  const { rotation: r, translation: t, focal, width, height } = camera;
  const plain = { camera, factor: 1, corner: [0, 0], extent: [width, height] };
  const low = [Infinity, Infinity, Infinity], high = low.map((x) => -x);
  let nearest = Infinity;
  for (let k = 0; k < points.length; k += 3) {
    nearest = Math.min(nearest, r[6] * points[k] + r[7] * points[k + 1] + r[8] * points[k + 2] + t[2]);
    for (let c = 0; c < 3; c++) {
      low[c] = Math.min(low[c], points[k + c] - MARGIN);
      high[c] = Math.max(high[c], points[k + c] + MARGIN);
    }
  }
  nearest -= MARGIN;
  if (!(nearest >= NEAR && nearest < Infinity)) return plain;  // NaN too
  const factor = Math.min(Math.ceil(least * nearest / focal), MAX_FACTOR);
  if (factor <= 1) return plain;
  const from = [Infinity, Infinity], to = [-Infinity, -Infinity];
  for (let corner = 0; corner < 8; corner++) {
    const point = low.map((x, c) => ((corner >> c) & 1 ? high[c] : x));
    const [x, y, z] = [0, 1, 2].map((row) => r[3 * row] * point[0] + r[3 * row + 1] * point[1] + r[3 * row + 2] * point[2] + t[row]);
    if (!(z >= NEAR)) return plain;
    [x, y].forEach((value, c) => {
      const pixel = focal * value / z + camera.centre[c];
      from[c] = Math.min(from[c], pixel);
      to[c] = Math.max(to[c], pixel);
    });
  }
  const size = [width, height], inside = (value, c) => Math.min(Math.max(value, 0), size[c]);
  const corner = from.map((value, c) => inside(Math.floor(value), c));
  const extent = to.map((value, c) => inside(Math.ceil(value), c) - corner[c]);
  if (!(extent[0] > 0 && extent[1] > 0)) return plain;
  const centre = camera.centre.map((value, c) => factor * (value - corner[c]));
  return { camera: { ...camera, width: factor * extent[0], height: factor * extent[1], focal: factor * focal, centre }, factor, corner, extent };
}
