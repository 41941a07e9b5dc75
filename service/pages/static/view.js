// The view of the viewer: which pixels a place on the canvas shows, the address that shows the same view, and how mouse, touch and
// keyboard change it.
import { MAP_NAMES, STRETCHES } from "./stretch.js";

const WHEEL = 0.002; // change of the logarithm of the zoom by a unit of the wheel
const WHEEL_LINE = 16; // units of a wheel that counts lines
const KEY_PX = 60;
const GRIP_PX = 14; // how near to the divider a drag moves it
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

// --- pixels on the canvas ---
// Axes are treated alike, one at a time. Image coordinates: pixel n, counted from 0, reaches from n to n + 1. A view has a centre in
// image coordinates and a zoom: device pixels per pixel of the image.

/** The image coordinate at a place of an axis. place: device px from its start; length: device px of the axis. */
export function imageAt(place, length, centre, zoom) {
  return centre + (place - length / 2) / zoom;
}

/**
 * For each device pixel of an axis the first texel of a sheet that it shows, and the end (not shown): an Int32Array of pairs.
 * A device pixel that is larger than a texel shows the texels whose centres lie in the device pixel; a smaller one shows the texel at its centre. Outside
 * the sheet both numbers are equal. sheet: {start, step, count}: image coordinate of its first texel, px per texel, texels.
 */
export function texelRanges(length, centre, zoom, { start, step, count }) {
  const ranges = new Int32Array(2 * length);
  const within = (texel) => Math.min(Math.max(texel, 0), count);
  for (let place = 0; place < length; place++) {
    const from = (imageAt(place, length, centre, zoom) - start) / step;
    const to = (imageAt(place + 1, length, centre, zoom) - start) / step;
    const middle = Math.floor((from + to) / 2);
    const coarse = to - from > 1;
    ranges[2 * place] = within(coarse ? Math.ceil(from - 0.5) : middle);
    ranges[2 * place + 1] = within(coarse ? Math.ceil(to - 0.5) : middle + 1);
  }
  return ranges;
}

/** The zoom at which the whole image is seen. Enlarged, its pixels are whole numbers of device pixels. */
export function fitZoom(width, height, nx, ny) {
  const zoom = Math.min(width / nx, height / ny);
  return zoom > 1 ? Math.floor(zoom) : zoom;
}

/** The part of an axis of `size` px that is in view: its first pixel and the number of pixels, with some around it for small moves. */
export function partInView(length, centre, zoom, size, margin = 0.25) {
  const reach = (length / 2 / zoom) * (1 + margin);
  const first = Math.min(Math.max(0, Math.floor(centre - reach)), size - 1);
  return { first, count: Math.max(1, Math.min(size, Math.ceil(centre + reach)) - first) };
}

// --- the address ---

/** The default view. zoom null: fit; x, y null: the middle; low, high, change null: from percentiles. */
function plainView(mode) {
  return { mode, shown: "after", divider: 0.5, x: null, y: null, zoom: null, stretch: "asinh", map: "EUV", low: null, high: null, change: null, quality: false, error: null };
}

const ALLOWED = { stretch: STRETCHES, map: MAP_NAMES, shown: ["before", "after"] };

/** The view that the fragment of an address describes. Missing and wrong values get their defaults. */
export function viewOf(hash, modes) {
  const said = new URLSearchParams(hash.slice(1));
  const view = plainView(modes[0]);
  for (const [name, text] of said) {
    if (name === "quality") view.quality = text === "1";
    else if (name in { ...ALLOWED, mode: 0 }) view[name] = (ALLOWED[name] ?? modes).includes(text) ? text : view[name];
    else if (name in view && text !== "" && Number.isFinite(Number(text))) view[name] = Number(text);
  }
  if (!(view.zoom > 0)) view.zoom = null;
  if (!(view.high > view.low)) view.low = view.high = null;
  view.divider = Math.min(Math.max(view.divider, 0), 1);
  return view;
}

