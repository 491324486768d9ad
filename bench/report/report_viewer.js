// The viewer of a set of pictures: two of them side by side with a slider, and the pixels under the pointer.
const PATCH = 15; // pixels a side
const ZOOM = 12;

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function brief(value) {
  if (!Number.isFinite(value)) return String(value);
  return value !== 0 && (Math.abs(value) < 1e-3 || Math.abs(value) >= 1e5) ? value.toExponential(2) : value.toPrecision(4);
}

class Viewer {
  constructor(root) {
    this.root = root;
    const about = JSON.parse(root.querySelector(".about").textContent);
    Object.assign(this, { width: about.width, height: about.height, start: about.exposure, share: 0.5 });
    this.pixel = [this.width >> 1, this.height >> 1];
    this.pictures = about.pictures;
    this.sides = {};
    this.build();
  }

  async load() {
    const packed = this.root.querySelectorAll(".pixels");
    const values = await Promise.all(Array.from(packed, (script) => decodePicture(script.textContent)));
    const reference = this.pictures[0].name === "reference" ? values[0] : null;
    this.choices = this.pictures.map((picture, i) => ({ label: picture.name, values: values[i] }));
    if (reference) {
      for (let i = 1; i < values.length; i++) {
        const label = `error of ${this.pictures[i].name}`;
        this.choices.push({ label, values: values[i], errors: relativeErrors(values[i], reference) });
      }
    }
    this.fillChoices();
    this.update();
    this.root.dataset.ready = "";
  }

  // ---- what is on the page ----

