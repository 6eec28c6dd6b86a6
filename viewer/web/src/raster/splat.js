// WebGL2 rasteriser: each pixel blends the Gaussians of its tile.

import {
  ALPHA_MAX, LOG2_ALPHA_MIN, MIN_COVERAGE, NEUTRAL_DESATURATION, NEUTRAL_OFFSET, NEUTRAL_START, TRANSMITTANCE_MIN,
} from "../constants.js";
import blendFragment from "./blend.frag";
import { ROW_GAUSSIANS, ROW_PAIRS, TEXELS, TILE } from "./project.js";

const HEAD = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\nprecision highp usampler2D;\n";
const MACROS = Object.entries({
  TEXELS, ROW_GAUSSIANS, ROW_PAIRS: `${ROW_PAIRS}u`, TILE, ALPHA_MAX, LOG2_ALPHA_MIN, TRANSMITTANCE_MIN, MIN_COVERAGE,
  NEUTRAL_OFFSET, NEUTRAL_START, NEUTRAL_DESATURATION,
}).map(([name, value]) => `#define ${name} ${value}\n`).join("");
const FULLSCREEN = "void main() { gl_Position = vec4(vec2(gl_VertexID % 2, gl_VertexID / 2) * 4.0 - 1.0, 0.0, 1.0); }";
const TEXTURES = ["records", "pairs", "tiles", "sky", "ground", "sun0", "sun1"];  // by unit
const NO_SUN = { width: 2, values: new Float32Array(4) };

export class Splatter {
  constructor() {
    this.canvas = new OffscreenCanvas(1, 1);
    const gl = this.gl = this.canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl) throw new Error("this browser has no WebGL2");
    this.name = "WebGL2";
    this.program = new Program(gl, HEAD + FULLSCREEN, HEAD + MACROS + blendFragment);
    this.largest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.formats = {
      records: [gl.RGBA32F, gl.RGBA, gl.FLOAT], sky: [gl.RGBA32F, gl.RGBA, gl.FLOAT], ground: [gl.RGBA32F, gl.RGBA, gl.FLOAT],
      sun0: [gl.R32F, gl.RED, gl.FLOAT], sun1: [gl.R32F, gl.RED, gl.FLOAT],
      pairs: [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT], tiles: [gl.RG32UI, gl.RG_INTEGER, gl.UNSIGNED_INT],
    };
    TEXTURES.forEach((name, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    });
    gl.bindVertexArray(gl.createVertexArray());
    this.setSky({ width: 1, height: 1, radiance: new Float32Array(3) });
    this.setGround({ ground: { width: 2, values: new Float32Array(16) }, sun0: NO_SUN, sun1: NO_SUN });
  }

  /** Whether the context was lost, as after a driver's reset. */
  isLost() { return this.gl.isContextLost(); }

  /** Set the map of the background. */
  setSky({ width, height, radiance }) {
    const texels = new Float32Array(4 * width * height);
    for (let k = 0; k < width * height; k++) texels.set(radiance.subarray(3 * k, 3 * k + 3), 4 * k);
    this.upload("sky", width, texels);
  }

  /** Set maps of the shadow on the ground (groundShadow). */
  setGround(maps) {
    for (const [name, { width, values }] of Object.entries(maps)) this.upload(name, width, values);
  }

  /** Render the result of `project` for the camera of `view` (fineView) to `canvas`, with the uniforms `look`. */
  draw({ records, pairs, tiles, columns }, { factor, corner, extent }, width, height, look) {
    const { gl, canvas } = this;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    this.upload("records", ROW_GAUSSIANS * TEXELS, records);
    this.upload("pairs", ROW_PAIRS, pairs);
    this.upload("tiles", columns, tiles);
    const units = Object.fromEntries(TEXTURES.map((name, unit) => [name, unit]));
    this.program.use({ ...units, size: [width, height], factor, corner, extent, ...look });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  upload(name, width, values) {
    const { gl } = this, [internal, format, type] = this.formats[name];
    const height = values.length / width / { [gl.RGBA]: 4, [gl.RG_INTEGER]: 2, [gl.RED_INTEGER]: 1, [gl.RED]: 1 }[format];
    if (height > this.largest) throw new Error("more Gaussians in the frame than this browser's textures hold");
    gl.activeTexture(gl.TEXTURE0 + TEXTURES.indexOf(name));
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, values);
  }
}

class Program {
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    this.setters = new Map();
    for (let k = 0; k < gl.getProgramParameter(this.program, gl.ACTIVE_UNIFORMS); k++) {
      const { name, type } = gl.getActiveUniform(this.program, k), at = gl.getUniformLocation(this.program, name);
      this.setters.set(name, {
        [gl.SAMPLER_2D]: (value) => gl.uniform1i(at, value), [gl.UNSIGNED_INT_SAMPLER_2D]: (value) => gl.uniform1i(at, value),
        [gl.INT]: (value) => gl.uniform1i(at, value), [gl.INT_VEC2]: (value) => gl.uniform2iv(at, value),
        [gl.FLOAT]: (value) => gl.uniform1f(at, value), [gl.FLOAT_VEC3]: (value) => gl.uniform3fv(at, value),
        [gl.FLOAT_MAT3]: (value) => gl.uniformMatrix3fv(at, true, value),  // row-major
      }[type]);
    }
  }

  /** Make it current, with `values` of its uniforms. */
  use(values) {
    this.gl.useProgram(this.program);
    for (const [name, value] of Object.entries(values)) this.setters.get(name)?.(value);
  }
}