/** The view as the fragment of an address. It names the limits, {low, high, change}, so that a link shows the same everywhere. */
export function addressOf(view, limits) {
  const all = { ...view, quality: view.quality ? 1 : null, low: limits.low, high: limits.high };
  if (view.mode === "change") all.change = limits.change;
  if (view.mode !== "blink") all.shown = null;
  if (view.mode !== "slider") all.divider = null;
  return new URLSearchParams(Object.entries(all).filter(([, value]) => value !== null));
}

// --- mouse, touch and keyboard ---

/** Move and zoom a viewer by what happens on its canvas. */
export function follow(canvas, viewer) {
  const ready = (act) => (event) => {
    if (viewer.source.overview !== undefined) act(event);
  };
  const listen = (name, act, options) => canvas.addEventListener(name, ready(act), options);
  listen("keydown", (event) => key(event, viewer));
  listen("wheel", (event) => {
    event.preventDefault();
    const turned = event.deltaY * (event.deltaMode === 1 ? WHEEL_LINE : 1);
    viewer.zoomTo(viewer.zoom * Math.exp(-turned * WHEEL), event.clientX, event.clientY);
  }, { passive: false });
  listen("dblclick", (event) => {
    if (viewer.zoom === 1) viewer.fit();
    else viewer.zoomTo(1, event.clientX, event.clientY);
  });
  const touches = new Map();
  let dividing = false;
  listen("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    touches.set(event.pointerId, event);
    dividing = touches.size === 1 && viewer.view.mode === "slider" && Math.abs(event.clientX - dividerAt(canvas, viewer)) < GRIP_PX;
  });
  listen("pointermove", (event) => {
    if (!touches.has(event.pointerId)) return viewer.readout.show(viewer.pixelAt(event.clientX, event.clientY));
    const before = [...touches.values()];
    const last = touches.get(event.pointerId);
    touches.set(event.pointerId, event);
    if (dividing) return divide(event, canvas, viewer);
    if (touches.size === 2) return pinch(before, [...touches.values()], viewer);
    viewer.pan(event.clientX - last.clientX, event.clientY - last.clientY);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => {
      const started = touches.delete(event.pointerId);
      dividing = false;
      // A touch leaves no cursor on the picture, so the readout shows the touched pixel.
      if (started && event.pointerType === "touch" && viewer.source.overview) viewer.readout.show(viewer.pixelAt(event.clientX, event.clientY));
    });
  }
}

function dividerAt(canvas, viewer) {
  const box = canvas.getBoundingClientRect();
  return box.left + viewer.view.divider * box.width;
}

function divide(event, canvas, viewer) {
  const box = canvas.getBoundingClientRect();
  viewer.set({ divider: Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1) });
}

/** Move and zoom so that the points of the image under two fingers stay under them. */
function pinch(before, after, viewer) {
  const span = ([a, b]) => Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
  const middle = ([a, b]) => [(a.clientX + b.clientX) / 2, (a.clientY + b.clientY) / 2];
  const [from, to] = [middle(before), middle(after)];
  viewer.pan(to[0] - from[0], to[1] - from[1]);
  if (span(before) > 0) viewer.zoomTo((viewer.zoom * span(after)) / span(before), ...to);
}

function key(event, viewer) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const arrow = ARROWS[event.key];
  const acts = { b: () => viewer.blink(), f: () => viewer.fit(), 1: () => viewer.zoomTo(1), "+": () => viewer.zoomBy(1), "=": () => viewer.zoomBy(1), "-": () => viewer.zoomBy(-1) };
  const act = arrow === undefined ? acts[event.key] : () => (event.shiftKey ? viewer.step(...arrow) : viewer.pan(-arrow[0] * KEY_PX, arrow[1] * KEY_PX));
  if (act === undefined) return;
  event.preventDefault();
  act();
}
