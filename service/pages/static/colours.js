// The colour maps. A map is a list of control points: a share of the range (0 to 1) and its red, green and blue. Colours between
// them are interpolated linearly in sRGB.
import { LEVELS } from "./stretch.js";

const NEUTRAL = 0xf4f2ee;
const HALF = (LEVELS / 2 - 1) / (LEVELS - 1); // the two middle levels are both neutral

// "EUV" has the control points of psfcore/drawing/colour_map.py; a test compares the two.
const MAPS = {
  EUV: [[0, 0x000000], [0.18, 0x2e1500], [0.4, 0x7d4400], [0.62, 0xc98612], [0.82, 0xf3c34d], [1, 0xfffbe8]],
  grey: [[0, 0x000000], [1, 0xffffff]],
  sea: [[0, 0x160a33], [0.2, 0x28336e], [0.4, 0x22607f], [0.6, 0x2c8f7c], [0.8, 0x79bf5c], [1, 0xf3ec6b]],
  change: [[0, 0x08306b], [0.25, 0x4a90c8], [HALF, NEUTRAL], [1 - HALF, NEUTRAL], [0.75, 0xd9813c], [1, 0x6b1a08]],
};
export const MAP_NAMES = ["EUV", "grey", "sea"];
export const CHANGE = "change";
export const NO_DATA = [0x3a, 0x4a, 0x5a]; // a blue grey, which no map contains

/** A map as 256 colours: a Uint8Array of red, green, blue and opacity. */
export function colourTable(name) {
  const points = MAPS[name];
  const table = new Uint8Array(4 * LEVELS);
  for (let level = 0; level < LEVELS; level++) {
    const share = level / (LEVELS - 1);
    const next = Math.max(1, points.findIndex(([at]) => at >= share));
    const [[from, first], [to, last]] = [points[next - 1], points[next]];
    const part = (share - from) / (to - from);
    for (const [channel, shift] of [16, 8, 0].entries()) {
      const [a, b] = [(first >> shift) & 0xff, (last >> shift) & 0xff];
      table[4 * level + channel] = Math.round(a + (b - a) * part);
    }
    table[4 * level + 3] = 255;
  }
  return table;
}
