// The viewer of a product: the image before and after with one view, one stretch and one readout. The view is in the address.
import { CHANGE, changes, colourTable, exactText, levelLimits, LEVELS, MAP_NAMES, percentiles, STRETCHES, valueAt } from "./stretch.js";
import { Renderer } from "./gl.js";
import { Readout, Source } from "./planes.js";
import { addressOf, fitZoom, follow, imageAt, viewOf } from "./view.js";
import { element, say, showHeader, told } from "./page.js";

const MOST_ZOOM = 64;
const SETTLED_MS = 150;
const TICKS = [0, 0.25, 0.5, 0.75, 1].map((share) => share * (LEVELS - 1));
const CHANGE_PERCENTILE = 99;

const place = document.getElementById("viewer");
const part = (id) => document.getElementById(id);

class Viewer {
  constructor() {
    this.canvas = part("canvas");
    this.modes = [...part("mode").options].map((option) => option.value);
    this.view = viewOf(location.hash, this.modes);
    this.percent = [0.1, 99.9];
    this.found = {}; // limits from percentiles
    this.tables = {};
    this.source = new Source({ before: place.dataset.before ?? null, after: place.dataset.after }, () => this.arrived());
    this.readout = new Readout(this.source, place.dataset.after, (error) => say(part("viewer-said"), told(error), "error"));
  }

  /** Show the image. Throws an Error if the browser has no WebGL2, and the errors of the service if pixels cannot be loaded. */
  async open() {
    part("viewer-body").hidden = part("keys-box").hidden = false;
    const box = this.canvas.getBoundingClientRect();
    const shape = place.dataset.shape?.split(",").map(Number);
    const ratio = devicePixelRatio || 1;
    const width = (box.width * ratio) / (this.view.mode === "side" ? 2 : 1);
    // The service reads pixels while the browser prepares WebGL, which takes a second without a graphics card.
    const [overview] = await Promise.all([this.source.open(width, box.height * ratio, shape), this.prepare()]);
    await this.source.show(overview);
    const replaced = await this.source.openAll();
    if (replaced !== null) this.renderer.release(replaced);
    await this.loadView();
  }

  async prepare() {
    this.renderer = new Renderer(this.canvas);
    this.resize();
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.connect();
  }

  resize() {
    const box = this.canvas.getBoundingClientRect();
    const ratio = devicePixelRatio || 1;
    const size = (length) => Math.max(2, Math.min(Math.round(length * ratio), this.renderer.largest));
    const [width, height] = [size(box.width), size(box.height)];
    if (this.canvas.width !== width || this.canvas.height !== height) [this.canvas.width, this.canvas.height] = [width, height];
    this.redraw();
  }

  /** Show the pixels that have arrived, with limits from all pixels that are loaded. */
  arrived() {
    const { overview } = this.source;
    if (overview !== this.measured) {
      this.measured = overview;
      this.found = {};
      this.readout.headers();
    }
    this.measure();
    say(part("viewer-said"), null);
    this.redraw();
    this.readout.refresh();
  }

  /** Find the limits that the view leaves to percentiles. */
  measure() {
    const { before, after } = this.measured.planes;
    if (this.found.limits === undefined) {
      const found = percentiles([before, after].filter((plane) => plane !== undefined), this.percent) ?? [0, 1];
      this.found.limits = found[1] > found[0] ? found : [found[0], found[0] + 1];
    }
    if (this.view.mode === "change" && this.found.change === undefined) {
      const sizes = changes(before, after).map(Math.abs);
      this.found.change = Number(percentiles([sizes], [CHANGE_PERCENTILE])?.[0].toPrecision(2)) || 1;
    }
    this.fill();
  }

  get limits() {
    const [low, high] = this.view.low === null ? (this.found.limits ?? [0, 1]) : [this.view.low, this.view.high];
    return { low, high, change: this.view.change ?? this.found.change ?? 1 };
  }

  /** Width of the axis on which one image is shown, device px. */
  get axis() {
    return this.view.mode === "side" ? Math.floor(this.canvas.width / 2) : this.canvas.width;
  }

  get zoom() {
    return this.view.zoom ?? fitZoom(this.axis, this.canvas.height, this.source.nx, this.source.ny);
  }

  get centre() {
    return { x: this.view.x ?? this.source.nx / 2, y: this.view.y ?? this.source.ny / 2 };
  }

