// WebGL2: splats into a float target, then a second pass makes the picture.

import { ROW_GAUSSIANS, TEXELS } from "./project.js";
import resolveFragment from "./resolve.frag";
import splatFragment from "./splat.frag";
import splatVertex from "./splat.vert";

const HEAD = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n";
const MACROS = `#define TEXELS ${TEXELS}\n#define ROW_GAUSSIANS ${ROW_GAUSSIANS}\n`;
const WHOLE = "void main() { gl_Position = vec4(vec2(gl_VertexID % 2, gl_VertexID / 2) * 4.0 - 1.0, 0.0, 1.0); }";

export class Splatter {
  constructor() {
    this.canvas = new OffscreenCanvas(1, 1);
    const gl = this.gl = this.canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl) throw new Error("this browser has no WebGL2");
    if (!gl.getExtension("EXT_color_buffer_float")) throw new Error("this browser's WebGL2 cannot draw to floats");
    // Blending 32-bit floats is an extension of its own; half floats cost some 25 dB and look the same.
    this.exact = Boolean(gl.getExtension("EXT_float_blend"));
    this.name = `WebGL2, ${this.exact ? "32" : "16"} bit`;
    this.splat = new Program(gl, HEAD + MACROS + splatVertex, HEAD + splatFragment);
    this.resolve = new Program(gl, HEAD + WHOLE, HEAD + resolveFragment);
    this.target = gl.createFramebuffer();
    this.picture = texture(gl);
    this.records = texture(gl);
    this.sky = texture(gl);
    gl.bindVertexArray(gl.createVertexArray());
    this.setSky({ width: 1, height: 1, radiance: new Float32Array(3) });
  }

  /** The map that may stand behind. */
  setSky({ width, height, radiance }) {
    const { gl } = this, texels = new Float32Array(4 * width * height);
    for (let k = 0; k < width * height; k++) texels.set(radiance.subarray(3 * k, 3 * k + 3), 4 * k);
    gl.bindTexture(gl.TEXTURE_2D, this.sky);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, texels);
  }

  /** Draw `records` (see project.js) and show them as `look` says; the picture is then on `canvas`. */
  draw(records, width, height, look) {
    const { gl } = this;
    this.resize(width, height);
    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    if (records.count) {
      gl.bindTexture(gl.TEXTURE_2D, this.records);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, ROW_GAUSSIANS * TEXELS, records.rows, 0, gl.RGBA, gl.FLOAT, records.data);
      this.splat.use({ size: [width, height] });
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.drawArrays(gl.TRIANGLES, 0, 3 * records.count);
      gl.disable(gl.BLEND);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.bindTexture(gl.TEXTURE_2D, this.picture);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.sky);
    gl.activeTexture(gl.TEXTURE0);
    this.resolve.use({ splatted: 0, sky: 1, ...look });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  resize(width, height) {
    const { gl, canvas } = this;
    if (canvas.width === width && canvas.height === height) return;
    canvas.width = width;
    canvas.height = height;
    gl.bindTexture(gl.TEXTURE_2D, this.picture);
    const [format, type] = this.exact ? [gl.RGBA32F, gl.FLOAT] : [gl.RGBA16F, gl.HALF_FLOAT];
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, type, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.picture, 0);
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
        [gl.SAMPLER_2D]: (value) => gl.uniform1i(at, value), [gl.INT]: (value) => gl.uniform1i(at, value),
        [gl.FLOAT]: (value) => gl.uniform1f(at, value), [gl.FLOAT_VEC2]: (value) => gl.uniform2fv(at, value),
        [gl.FLOAT_VEC3]: (value) => gl.uniform3fv(at, value),
        [gl.FLOAT_MAT3]: (value) => gl.uniformMatrix3fv(at, true, value),  // rows come first
      }[type]);
    }
  }

  /** Make it current, with `values` of its uniforms. */
  use(values) {
    this.gl.useProgram(this.program);
    for (const [name, value] of Object.entries(values)) this.setters.get(name)?.(value);
  }
}

function texture(gl) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  return made;
}
