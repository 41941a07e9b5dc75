// Mouse, touch and keyboard on the picture of the viewer.

const WHEEL = 0.002; // change of the logarithm of the zoom by a unit of the wheel
const WHEEL_LINE = 16; // units of a wheel that counts lines
const KEY_PX = 60;
const GRIP_PX = 14; // how near to the divider a drag moves it
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

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
