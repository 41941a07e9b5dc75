// From pixel values to levels of brightness, 0 to 255, and from levels to colours. The graphics card gets the limits between the
// levels and the table of colours from here, so that the picture, the colour bar and the tests share one definition.

export const LEVELS = 256;
const ASINH_SOFTENING = 0.1; // share of the range below which asinh is nearly linear
const LOG_CONTRAST = 1000;

// Each stretch by its inverse: the share of the range (0 to 1) at which the brightness (0 to 1) is reached.
const SHARES = {
  linear: (brightness) => brightness,
  sqrt: (brightness) => brightness * brightness,
  asinh: (brightness) => ASINH_SOFTENING * Math.sinh(brightness * Math.asinh(1 / ASINH_SOFTENING)),
  log: (brightness) => Math.expm1(brightness * Math.log1p(LOG_CONTRAST)) / LOG_CONTRAST,
};
export const STRETCHES = Object.keys(SHARES);

/** The value in the middle of a level. low, high: the values of the levels 0 and 255. */
export function valueAt(level, stretch, low, high) {
  return low + (high - low) * SHARES[stretch](level / (LEVELS - 1));
}

/** For each level, the smallest float32 that has it, as a Float32Array of 256. Level 0 has no lower limit. */
export function levelLimits(stretch, low, high) {
  const limits = new Float32Array(LEVELS);
  limits[0] = -Infinity;
  for (let level = 1; level < LEVELS; level++) limits[level] = float32From(valueAt(level - 0.5, stretch, low, high));
  return limits;
}

/** The level of a value. The shader does the same comparisons. */
export function levelOf(value, limits) {
  let level = 0;
  for (let step = LEVELS / 2; step >= 1; step /= 2) if (value >= limits[level + step]) level += step;
  return level;
}

const number = new Float32Array(1);
const bits = new Uint32Array(number.buffer);

/** The smallest float32 that is not below a number. */
function float32From(value) {
  number[0] = value;
  if (number[0] >= value) return number[0];
  if (number[0] > 0 || bits[0] === 0) bits[0] += 1;
  else if (bits[0] === 0x80000000) bits[0] = 1;
  else bits[0] -= 1;
  return number[0];
}

/** The shortest text of a float32 that reads back as the same float32. */
export function exactText(value) {
  if (!Number.isFinite(value)) return String(value);
  for (let digits = 1; digits <= 9; digits++) {
    const text = value.toPrecision(digits);
    if (Math.fround(Number(text)) === value) return String(Number(text));
  }
  throw new RangeError(`expected a float32; got ${value}`);
}

/** Percentiles, as numpy.percentile gives them, of the finite values of some Float32Arrays; null if there is none. */
export function percentiles(arrays, wanted) {
  const coarse = new Uint32Array(1 << 16);
  let count = 0;
  for (const array of arrays) {
    const keys = new Uint32Array(array.buffer, array.byteOffset, array.length);
    for (let i = 0; i < keys.length; i++) {
      if (!isFinite32(keys[i])) continue;
      coarse[ordered(keys[i]) >>> 16] += 1;
      count += 1;
    }
  }
  if (count === 0) return null;
  const places = wanted.map((percent) => (percent / 100) * (count - 1));
  const ranks = new Set(places.flatMap((place) => [Math.floor(place), Math.ceil(place)]));
  const found = valuesOfRanks(arrays, coarse, ranks);
  return places.map((place) => {
    const [below, above] = [found.get(Math.floor(place)), found.get(Math.ceil(place))];
    return below + (above - below) * (place - Math.floor(place));
  });
}

function isFinite32(key) {
  return (key & 0x7f800000) !== 0x7f800000;
}

/** The bits of a float32 as an integer that grows with the number. */
function ordered(key) {
  return (key & 0x80000000 ? ~key : key | 0x80000000) >>> 0;
}

/** The values of ranks (0: the smallest). coarse: how many values have each upper half of `ordered`. */
function valuesOfRanks(arrays, coarse, ranks) {
  const bins = new Map(); // upper half: its first rank and its values
  for (let half = 0, first = 0; half < coarse.length; first += coarse[half], half++) {
    if (coarse[half] > 0 && [...ranks].some((rank) => rank >= first && rank < first + coarse[half])) {
      bins.set(half, { first, values: new Float32Array(coarse[half]), filled: 0 });
    }
  }
  const wanted = new Uint8Array(coarse.length);
  for (const half of bins.keys()) wanted[half] = 1;
  for (const array of arrays) {
    const keys = new Uint32Array(array.buffer, array.byteOffset, array.length);
    for (let i = 0; i < keys.length; i++) {
      const half = ordered(keys[i]) >>> 16;
      if (wanted[half] === 0 || !isFinite32(keys[i])) continue;
      const bin = bins.get(half);
      bin.values[bin.filled++] = array[i];
    }
  }
  const found = new Map();
  for (const { first, values } of bins.values()) {
    values.sort();
    for (const rank of ranks) if (rank >= first && rank < first + values.length) found.set(rank, values[rank - first]);
  }
  return found;
}

/** The change of every pixel, percent; NaN where the value before is not above zero. */
export function changes(before, after) {
  const found = new Float32Array(before.length);
  for (let i = 0; i < found.length; i++) found[i] = before[i] > 0 ? (100 * (after[i] - before[i])) / before[i] : NaN;
  return found;
}

// --- colour maps ---
// A map is a list of control points: a share of the range (0 to 1) and its red, green and blue. Colours between them are interpolated
// linearly in sRGB.

const NEUTRAL = 0xf4f2ee;
const HALF = (LEVELS / 2 - 1) / (LEVELS - 1); // the two middle levels are both neutral

// "EUV" has the control points of psfcore/drawing/thumbnail.py; a test compares the two.
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
