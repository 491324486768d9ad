// Draws the scene into half floats with several samples a pixel, and then through the tone curve into the canvas.
const DIRECT_LAYERS = 7;
const SAMPLES = 8;
const BACK_OFFSET = 64; // last bits of depth: where a front and a back share an edge, samples on it are the front's
const WRAPS = { repeat: "REPEAT", clamp: "CLAMP_TO_EDGE", mirror: "MIRRORED_REPEAT" };

class Drawing {
  constructor(canvas, about) {
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL2, or it is switched off");
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
      throw new Error("this device cannot draw into half floats");
    }
    this.anisotropic = gl.getExtension("EXT_texture_filter_anisotropic");
    Object.assign(this, { canvas, about, gl, maps: [] });
    this.surface = this.program(SURFACE_VERTEX, surfaceFragment(about.layers, DIRECT_LAYERS));
    this.sky = this.program(SCREEN_VERTEX, SKY_FRAGMENT);
    this.tone = this.program(SCREEN_VERTEX, TONE_FRAGMENT);
    this.samples = Math.min(SAMPLES, Math.max(...gl.getInternalformatParameter(gl.RENDERBUFFER, gl.RGBA16F, gl.SAMPLES), 0));
    this.empty = gl.createVertexArray();
  }

  async load() {
    const { gl, about } = this;
    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    for (const [location, name, size] of [[0, "positions", 3], [1, "places", 2], [2, "uvs", 2]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, interleaved(await numbersOf(about[name]), size), gl.STATIC_DRAW);
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, size, gl.FLOAT, false, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, interleaved(await numbersOf(about.triangles), 3), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.white = this.image(new Uint8Array([255, 255, 255, 255]), { srgb: false, wrap: ["repeat", "repeat"] });
    this.images = [];
    for (const record of about.images) this.images.push(this.image(await imageOf(record), record));
    this.pages = [];
    for (const sides of about.pages) {
      this.pages.push([]);
      for (const record of sides) this.pages.at(-1).push(record && (await this.page(record)));
    }
    for (const sky of about.skies) this.maps.push(this.map(sky.map, interleaved(await numbersOf(sky.map), 3, 4)));
    const error = gl.getError();
    if (error === gl.OUT_OF_MEMORY) throw new Error("this device has too little graphics memory for the bake");
    if (error) throw new Error(`WebGL error ${error}`);
  }

  // ---- what is kept on the device ----

  program(vertex, fragment) {
    const { gl } = this;
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made) || "no shader could be made");
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(made, i).name.replace("[0]", "");
      uniforms[name] = gl.getUniformLocation(made, name);
    }
    return { made, uniforms };
  }

  texture(target, wrapS, wrapT, filter) {
    const { gl } = this;
    gl.bindTexture(target, gl.createTexture());
    gl.texParameteri(target, gl.TEXTURE_WRAP_S, wrapS);
    gl.texParameteri(target, gl.TEXTURE_WRAP_T, wrapT);
    gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter === gl.NEAREST ? filter : gl.LINEAR);
    return gl.getParameter(target === gl.TEXTURE_2D ? gl.TEXTURE_BINDING_2D : gl.TEXTURE_BINDING_2D_ARRAY);
  }

  async page(record) {
    const { gl } = this;
    const made = this.texture(gl.TEXTURE_2D_ARRAY, gl.CLAMP_TO_EDGE, gl.CLAMP_TO_EDGE, gl.LINEAR);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA16F, ...record.size, record.layers.length);
    for (const [k, layer] of record.layers.entries()) {
      const texels = await layerTexels(layer, record.steps.slice(4 * k, 4 * k + 4));
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, made);
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, k, ...record.size, 1, gl.RGBA, gl.FLOAT, texels);
    }
    return made;
  }

  map(record, texels) {
    const { gl } = this;
    const [, height, width] = record.shape;
    const made = this.texture(gl.TEXTURE_2D, gl.REPEAT, gl.CLAMP_TO_EDGE, gl.LINEAR);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, texels);
    return made;
  }

  image(source, record) {
    const { gl } = this;
    const [wrapS, wrapT] = record.wrap.map((name) => gl[WRAPS[name]]);
    const made = this.texture(gl.TEXTURE_2D, wrapS, wrapT, gl.LINEAR_MIPMAP_LINEAR);
    const format = record.srgb ? gl.SRGB8_ALPHA8 : gl.RGBA8;
    if (source instanceof Uint8Array) {
      gl.texImage2D(gl.TEXTURE_2D, 0, format, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, source);
    } else {
      gl.texImage2D(gl.TEXTURE_2D, 0, format, gl.RGBA, gl.UNSIGNED_BYTE, source);
    }
    gl.generateMipmap(gl.TEXTURE_2D);
    if (this.anisotropic) gl.texParameterf(gl.TEXTURE_2D, this.anisotropic.TEXTURE_MAX_ANISOTROPY_EXT, 8);
    return made;
  }

  // Targets of the canvas' size.
  resize(width, height) {
    if (this.canvas.width === width && this.canvas.height === height && this.drawn) return;
    const { gl } = this;
    Object.assign(this.canvas, { width, height });
    for (const old of this.targets ?? []) gl.deleteRenderbuffer(old);
    if (this.picture) gl.deleteTexture(this.picture);
    this.targets = [[gl.COLOR_ATTACHMENT0, gl.RGBA16F], [gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24]].map(([, format]) => {
      const made = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, made);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, this.samples, format, width, height);
      return made;
    });
    this.picture = this.texture(gl.TEXTURE_2D, gl.CLAMP_TO_EDGE, gl.CLAMP_TO_EDGE, gl.NEAREST);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    this.drawn ??= gl.createFramebuffer();
    this.resolved ??= gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.drawn);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, this.targets[0]);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.targets[1]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.resolved);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.picture, 0);
  }

  // ---- a picture ----

  // `view` has clipFromWorld (columns), skyFromCamera (columns), slopes, sky, weights, whites, range, exposure and bounced.
  draw(view) {
    const { gl, canvas } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.drawn);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.depthMask(true);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.drawSky(view);
    this.drawSurfaces(view);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.drawn);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, this.resolved);
    const size = [0, 0, canvas.width, canvas.height];
    gl.blitFramebuffer(...size, ...size, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.use(this.tone, this.empty, [[gl.TEXTURE_2D, this.picture]]);
    gl.uniform1i(this.tone.uniforms.picture, 0);
    gl.uniform1f(this.tone.uniforms.scale, 2 ** view.exposure / 0.6);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Exposure in stops that makes the upper quartile of luminances in the last picture a light grey; black is left out.
  suitedExposure() {
    const { gl, canvas } = this;
    const pixels = new Float32Array(4 * canvas.width * canvas.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.resolved);
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.FLOAT, pixels);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const lit = [];
    for (let i = 0; i < pixels.length; i += 4) {
      const luminance = 0.2126 * pixels[i] + 0.7152 * pixels[i + 1] + 0.0722 * pixels[i + 2];
      if (luminance > 1e-6) lit.push(luminance);
    }
    const quartile = Float32Array.from(lit).sort()[(3 * lit.length) >> 2];
    return quartile ? Math.round(10 * Math.log2(0.35 / quartile)) / 10 : 0;
  }

  use(program, vertices, textures) {
    const { gl } = this;
    gl.useProgram(program.made);
    gl.bindVertexArray(vertices);
    textures.forEach(([target, one], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(target, one);
    });
  }

  drawSky(view) {
    const { gl } = this;
    this.use(this.sky, this.empty, [[gl.TEXTURE_2D, this.maps[view.sky]]]);
    gl.uniform1i(this.sky.uniforms.map, 0);
    gl.uniformMatrix3fv(this.sky.uniforms.skyFromCamera, false, view.skyFromCamera);
    gl.uniform2fv(this.sky.uniforms.slopes, view.slopes);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  drawSurfaces(view) {
    const { gl, about } = this;
    const { uniforms } = this.surface;
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    gl.polygonOffset(0, BACK_OFFSET);
    this.use(this.surface, this.vertices, []);
    ["transfer", "colorImage", "emissionImage"].forEach((name, unit) => gl.uniform1i(uniforms[name], unit));
    gl.uniformMatrix4fv(uniforms.clipFromWorld, false, view.clipFromWorld);
    gl.uniform4fv(uniforms.weights, view.weights);
    gl.uniform4fv(uniforms.whites, view.whites);
    gl.uniform3fv(uniforms.least, view.range[0]);
    gl.uniform3fv(uniforms.most, view.range[1]);
    gl.uniform1f(uniforms.bounced, view.bounced ? 1 : 0);
    for (const group of about.groups) {
      gl.disable(gl.POLYGON_OFFSET_FILL);
      const material = about.materials[group.material];
      const emits = group.side === 0 || material.doubleSided;
      gl.cullFace(group.side === 0 ? gl.BACK : gl.FRONT);
      if (group.side === 1) gl.enable(gl.POLYGON_OFFSET_FILL);
      this.use(this.surface, this.vertices, [
        [gl.TEXTURE_2D_ARRAY, this.pages[group.page][group.side]],
        [gl.TEXTURE_2D, this.images[material.image] ?? this.white],
        [gl.TEXTURE_2D, this.images[material.emissionImage] ?? this.white],
      ]);
      gl.uniform3fv(uniforms.color, material.color);
      gl.uniform3fv(uniforms.emission, emits ? material.emission : [0, 0, 0]);
      gl.uniform2f(uniforms.coverage, material.alpha, material.cutoff);
      gl.drawElements(gl.TRIANGLES, 3 * group.count, gl.UNSIGNED_INT, 12 * group.first);
    }
    gl.disable(gl.POLYGON_OFFSET_FILL);
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.DEPTH_TEST);
  }
}
