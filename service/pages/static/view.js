// The view of the viewer, and the address that shows the same view.
import { MAP_NAMES } from "./colours.js";
import { STRETCHES } from "./stretch.js";

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