  build() {
    this.canvas = element("canvas", { width: this.width, height: this.height, tabIndex: 0 });
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "pictures; arrow keys move the magnified patch");
    this.wipe = this.buildWipe();
    this.tags = { left: element("span", { className: "tag left" }), right: element("span", { className: "tag right" }) };
    this.stage = element("div", { className: "stage" }, this.canvas, this.tags.left, this.tags.right, this.wipe);
    this.patches = element("div", { className: "patches" });
    this.buildPatches();
    const panes = element("div", { className: "panes" }, this.stage, this.patches);
    this.root.querySelector(".table").before(this.buildControls(), panes, this.buildKey());
    this.stage.addEventListener("pointermove", (event) => this.pointAt(event));
    this.stage.addEventListener("pointerdown", (event) => this.pointAt(event));
    this.canvas.addEventListener("keydown", (event) => this.stepPixel(event));
  }

  buildControls() {
    const select = (name) => element("select", { className: name, onchange: () => this.update() });
    this.left = select("choose-left");
    this.right = select("choose-right");
    this.curve = select("curve");
    this.curve.append(new Option("sRGB, clipped", "clip"), new Option("filmic", "filmic"));
    this.exposure = element("input", { type: "range", min: -8, max: 8, step: 0.25, value: this.start, className: "exposure" });
    this.stops = element("output");
    this.exposure.addEventListener("input", () => this.update());
    const reset = element("button", { type: "button", textContent: "reset" });
    reset.addEventListener("click", () => {
      this.exposure.value = this.start;
      this.update();
    });
    return element(
      "div",
      { className: "controls" },
      element("label", {}, "left", this.left),
      element("label", {}, "right", this.right),
      element("label", {}, "exposure", this.exposure, this.stops),
      reset,
      element("label", {}, "tone mapping", this.curve),
    );
  }

  buildWipe() {
    const wipe = element("div", { className: "wipe", tabIndex: 0 });
    const attributes = { role: "slider", "aria-label": "share of the left picture", "aria-valuemin": 0, "aria-valuemax": 100 };
    for (const [name, value] of Object.entries(attributes)) wipe.setAttribute(name, value);
    wipe.addEventListener("pointerdown", (event) => {
      wipe.setPointerCapture(event.pointerId);
      wipe.focus();
      event.preventDefault();
    });
    wipe.addEventListener("pointermove", (event) => {
      if (!wipe.hasPointerCapture(event.pointerId)) return;
      const box = this.canvas.getBoundingClientRect();
      this.moveWipe((event.clientX - box.left) / box.width);
    });
    const steps = { ArrowLeft: -0.01, ArrowDown: -0.01, ArrowRight: 0.01, ArrowUp: 0.01, PageDown: -0.1, PageUp: 0.1, Home: -1, End: 1 };
    wipe.addEventListener("keydown", (event) => {
      if (!(event.key in steps)) return;
      this.moveWipe(this.share + steps[event.key]);
      event.preventDefault();
    });
    return wipe;
  }

  buildPatches() {
    for (const name of ["left", "right"]) {
      const canvas = element("canvas", { width: PATCH * ZOOM, height: PATCH * ZOOM, className: `patch-${name}` });
      const text = element("p", { className: `value-${name}` });
      this.sides[name] = { canvas, text };
      this.patches.append(element("div", {}, canvas, text));
    }
    this.where = element("p", { className: "where" });
    this.patches.append(this.where);
  }

  buildKey() {
    const canvas = element("canvas", { width: 256, height: 1 });
    const context = canvas.getContext("2d");
    const image = context.createImageData(256, 1);
    for (let i = 0; i < 256; i++) image.data.set([...MAGMA_BYTES.subarray(3 * i, 3 * i + 3), 255], 4 * i);
    context.putImageData(image, 0, 0);
    const ends = element("div", { className: "ends" });
    for (let power = ERROR_LOW; power <= ERROR_HIGH; power++) ends.append(element("span", { textContent: String(10 ** power) }));
    this.bar = element("div", { className: "bar" }, "relative squared error, (a − r)² / (r² + 0.01)", canvas, ends);
    const loud = (colour, text) => {
      const box = element("i");
      box.style.background = `rgb(${colour.join(",")})`;
      return element("span", {}, box, text);
    };
    return element("div", { className: "key" }, this.bar, loud(NAN_COLOUR, "NaN"), loud(INFINITE_COLOUR, "infinite"));
  }

  fillChoices() {
    for (const select of [this.left, this.right]) {
      this.choices.forEach((choice, i) => select.add(new Option(choice.label, i)));
    }
    this.left.value = 0;
    this.right.value = Math.min(1, this.choices.length - 1);
  }

  // ---- what happens ----

  update() {
    const stops = Number(this.exposure.value);
    this.stops.textContent = `${stops > 0 ? "+" : ""}${stops} EV`;
    for (const [name, select] of [["left", this.left], ["right", this.right]]) {
      const choice = this.choices[select.value];
      Object.assign(this.sides[name], { choice, image: this.imageOf(choice, stops) });
      this.tags[name].textContent = choice.label;
    }
    this.bar.hidden = !this.sides.left.choice.errors && !this.sides.right.choice.errors;
    this.draw();
  }

  imageOf(choice, stops) {
    if (!choice.errors) return new ImageData(toneMapped(choice.values, stops, this.curve.value), this.width, this.height);
    choice.map ??= new ImageData(errorMap(choice.errors), this.width, this.height); // the same at any exposure
    return choice.map;
  }

  draw() {
    const { width, height } = this;
    const edge = Math.round(this.share * width);
    const context = this.canvas.getContext("2d");
    context.putImageData(this.sides.left.image, 0, 0, 0, 0, edge, height);
    context.putImageData(this.sides.right.image, 0, 0, edge, 0, width - edge, height);
    this.wipe.style.left = `${100 * this.share}%`;
    const percent = Math.round(100 * this.share);
    this.wipe.setAttribute("aria-valuenow", percent);
    this.wipe.setAttribute("aria-valuetext", `${percent} % ${this.sides.left.choice.label}, rest ${this.sides.right.choice.label}`);
    this.drawPatches();
  }

  moveWipe(share) {
    this.share = Math.min(Math.max(share, 0), 1);
    this.draw();
  }

  pointAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = Math.floor(((event.clientX - box.left) / box.width) * this.width);
    const y = Math.floor(((event.clientY - box.top) / box.height) * this.height);
    this.movePixel(x, y);
  }

  stepPixel(event) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (!(event.key in steps)) return;
    this.movePixel(this.pixel[0] + steps[event.key][0], this.pixel[1] + steps[event.key][1]);
    event.preventDefault();
  }

  movePixel(x, y) {
    this.pixel = [Math.min(Math.max(x, 0), this.width - 1), Math.min(Math.max(y, 0), this.height - 1)];
    if (this.choices) this.drawPatches();
  }

  drawPatches() {
    const [x, y] = this.pixel;
    const half = PATCH >> 1;
    for (const side of Object.values(this.sides)) {
      const source = new OffscreenCanvas(PATCH, PATCH);
      source.getContext("2d").putImageData(side.image, half - x, half - y);
      const context = side.canvas.getContext("2d");
      context.imageSmoothingEnabled = false;
      context.clearRect(0, 0, PATCH * ZOOM, PATCH * ZOOM);
      context.drawImage(source, 0, 0, PATCH * ZOOM, PATCH * ZOOM);
      for (const [colour, grow] of [["#000", 1.5], ["#fff", 0.5]]) {
        context.strokeStyle = colour;
        context.strokeRect(half * ZOOM - grow, half * ZOOM - grow, ZOOM + 2 * grow, ZOOM + 2 * grow);
      }
      side.text.textContent = this.valueText(side.choice, y * this.width + x);
    }
    this.where.textContent = `pixel ${x}, ${y}; linear radiance, red green blue`;
  }

  valueText(choice, index) {
    if (choice.errors) return brief(choice.errors[index]);
    return Array.from(choice.values.subarray(3 * index, 3 * index + 3), brief).join(" ");
  }
}

// Pictures are unpacked when they come near the window, not before.
const watcher = new IntersectionObserver(
  (entries) => {
    for (const entry of entries.filter((one) => one.isIntersecting)) {
      watcher.unobserve(entry.target);
      new Viewer(entry.target).load().catch((error) => {
        entry.target.append(element("p", { className: "failed", textContent: `This browser cannot show them: ${error}` }));
        throw error;
      });
    }
  },
  { rootMargin: "800px" },
);
for (const root of document.querySelectorAll(".viewer")) watcher.observe(root);
