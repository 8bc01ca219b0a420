// WebGL2: textures of the scene, the slice of the active Gaussians, one draw of all of them, and the filling of uncovered pixels.

const NO_WEBGL = "This browser cannot show the scene: it has no WebGL2. A current Chrome, Edge, Firefox or Safari has it.";
const MASK_SIZE = 24;  // pixels of the longer side of the small image that tells where nothing is left around
const SLICE_WIDTH = 512;  // Gaussians in a row of the texture of the slice

class Renderer {
  constructor(canvas, scene, shaders) {
    const options = { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" };
    const gl = (this.gl = canvas.getContext("webgl2", options));
    if (!gl) throw new Error(NO_WEBGL);
    const about = (this.about = scene.about);
    // Half floats keep sums of many faint Gaussians exact; without them 8 bits have to do. Where floats cannot be drawn to,
    // every corner of a quad is sliced anew.
    this.isDirect = !gl.getExtension("EXT_color_buffer_float");
    this.isFloat = !this.isDirect || Boolean(gl.getExtension("EXT_color_buffer_half_float"));
    this.width = Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), 4096);
    this.harmonics = (about.shDegree + 1) ** 2;
    this.slopeTexels = scene.arrays.slopes ? 1 : 0;
    this.stateSize = 3 + this.harmonics + this.slopeTexels;
    this.gainTexels = Math.ceil(about.gains / 4);
    this.objectTexels = Math.ceil((about.objects.length + 1) / 4);
    const constants = {
      OBJECT_TEXELS: this.objectTexels, WIDTH: this.width, SLICE_WIDTH, SH_COUNT: this.harmonics, STATE_SIZE: this.stateSize, SLOPE_TEXELS: this.slopeTexels, GAIN_TEXELS: this.gainTexels, MEAN_DEGREE: scene.meanDegree,
      QUAT_DEGREE: scene.quatDegree, EPS2D: about.eps2d, FOCAL: about.focal, ALPHA_MIN: about.alphaMin, ALPHA_MAX: about.alphaMax, P_MIN: about.pMin,
      FILLED_FROM: about.filledFrom, FILLED_TO: about.filledTo,
    };
    const slice = shaders["slice.glsl"];
    if (this.isDirect) {
      this.splat = this.program(slice + shaders["splat.vert"], shaders["splat.frag"], { ...constants, DIRECT: 1 });
    } else {
      this.slice = this.program(shaders["whole.vert"], slice + shaders["slice.frag"], constants);
      this.splat = this.program(shaders["splat.vert"], shaders["splat.frag"], constants);
    }
    this.shrink = this.program(shaders["whole.vert"], shaders["shrink.frag"], constants);
    this.spread = this.program(shaders["whole.vert"], shaders["spread.frag"], constants);
    this.present = this.program(shaders["whole.vert"], shaders["present.frag"], constants);
    this.states = this.table(this.stateTexels(scene));
    this.motions = this.table(this.motionTexels(scene));
    this.gains = this.table(this.gainTexelsOf(scene));
    this.makeBuffers(about.resting + about.moving);
    this.levels = [];
  }

  /** The order, the slice in that order, and the corners of all quads, two triangles each. */
  makeBuffers(count) {
    const gl = this.gl;
    const lines = Math.max(Math.ceil(count / SLICE_WIDTH), 1);
    this.rows = new Uint32Array(SLICE_WIDTH * lines);
    this.order = this.data(gl.R32UI, SLICE_WIDTH, lines, gl.RED_INTEGER, gl.UNSIGNED_INT, this.rows);
    if (!this.isDirect) {
      this.sliced = [0, 1, 2].map(() => this.data(gl.RGBA32F, SLICE_WIDTH, lines, gl.RGBA, gl.FLOAT, null));
      this.slicing = { frame: gl.createFramebuffer(), width: SLICE_WIDTH, height: lines };
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.slicing.frame);
      const places = this.sliced.map((texture, k) => {
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture, 0);
        return gl.COLOR_ATTACHMENT0 + k;
      });
      gl.drawBuffers(places);
    }
    const corners = new Uint32Array(6 * count);
    for (let i = 0; i < count; i++) corners.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    this.nothing = gl.createVertexArray();
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(this.nothing);
  }

  program(vertex, fragment, constants) {
    const gl = this.gl;
    const head = Object.entries(constants).map(([name, value]) => {
      const isReal = name === "EPS2D" || name === "FOCAL" || name.startsWith("ALPHA") || name === "P_MIN" || name.startsWith("FILLED");
      return `#define ${name} ${isReal ? value.toExponential(9) : value}\n`;
    });
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, `#version 300 es\n${head.join("")}${source}`);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) ?? "shader");
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? "program");
    const at = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const name = gl.getActiveUniform(program, k).name.replace("[0]", "");
      at[name] = gl.getUniformLocation(program, name);
    }
    return { program, at };
  }

  // -- the scene as textures

  /** A texture of float texels with as many rows as they need. */
  table(texels) {
    const height = Math.max(Math.ceil(texels.length / 4 / this.width), 1);
    const padded = new Float32Array(4 * this.width * height);
    padded.set(texels);
    return this.data(this.gl.RGBA32F, this.width, height, this.gl.RGBA, this.gl.FLOAT, padded);
  }

  data(kind, width, height, format, type, texels) {
    const gl = this.gl;
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("This scene has more Gaussians than the graphics card's textures hold.");
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    this.filter(gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, kind, width, height, 0, format, type, texels);
    return texture;
  }

  filter(kind) {
    const gl = this.gl;
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, kind);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, kind);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  stateTexels({ about, arrays, objects }) {
    const count = about.resting + about.moving;
    const stride = 4 * this.stateSize;
    const texels = new Float32Array(count * stride);
    const { means, quats, logScales, opacities, colors, harmonics, slopes, logReaches } = arrays;
    for (let i = 0; i < count; i++) {
      const at = i * stride;
      for (let c = 0; c < 3; c++) {
        texels[at + c] = means.values[3 * i + c];
        texels[at + 8 + c] = Math.exp(logScales.values[3 * i + c]);
        texels[at + 12 + c] = colors.values[3 * i + c];
      }
      texels[at + 3] = opacities.values[i];
      texels[at + 11] = objects[i];
      texels[at + 15] = logReaches && i < about.resting ? Math.exp(logReaches.values[i]) : 2;  // directions differ by 2 at most
      for (let c = 0; c < 4; c++) texels[at + 4 + c] = quats.values[4 * i + c];
      for (let k = 1; k < this.harmonics; k++) {
        for (let c = 0; c < 3; c++) texels[at + 12 + 4 * k + c] = harmonics.values[i * harmonics.components + 3 * (k - 1) + c];
      }
      for (let c = 0; slopes && c < 2; c++) texels[at + stride - 4 + c] = slopes.values[2 * i + c];
    }
    return texels;
  }

  motionTexels({ about, arrays, intervals, meanDegree, quatDegree }) {
    const stride = 4 * (1 + meanDegree + quatDegree);
    const texels = new Float32Array(about.moving * stride);
    for (let i = 0; i < about.moving; i++) {
      const at = i * stride;
      for (let c = 0; c < 4; c++) texels[at + c] = intervals[4 * i + c];
      for (let k = 0; k < meanDegree; k++) {
        for (let c = 0; c < 3; c++) texels[at + 4 * (1 + k) + c] = arrays.meanCoefficients.values[3 * (i * meanDegree + k) + c];
      }
      for (let k = 0; k < 4 * quatDegree; k++) texels[at + 4 * (1 + meanDegree) + k] = arrays.quatCoefficients.values[4 * i * quatDegree + k];
    }
    return texels;
  }

  gainTexelsOf({ about, arrays }) {
    const texels = new Float32Array(4 * this.gainTexels * about.resting);
    for (let i = 0; i < about.resting; i++) {
      for (let k = 0; k < about.gains; k++) texels[4 * this.gainTexels * i + k] = arrays.gains.values[about.gains * i + k];
    }
    return texels;
  }

  // -- targets

  target(width, height) {
    const gl = this.gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    this.filter(gl.LINEAR);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.isFloat ? gl.RGBA16F : gl.RGBA8, width, height);
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    return { texture, frame, width, height };
  }

  /** Make the pyramid of targets this large, and the canvas for `eyes` such images beside each other. */
  resize(width, height, eyes) {
    const gl = this.gl;
    if (gl.canvas.width !== eyes * width || gl.canvas.height !== height) {
      gl.canvas.width = eyes * width;
      gl.canvas.height = height;
    }
    const own = this.levels[0]?.own;
    if (own && own.width === width && own.height === height) return;
    for (const level of this.levels) {
      for (const { texture, frame } of Object.values(level)) {
        gl.deleteTexture(texture);
        gl.deleteFramebuffer(frame);
      }
    }
    this.levels = [];
    for (let w = width, h = height; ; w = Math.max(w >> 1, 1), h = Math.max(h >> 1, 1)) {
      const level = { own: this.target(w, h) };
      if (this.about.fill) level.filled = this.target(w, h);
      this.levels.push(level);
      if (!this.about.fill || Math.max(w, h) === 1) break;
    }
  }

  // -- drawing

  /** Take a program, a target (null: the canvas) and textures by the names of their samplers. */
  use({ program, at }, target, textures) {
    const gl = this.gl;
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target ? target.frame : null);
    gl.viewport(0, 0, target ? target.width : gl.canvas.width, target ? target.height : gl.canvas.height);
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(at[name] ?? null, unit);
    });
  }

  /**
   * Draw the Gaussians of `order` (farthest first) as each of `cameras` sees them at clip time `time`, beside each other.
   * `distances`: the pivot, and how many times as far from there every object is. `guesses`: "shown", "removed", so that black
   * is left, or "masked": removed, but for small gaps, and fading into the page where nothing is left.
   */
  draw(order, cameras, time, part, distances, guesses) {
    this.upload(order);
    cameras.forEach((camera, eye) => this.drawEye(order, camera, time, part, distances, guesses, eye));
  }

  drawEye(order, camera, time, part, distances, guesses, eye) {
    const gl = this.gl;
    const isConfidenceFade = guesses !== "shown";
    const [top] = this.levels;
    const scene = { order: this.order, states: this.states, motions: this.motions, gains: this.gains };
    if (this.isDirect) {
      this.use(this.splat, top.own, scene);
      this.lookAt(this.splat, camera, time, distances, isConfidenceFade);
    } else {
      const lines = Math.ceil(order.length / SLICE_WIDTH);
      this.use(this.slice, { ...this.slicing, height: lines }, scene);
      this.lookAt(this.slice, camera, time, distances, isConfidenceFade);
      gl.uniform1i(this.slice.at.count, order.length);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      const [slicedAxes, slicedPlaces, slicedColors] = this.sliced;
      this.use(this.splat, top.own, { slicedAxes, slicedPlaces, slicedColors });
    }
    gl.uniform2f(this.splat.at.size, top.own.width, top.own.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.bindVertexArray(this.quads);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElements(gl.TRIANGLES, 6 * order.length, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(this.nothing);
    const isFilled = this.about.fill && part !== "objects" && guesses !== "removed";
    if (isFilled) this.fill();
    const isMasked = isFilled && guesses === "masked";
    const around = this.levels.find(({ own }) => Math.max(own.width, own.height) <= MASK_SIZE) ?? top;
    this.use(this.present, null, { source: top.own.texture, filled: (top.filled ?? top.own).texture, around: around.own.texture });
    gl.uniform2f(this.present.at.size, top.own.width, top.own.height);
    gl.uniform1i(this.present.at.isMasked, isMasked ? 1 : 0);
    gl.viewport(eye * top.own.width, 0, top.own.width, top.own.height);
    gl.uniform1i(this.present.at.left, eye * top.own.width);
    gl.uniform1i(this.present.at.isFilled, isFilled ? 1 : 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  upload(order) {
    const gl = this.gl;
    this.rows.set(order);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    const lines = Math.ceil(order.length / SLICE_WIDTH);
    if (lines) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, SLICE_WIDTH, lines, gl.RED_INTEGER, gl.UNSIGNED_INT, this.rows);
  }

  /** Tell the program that slices what is to be seen. */
  lookAt({ at }, camera, time, { pivot, factors }, isConfidenceFade) {
    const gl = this.gl;
    gl.uniform1i(at.resting, this.about.resting);
    gl.uniform1f(at.time, time);
    if (at.cosines) {
      const cosines = new Float32Array(4 * (this.gainTexels + 1));
      for (let k = 0; k < this.about.gains; k++) cosines[k] = Math.cos(Math.PI * (k + 1) * time);
      gl.uniform4fv(at.cosines, cosines);
    }
    gl.uniformMatrix3fv(at.rotation, true, camera.rotation);
    gl.uniform3fv(at.translation, camera.translation);
    gl.uniform3fv(at.center, centerOf(camera));
    gl.uniform4fv(at.lens, camera.lens);
    gl.uniform2f(at.size, this.levels[0].own.width, this.levels[0].own.height);
    gl.uniform1f(at.near, this.about.near);
    gl.uniform3fv(at.pivot, pivot);
    gl.uniform1i(at.isConfidenceFade, isConfidenceFade ? 1 : 0);
    const padded = new Float32Array(4 * this.objectTexels).fill(1);
    padded.set(factors);
    gl.uniform4fv(at.factors, padded);
  }

  /** Push-pull: shrink the image level by level, then carry colors back into what is uncovered. */
  fill() {
    const gl = this.gl;
    for (let k = 1; k < this.levels.length; k++) {
      const from = this.levels[k - 1].own;
      const to = this.levels[k].own;
      this.use(this.shrink, to, { source: from.texture });
      gl.uniform2f(this.shrink.at.ratio, from.width / to.width, from.height / to.height);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    for (let k = this.levels.length - 1; k >= 0; k--) {
      const isSmallest = k === this.levels.length - 1;
      const smaller = isSmallest ? this.levels[k].own : this.levels[k + 1].filled;
      this.use(this.spread, this.levels[k].filled, { source: this.levels[k].own.texture, smaller: smaller.texture });
      gl.uniform1i(this.spread.at.isSmallest, isSmallest ? 1 : 0);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
  }
}