  panels() {
    const { width } = this.canvas;
    const { mode, shown, divider } = this.view;
    const whole = { left: 0, width, from: 0, to: width };
    if (mode === "slider") {
      const cut = Math.round(divider * width);
      return [{ ...whole, to: cut, shown: "before" }, { ...whole, from: cut, shown: "after" }];
    }
    if (mode === "side") {
      const left = width - this.axis;
      return [
        { left: 0, width: this.axis, from: 0, to: this.axis, shown: "before" },
        { left, width: this.axis, from: left, to: width, shown: "after" },
      ];
    }
    return [{ ...whole, shown: mode === "blink" ? shown : mode }];
  }

  redraw() {
    if (this.drawing || this.source.overview === undefined) return;
    this.drawing = requestAnimationFrame(() => {
      this.drawing = null;
      this.draw();
    });
  }

  draw() {
    const { view, limits } = this;
    const values = this.table(`${view.stretch} ${limits.low} ${limits.high}`, () => levelLimits(view.stretch, limits.low, limits.high));
    const colours = this.table(view.map, () => colourTable(view.map));
    const changed = this.table(`change ${limits.change}`, () => levelLimits("linear", -limits.change, limits.change));
    const changeColours = this.table(CHANGE, () => colourTable(CHANGE));
    const look = {
      centre: this.centre,
      zoom: this.zoom,
      limits: { before: values, after: values, change: changed },
      colours: { before: colours, after: colours, change: changeColours },
      markQuality: view.quality,
      markError: view.error,
    };
    const panels = this.panels();
    this.renderer.draw(this.source.sheets, panels, look);
    // The other side must be ready before the first blink.
    if (view.mode === "blink") this.renderer.prepare(this.source.sheets, { ...panels[0], shown: view.shown === "before" ? "after" : "before" }, look);
    this.decorate(view.mode === "change" ? changeColours : colours);
    this.mark();
  }

  /** Record, for measurements, the time at which the overview, and later all pixels, are on the screen (in the next frame). */
  mark() {
    const name = this.source.overview.step === 1 ? "all pixels" : "overview";
    if (this.marked === name) return;
    this.marked = name;
    requestAnimationFrame(() => performance.mark(name));
  }

  /** The table of this name; it is made once and then kept. */
  table(name, make) {
    if (!(name in this.tables)) {
      if (Object.keys(this.tables).length > 16) this.tables = {};
      this.tables[name] = make();
    }
    return this.tables[name];
  }

  /** Update the elements around the picture: zoom, labels, divider, cross and colour bar. */
  decorate(colours) {
    const { view } = this;
    part("zoom").textContent = `${Number((100 * this.zoom).toPrecision(3))} %`;
    const two = view.mode === "slider" || view.mode === "side";
    part("tag-left").textContent = two ? "before" : view.mode === "blink" ? view.shown : view.mode === "change" ? "change, %" : "after";
    part("tag-right").textContent = two ? "after" : "";
    part("line").hidden = part("divider").hidden = view.mode !== "slider";
    part("line").style.left = `${100 * view.divider}%`;
    this.readout.showCross(part("cross"), (x, y) => this.placeOf(x, y));
    this.drawBar(colours);
  }

