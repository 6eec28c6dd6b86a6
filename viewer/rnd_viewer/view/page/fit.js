// The frame fills its pane; while something moves, with as many pixels as the time of a frame allows.

const TARGET_MS = 33;
const LEAST = 0.5;  // share of the side
const STILL_MS = 250;  // after which a frame has all of its pixels again

export class Fit {
  /** Keeps `state.width` and `state.height` those of `pane`, once `start` was called; `changed` is told. */
  constructor(pane, state, changed) {
    Object.assign(this, { pane, state, changed, on: false, sizes: [1, 1], scale: 1, moved: 0, sent: 1 });
    new ResizeObserver(() => this.resize()).observe(pane);
  }

  /** Fill the pane with sides within `sizes` px, or let the size be. */
  start(on, sizes) {
    Object.assign(this, { on, sizes, scale: 1 });
    this.resize();
  }

  resize() {
    const { clientWidth, clientHeight } = this.pane, [least, most] = this.sizes;
    if (!this.on || !clientWidth || !clientHeight) return;
    const ratio = Math.min(window.devicePixelRatio, most / Math.max(clientWidth, clientHeight));
    const [width, height] = [clientWidth, clientHeight].map((side) => Math.min(Math.max(Math.round(side * ratio), least), most));
    if (this.state.width === width && this.state.height === height) return;
    Object.assign(this.state, { width, height });
    this.changed();
  }

  /** The state to ask for: with fewer pixels while it moves. */
  asked(state, moves) {
    this.sent = this.on && moves ? this.scale : 1;
    const side = (pixels) => Math.max(Math.round(pixels * this.sent), Math.min(pixels, this.sizes[0]));
    return this.sent < 1 ? { ...state, width: side(state.width), height: side(state.height) } : { ...state };
  }

  /** Whether what moved stands still and the last frame had fewer pixels. */
  isCoarse(now) { return this.sent < 1 && now - this.moved > STILL_MS; }

  /** Learn from a frame that took `ms`. */
  observe(ms) {
    const factor = Math.sqrt(TARGET_MS / ms);
    if (factor < 0.9 || factor > 1.2) this.scale = Math.min(Math.max(this.scale * Math.min(Math.max(factor, 0.6), 1.15), LEAST), 1);
  }
}
