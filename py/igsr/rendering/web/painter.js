// Draws models with WebGL 2: one quad per splat, back to front, in half floats if available.

// Texels per row of the data textures, supported by every WebGL 2.
const TEXTURE_WIDTH = 2048;

class Painter {
  /** `page` has shaders, constants and the background. Throws an Error if WebGL 2 is unavailable. */
  constructor(canvas, page) {
    this.canvas = canvas;
    this.page = page;
    const options = { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" };
    const gl = canvas.getContext("webgl2", options);
    if (!gl) throw new Error("this browser has no WebGL 2, or it is turned off");
    this.gl = gl;
    // Without these, pictures are blended in 8 bits.
    this.hasFloats = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    this.programs = new Map();
    const { presentVertex, presentFragment } = page.shaders;
    this.presents = this.program(this.head({}) + presentVertex, this.head({}) + presentFragment);
    this.empty = gl.createVertexArray();
    this.target = { width: 0, height: 0 };
  }

  /** Uploads a model to the GPU. Throws an Error if it is too large. */
  load(model, scene) {
    const gl = this.gl;
    const head = this.head({ NEAR: scene.near, DEGREE: model.degree });
    const { harmonics, splatVertex, splatFragment } = this.page.shaders;
    const layer = {
      scene,
      antialiased: model.antialiased,
      splats: this.program(head + harmonics + splatVertex, head + splatFragment),
      splatTexture: this.dataTexture(model.texels),
      harmonicTexture: this.dataTexture(model.harmonics),
      order: gl.createBuffer(),
      array: gl.createVertexArray(),
      drawn: 0,
    };
    gl.bindVertexArray(layer.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, layer.order);
    const index = gl.getAttribLocation(layer.splats.program, "index");
    gl.enableVertexAttribArray(index);
    gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(index, 1);
    gl.bindVertexArray(null);
    return layer;
  }

  /** Removes a model from the GPU. */
  unload(layer) {
    const gl = this.gl;
    gl.deleteTexture(layer.splatTexture);
    gl.deleteTexture(layer.harmonicTexture);
    gl.deleteBuffer(layer.order);
    gl.deleteVertexArray(layer.array);
  }

  /** The first lines of a shader. */
  head(more) {
    const constants = { ...this.page.constants, ...more };
    return [
      "#version 300 es",
      "precision highp float; precision highp int; precision highp usampler2D; precision highp sampler2D;",
      ...Object.entries(constants).map(([name, value]) => `#define ${name} ${glslNumber(name, value)}`),
      `#define TEXTURE_WIDTH ${TEXTURE_WIDTH}u`,
      "",
    ].join("\n");
  }

  /** Compiles and links two shaders, or returns the cached program. */
  program(vertex, fragment) {
    const key = vertex + fragment;
    if (!this.programs.has(key)) this.programs.set(key, this.made(vertex, fragment));
    return this.programs.get(key);
  }

  made(vertex, fragment) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      // It is deleted with the program.
      gl.deleteShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw new Error(`a shader does not compile: ${gl.getShaderInfoLog(shader)}`);
      }
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`shaders do not link: ${gl.getProgramInfoLog(program)}`);
    }
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  /** Makes a texture with four words per texel, TEXTURE_WIDTH texels per row. */
  dataTexture(words) {
    const gl = this.gl;
    const rows = Math.max(1, Math.ceil(words.length / (4 * TEXTURE_WIDTH)));
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("it has more splats than this device can hold");
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, TEXTURE_WIDTH, rows);
    nearestTexels(gl);
    const whole = Math.floor(words.length / (4 * TEXTURE_WIDTH));
    const upload = (y, height, data) =>
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, y, TEXTURE_WIDTH, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, data);
    if (whole > 0) upload(0, whole, words.subarray(0, whole * 4 * TEXTURE_WIDTH));
    if (whole < rows) {
      const last = new Uint32Array(4 * TEXTURE_WIDTH);
      last.set(words.subarray(whole * 4 * TEXTURE_WIDTH));
      upload(whole, 1, last);
    }
    return texture;
  }

  /** Sets the indices of the splats to draw, farthest first. */
  setOrder(layer, order) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, layer.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    layer.drawn = order.length;
  }

  /** Resizes the target of the blending to the canvas. */
  resize() {
    const gl = this.gl;
    const { width, height } = this.canvas;
    if (width === this.target.width && height === this.target.height) return;
    if (this.target.texture) {
      gl.deleteTexture(this.target.texture);
      gl.deleteFramebuffer(this.target.framebuffer);
    }
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.hasFloats ? gl.RGBA16F : gl.RGBA8, width, height);
    nearestTexels(gl);
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.target = { width, height, texture, framebuffer };
    if (this.hasFloats && gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) {
      this.hasFloats = false;
      this.target.width = 0;
      this.resize();
    }
  }

  /** Blends a model as a viewpoint and a lens of the canvas's size see it. */
  blend(layer, view, lens, showsDepth) {
    const gl = this.gl;
    this.resize();
    const { width, height } = this.target;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const { program, uniforms } = layer.splats;
    gl.useProgram(program);
    // The file's y and z axes are flipped. Matrices are in column order.
    const axes = [view.right, view.down, view.forward];
    gl.uniformMatrix3fv(uniforms.rotation, false, [1, -1, -1].flatMap((sign, k) => axes.map((axis) => sign * axis[k])));
    gl.uniform3fv(uniforms.translation, view.translation);
    gl.uniform4f(uniforms.lens, lens.fx, lens.fy, lens.cx, lens.cy);
    gl.uniform2f(uniforms.size, width, height);
    const margin = 0.5 * this.page.constants.JACOBIAN_MARGIN;
    const [mx, my] = [margin * width, margin * height];
    gl.uniform4f(uniforms.limits, -(lens.cx + mx) / lens.fx, (width - lens.cx + mx) / lens.fx,
      -(lens.cy + my) / lens.fy, (height - lens.cy + my) / lens.fy);
    gl.uniform1i(uniforms.antialiased, layer.antialiased ? 1 : 0);
    gl.uniform1i(uniforms.showsDepth, showsDepth ? 1 : 0);
    gl.uniform1f(uniforms.depthUnit, this.depthUnit(layer, view));
    gl.uniform1i(uniforms.splats, 0);
    gl.uniform1i(uniforms.harmonics, 1);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, layer.harmonicTexture);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, layer.splatTexture);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(layer.array);
    if (layer.drawn > 0) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, layer.drawn);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
  }

  depthUnit(layer, view) {
    return Math.max(1e-6, Math.hypot(...view.position) + layer.scene.radius);
  }

  /** Draws a model on the canvas, between two parts of its width, 0 and 1 for all of it. */
  draw(layer, view, lens, showsDepth, from = 0, to = 1) {
    const gl = this.gl;
    const [left, right] = [from, to].map((part) => Math.round(part * this.canvas.width));
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, 0, right - left, this.canvas.height);
    this.blend(layer, view, lens, showsDepth);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.target.width, this.target.height);
    const { program, uniforms } = this.presents;
    gl.useProgram(program);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(uniforms.picture, 0);
    gl.uniform3fv(uniforms.background, this.page.background);
    gl.uniform1i(uniforms.showsDepth, showsDepth ? 1 : 0);
    const unit = this.depthUnit(layer, view);
    const middle = -dot(view.forward, view.position);
    const { near: nearest, radius } = layer.scene;
    const near = Math.max(nearest, middle - 1.25 * radius);
    const far = Math.max(2 * near, middle + 1.25 * radius);
    gl.uniform2f(uniforms.depthRange, near / unit, far / unit);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
    gl.disable(gl.SCISSOR_TEST);
  }

  /** The expected depth at a pixel of the canvas, from the top left; null in empty pixels. */
  depthAt(layer, view, lens, x, y) {
    const gl = this.gl;
    this.blend(layer, view, lens, true);
    const row = this.target.height - 1 - y;
    const out = this.hasFloats ? new Float32Array(4) : new Uint8Array(4);
    gl.readPixels(x, row, 1, 1, gl.RGBA, this.hasFloats ? gl.FLOAT : gl.UNSIGNED_BYTE, out);
    const alpha = out[3] / (this.hasFloats ? 1 : 255);
    return alpha < 0.1 ? null : (out[0] / out[3]) * this.depthUnit(layer, view);
  }

  /** RGBA of the canvas, bottom row first. Only valid directly after `draw`. */
  pixels() {
    const gl = this.gl;
    const out = new Uint8Array(4 * this.target.width * this.target.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, this.target.width, this.target.height, gl.RGBA, gl.UNSIGNED_BYTE, out);
    return out;
  }
}

function nearestTexels(gl) {
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
}

/** Formats a GLSL float; the degree stays an integer for the preprocessor. */
function glslNumber(name, value) {
  return name === "DEGREE" || /[.e]/.test(String(value)) ? String(value) : `${value}.0`;
}