  drawBar(colours) {
    const { view, limits } = this;
    const said = `${view.mode === "change"} ${view.stretch} ${view.map} ${limits.low} ${limits.high} ${limits.change}`;
    if (said === this.bar) return;
    this.bar = said;
    part("colours").getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(colours), LEVELS, 1), 0, 0);
    const change = view.mode === "change";
    const value = (level) => (change ? valueAt(level, "linear", -limits.change, limits.change) : valueAt(level, view.stretch, limits.low, limits.high));
    const unit = change ? "%" : this.source.unit;
    part("ticks").replaceChildren(...TICKS.map((level, index) => element("span", {}, `${Number(value(level).toPrecision(3))}${index === TICKS.length - 1 ? ` ${unit}` : ""}`)));
    for (const name of document.querySelectorAll("[data-unit]")) name.textContent = this.source.unit;
  }

  /** The pixel (x, y, counted from 0) at a place of the canvas (CSS px); null outside the image. */
  pixelAt(left, top) {
    const { x, y } = this.imageAt(left, top);
    const [column, row] = [Math.floor(x), Math.floor(y)];
    return column >= 0 && row >= 0 && column < this.source.nx && row < this.source.ny ? { x: column, y: row } : null;
  }

  imageAt(left, top) {
    const box = this.canvas.getBoundingClientRect();
    const across = (left - box.left) * (this.canvas.width / box.width);
    const up = this.canvas.height - (top - box.top) * (this.canvas.height / box.height);
    const start = this.view.mode === "side" && across >= this.canvas.width - this.axis ? this.canvas.width - this.axis : 0;
    return { x: imageAt(across - start, this.axis, this.centre.x, this.zoom), y: imageAt(up, this.canvas.height, this.centre.y, this.zoom) };
  }

  /** Where the middle of a pixel is, in percent of the canvas from its left and top. */
  placeOf(x, y) {
    const across = this.axis / 2 + (x + 0.5 - this.centre.x) * this.zoom;
    const up = this.canvas.height / 2 + (y + 0.5 - this.centre.y) * this.zoom;
    return { left: (100 * across) / this.canvas.width, top: 100 * (1 - up / this.canvas.height) };
  }

  /** Change the view; the address follows. */
  set(changed) {
    Object.assign(this.view, changed);
    const { view, source } = this;
    if (source.overview === undefined) return;
    if (view.x !== null) view.x = Math.min(Math.max(view.x, 0), source.nx);
    if (view.y !== null) view.y = Math.min(Math.max(view.y, 0), source.ny);
    if ("mode" in changed) this.measure();
    this.redraw();
    this.fill();
    clearTimeout(this.settling);
    this.settling = setTimeout(() => this.settled(), SETTLED_MS);
  }

  /** Called when the view has not changed for a moment: write it into the address, and load what it needs. */
  async settled() {
    history.replaceState(history.state, "", `#${addressOf(this.view, this.limits)}`);
    try {
      await this.loadView();
    } catch (error) {
      say(part("viewer-said"), told(error), "error");
    }
  }

  /** Load the planes and the part of the image that the view needs. Throws the errors of the service. */
  async loadView() {
    await this.wantMarks();
    try {
      const old = await this.source.showPart(this.canvas.width, this.canvas.height, this.centre, this.zoom);
      if (old !== null) this.renderer.release(old);
    } catch (error) {
      if (error.name !== "AbortError") throw error; // the view moved on
    }
  }

  async wantMarks() {
    if (this.view.quality) await this.source.want("quality");
    if (this.view.error !== null) await this.source.want("error");
  }

  /** Zoom, with the image coordinate at a place of the canvas (CSS px) kept where it is. */
  zoomTo(zoom, left = null, top = null) {
    const least = Math.min(fitZoom(this.axis, this.canvas.height, this.source.nx, this.source.ny), 1) / 2;
    const next = Math.min(Math.max(zoom, least), MOST_ZOOM);
    if (left === null) return this.set({ ...this.centre, zoom: next });
    const held = this.imageAt(left, top);
    const share = this.zoom / next;
    this.set({ zoom: next, x: held.x + (this.centre.x - held.x) * share, y: held.y + (this.centre.y - held.y) * share });
  }

  /** Zoom to the next power of two. */
  zoomBy(direction) {
    const power = Math.log2(this.zoom);
    this.zoomTo(2 ** (direction > 0 ? Math.floor(power + 1e-9) + 1 : Math.ceil(power - 1e-9) - 1));
  }

  /** Move the picture by CSS px. */
  pan(across, down) {
    const ratio = this.canvas.width / this.canvas.getBoundingClientRect().width;
    const { x, y } = this.centre;
    this.set({ zoom: this.zoom, x: x - (across * ratio) / this.zoom, y: y + (down * ratio) / this.zoom });
  }

  fit() {
    this.set({ zoom: null, x: null, y: null });
  }

  blink() {
    if (place.dataset.before === undefined) return;
    if (this.view.mode !== "blink") this.set({ mode: "blink", shown: "before" });
    else this.set({ shown: this.view.shown === "before" ? "after" : "before" });
  }

  /** Move the cursor by pixels of the image, and keep it in sight. */
  step(across, up) {
    const from = this.readout.pixel ?? { x: Math.floor(this.centre.x), y: Math.floor(this.centre.y) };
    const pixel = { x: Math.min(Math.max(from.x + across, 0), this.source.nx - 1), y: Math.min(Math.max(from.y + up, 0), this.source.ny - 1) };
    this.readout.show(pixel, true);
    const { left, top } = this.placeOf(pixel.x, pixel.y);
    const right = (100 * this.axis) / this.canvas.width;
    if (left < 0 || left > right || top < 0 || top > 100) this.set({ zoom: this.zoom, x: pixel.x + 0.5, y: pixel.y + 0.5 });
    else this.redraw();
  }

  /** Fill the controls from the view. */
  fill() {
    const { view, limits } = this;
    const values = { mode: view.mode, stretch: view.stretch, map: view.map, divider: view.divider, low: exactText(Math.fround(limits.low)), high: exactText(Math.fround(limits.high)), change: limits.change, "percent-low": this.percent[0], "percent-high": this.percent[1] };
    for (const [id, value] of Object.entries(values)) {
      const control = part(id);
      if (control !== null && (control.type !== "number" || control !== document.activeElement)) control.value = value;
    }
    part("quality").checked = view.quality;
    part("error").checked = view.error !== null;
    if (view.error !== null && part("error-percent") !== document.activeElement) part("error-percent").value = view.error;
    part("change-row")?.toggleAttribute("hidden", view.mode !== "change");
  }

  connect() {
    part("stretch").replaceChildren(...STRETCHES.map((name) => element("option", {}, name)));
    part("map").replaceChildren(...MAP_NAMES.map((name) => element("option", {}, name)));
    this.fill();
    const on = (id, event, act) => part(id)?.addEventListener(event, act);
    for (const name of ["mode", "stretch", "map"]) on(name, "change", () => this.set({ [name]: part(name).value }));
    on("divider", "input", () => this.set({ divider: part("divider").valueAsNumber }));
    for (const name of ["low", "high"]) on(name, "change", () => this.type());
    for (const name of ["percent-low", "percent-high"]) on(name, "change", () => this.typePercentiles());
    on("change", "change", () => part("change").valueAsNumber > 0 && this.set({ change: part("change").valueAsNumber }));
    on("quality", "change", () => this.set({ quality: part("quality").checked }));
    for (const name of ["error", "error-percent"]) on(name, "change", () => this.set({ error: part("error").checked ? part("error-percent").valueAsNumber || 0 : null }));
    on("blink", "click", () => this.blink());
    on("fit", "click", () => this.fit());
    on("actual", "click", () => this.zoomTo(1));
    on("smaller", "click", () => this.zoomBy(-1));
    on("larger", "click", () => this.zoomBy(1));
    addEventListener("hashchange", () => {
      this.view = viewOf(location.hash, this.modes);
      this.set({ mode: this.view.mode });
    });
    addEventListener("resize", () => this.resize()); // also after a change of the screen's pixels
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault(); // the browser then gives the card back
      say(part("viewer-said"), "The browser has lost access to the graphics card. The picture comes back when the access is restored.");
    });
    this.canvas.addEventListener("webglcontextrestored", () => {
      this.renderer.start();
      say(part("viewer-said"), null);
      this.redraw();
    });
    follow(this.canvas, this);
  }

  type() {
    const [low, high] = [part("low").valueAsNumber, part("high").valueAsNumber];
    if (high > low) return this.set({ low, high });
    say(part("viewer-said"), `Expected the first limit to be below the second one; got ${part("low").value} and ${part("high").value}.`, "error");
  }

  typePercentiles() {
    const percent = [part("percent-low").valueAsNumber, part("percent-high").valueAsNumber];
    if (!(percent[0] >= 0 && percent[1] <= 100 && percent[1] > percent[0])) {
      return say(part("viewer-said"), "Expected two percentiles between 0 and 100, the smaller one first.", "error");
    }
    this.percent = percent;
    this.found.limits = undefined;
    this.view.low = this.view.high = null;
    this.measure();
    this.set({});
  }
}

/** Show the picture that the service drew, and say why. */
function fallBack(reason) {
  part("viewer-body").hidden = part("keys-box").hidden = true;
  const picture = element("img", { class: "picture", src: place.dataset.preview, alt: "The image before and after the deconvolution, and the change" });
  place.append(picture);
  say(part("viewer-said"), reason, "note");
}

const viewer = new Viewer();
try {
  await viewer.open();
} catch (error) {
  if (viewer.renderer === undefined) fallBack(`The viewer cannot start: ${error.message}. This picture shows the image before and after, and the change. Another browser, or one with hardware acceleration, shows the viewer.`);
  else if (viewer.source.overview === undefined) fallBack(told(error));
  else say(part("viewer-said"), told(error), "error");
}
// The header is loaded last, so that the pixels do not wait for it.
for (const header of document.querySelectorAll("[data-header]")) showHeader(header);
