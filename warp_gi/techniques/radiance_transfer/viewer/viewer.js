// The view and the sky, and what turns them: mouse, fingers, keys, the panel, and the address (#turn=90&sky=1&...).
const MOST_TILT = (89 * Math.PI) / 180;
const STEP = 5; // degrees of a key
const MOST_STOPS = 16;
const MOST_RATIO = 2; // pixels of the canvas for one of the page

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (a, factor) => a.map((value) => value * factor);
const sum = (a, b) => a.map((value, i) => value + b[i]);

class View {
  constructor(camera, bounds) {
    this.camera = camera;
    this.radius = 0.5 * Math.hypot(...[0, 1, 2].map((i) => bounds[1][i] - bounds[0][i]));
    this.middle = [0, 1, 2].map((i) => 0.5 * (bounds[0][i] + bounds[1][i]));
    this.reset();
  }

  reset() {
    const [, , back] = this.camera.axes;
    Object.assign(this, { yaw: 0, pitch: 0, distance: this.camera.distance });
    this.target = sum(this.camera.position, scaled(back, -this.distance));
    this.firstTilt = Math.asin(Math.min(1, Math.max(-1, -back[1])));
  }

  // Degrees about +y, and upwards.
  orbit(yaw, pitch) {
    this.yaw += (yaw * Math.PI) / 180;
    const low = Math.min(-MOST_TILT, this.firstTilt);
    const high = Math.max(MOST_TILT, this.firstTilt);
    this.pitch = Math.min(high, Math.max(low, this.firstTilt + this.pitch + (pitch * Math.PI) / 180)) - this.firstTilt;
  }

  zoom(factor) {
    this.distance = Math.min(20 * this.radius, Math.max(0.002 * this.radius, this.distance * factor));
  }

  // By shares of the picture's height.
  pan(x, y) {
    const [right, up] = this.axes();
    const size = 2 * this.distance * this.slopes(1)[1];
    this.target = sum(this.target, sum(scaled(right, x * size), scaled(up, y * size)));
  }

  // Right, up and back in the world: the first ones tilted about the right axis, then turned about +y.
  axes() {
    const [right, up, back] = this.camera.axes;
    const [c, s] = [Math.cos(this.pitch), Math.sin(this.pitch)];
    const tilted = [right, sum(scaled(up, c), scaled(back, s)), sum(scaled(up, -s), scaled(back, c))];
    const turn = aboutUp((this.yaw * 180) / Math.PI);
    return tilted.map((axis) => turn.map((row) => dot(row, axis)));
  }

  // Tangents of half the angles across and upwards: all of the camera's own picture is seen in a window of any form.
  slopes(aspect) {
    const across = Math.tan((this.camera.hfov * Math.PI) / 360);
    const up = across / this.camera.aspect;
    return aspect > this.camera.aspect ? [up * aspect, up] : [across, across / aspect];
  }

  clipFromWorld(aspect) {
    const axes = this.axes();
    const eye = sum(this.target, scaled(axes[2], this.distance));
    const away = Math.hypot(...sum(eye, scaled(this.middle, -1)));
    const near = Math.max(1e-3 * this.radius, 0.5 * (away - 1.1 * this.radius));
    const far = away + 1.1 * this.radius;
    const [x, y] = this.slopes(aspect);
    const rows = [
      scaled([...axes[0], -dot(axes[0], eye)], 1 / x),
      scaled([...axes[1], -dot(axes[1], eye)], 1 / y),
      scaled([...axes[2], -dot(axes[2], eye)], -(far + near) / (far - near)),
      scaled([...axes[2], -dot(axes[2], eye)], -1),
    ];
    rows[2][3] -= (2 * far * near) / (far - near);
    return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
  }
}

class Viewer {
  constructor(about) {
    this.about = about;
    this.canvas = document.getElementById("view");
    this.view = new View(about.camera, about.bounds);
    this.state = { sky: 0, turn: 0, exposure: about.exposure ?? 0, bounces: true };
    this.pointers = new Map();
  }

  async start() {
    this.drawing = new Drawing(this.canvas, this.about);
    await this.drawing.load();
    this.fillPanel();
    this.readAddress();
    this.listen();
    this.render();
    if (this.about.exposure === null && !new URLSearchParams(location.hash.slice(1)).has("exposure")) this.suit();
    document.getElementById("message").textContent = "";
    document.documentElement.dataset.ready = "";
  }

  // ---- drawing, once for all that changed since the last picture ----

  changed() {
    this.waiting ??= requestAnimationFrame(() => this.render());
  }

  render() {
    this.waiting = null;
    const { view, state, about } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, MOST_RATIO);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((n) => Math.max(1, Math.round(n * ratio)));
    const aspect = width / height;
    const sky = about.skies[state.sky];
    const light = turnedLight(sky.light, aboutUp(state.turn), about.sphere);
    const skyFromWorld = aboutUp(-(sky.rotation + state.turn));
    this.drawing.resize(width, height);
    this.drawing.draw({
      clipFromWorld: view.clipFromWorld(aspect),
      skyFromCamera: new Float32Array(view.axes().flatMap((axis) => skyFromWorld.map((row) => dot(row, axis)))),
      slopes: view.slopes(aspect),
      sky: state.sky,
      weights: layerWeights(light, about.components, about.layers, DIRECT_LAYERS),
      whites: layerWeights(WHITE, about.components, about.layers, DIRECT_LAYERS),
      range: sky.range,
      exposure: state.exposure,
      bounced: state.bounces,
    });
  }

  // ---- the panel ----

  fillPanel() {
    const choice = document.getElementById("sky");
    document.getElementById("panel").open = window.innerWidth >= 600;
    this.about.skies.forEach((sky, k) => choice.add(new Option(sky.name, k)));
    document.getElementById("notes").textContent = this.about.notes.join(" ");
    document.getElementById("bounces-label").hidden = !this.about.hasBounces;
    choice.addEventListener("change", () => this.set({ sky: Number(choice.value) }));
    for (const name of ["turn", "exposure"]) {
      const slider = document.getElementById(name);
      slider.addEventListener("input", () => this.set({ [name]: Number(slider.value) }));
    }
    document.getElementById("suit").addEventListener("click", () => this.suit());
    const bounces = document.getElementById("bounces");
    bounces.addEventListener("change", () => this.set({ bounces: bounces.checked }));
  }

  suit() {
    this.set({ exposure: this.drawing.suitedExposure() });
  }

  set(values) {
    Object.assign(this.state, values);
    const { state } = this;
    state.turn -= 360 * Math.round(state.turn / 360);
    state.exposure = Math.min(MOST_STOPS, Math.max(-MOST_STOPS, state.exposure));
    document.getElementById("sky").value = state.sky;
    document.getElementById("turn").value = state.turn;
    document.getElementById("turn-value").textContent = `${state.turn.toFixed(0)}\u00b0`;
    document.getElementById("exposure").value = state.exposure;
    document.getElementById("exposure-value").textContent = `${state.exposure.toFixed(1)} stops`;
    document.getElementById("bounces").checked = state.bounces;
    this.changed();
  }

  // turn, exposure [stops], sky (its number), bounces (0 or 1), bare (1: no panel), and yaw and pitch of the view.
  readAddress() {
    const given = new URLSearchParams(location.hash.slice(1));
    const number = (name, otherwise) => {
      const value = Number.parseFloat(given.get(name) ?? "");
      return Number.isFinite(value) ? value : otherwise;
    };
    const { state } = this;
    document.body.classList.toggle("bare", number("bare", 0) === 1);
    this.view.reset();
    this.view.orbit(number("yaw", 0), number("pitch", 0));
    this.set({
      turn: number("turn", 0),
      exposure: number("exposure", this.about.exposure ?? this.state.exposure),
      sky: Math.min(this.about.skies.length - 1, Math.max(0, Math.round(number("sky", state.sky)))),
      bounces: number("bounces", 1) !== 0,
    });
  }

  // ---- mouse, fingers and keys ----

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("webglcontextlost", () => fail(new Error("the graphics device was lost; load the page again")));
    document.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("resize", () => this.changed());
    window.addEventListener("hashchange", () => this.readAddress());
  }

  down(event) {
    event.preventDefault();
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  move(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - last[0], now[1] - last[1]];
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.pointers.set(event.pointerId, now);
    if (others.length > 0) {
      const apart = (place) => Math.max(Math.hypot(place[0] - others[0][0], place[1] - others[0][1]), 1);
      this.view.zoom(apart(last) / apart(now));
      this.set({ turn: this.state.turn + 0.25 * dx });
    } else if (event.buttons & 2 || event.shiftKey) {
      this.set({ turn: this.state.turn + 0.5 * dx });
    } else if (event.buttons & 4 || event.ctrlKey || event.metaKey) {
      this.view.pan(-dx / this.canvas.clientHeight, dy / this.canvas.clientHeight);
    } else {
      this.view.orbit(-0.4 * dx, -0.4 * dy);
    }
    this.changed();
  }

  wheel(event) {
    event.preventDefault();
    const lines = event.deltaMode === 0 ? event.deltaY / 40 : event.deltaY;
    this.view.zoom(1.05 ** Math.max(-20, Math.min(20, lines)));
    this.changed();
  }

  key(event) {
    const isOfPanel = event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement;
    if (isOfPanel || event.ctrlKey || event.metaKey || event.altKey) return;
    const { view, state } = this;
    const actions = {
      arrowleft: () => view.orbit(-STEP, 0),
      arrowright: () => view.orbit(STEP, 0),
      arrowup: () => view.orbit(0, -STEP),
      arrowdown: () => view.orbit(0, STEP),
      a: () => this.set({ turn: state.turn - STEP }),
      d: () => this.set({ turn: state.turn + STEP }),
      "+": () => view.zoom(1 / 1.1),
      "=": () => view.zoom(1 / 1.1),
      "-": () => view.zoom(1.1),
      e: () => this.suit(),
      r: () => this.readAddress(),
      h: () => document.body.classList.toggle("bare"),
    };
    const action = actions[event.key.toLowerCase()];
    if (!action) return;
    event.preventDefault();
    action();
    this.changed();
  }
}

function fail(error) {
  const message = document.getElementById("message");
  message.setAttribute("role", "alert");
  message.textContent = `Cannot show this bake: ${error.message || error}.`;
  document.documentElement.dataset.failed = "";
}

function main() {
  let about;
  try {
    about = JSON.parse(document.getElementById("about").textContent);
  } catch {
    return fail(new Error("the page is damaged"));
  }
  const viewer = new Viewer(about);
  window.viewer = viewer;
  return viewer.start().catch(fail);
}

main();
