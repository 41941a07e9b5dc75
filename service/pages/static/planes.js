// Gets the pixels of the two images from the service, keeps the parts that the viewer shows, and shows the values of the pixel under
// the cursor: the values in the files, never means of an overview.
import { json, request } from "./page.js";
import { exactText } from "./stretch.js";
import { partInView } from "./view.js";

const LARGEST_WHOLE = 2048; // px; of larger images only the part in view is loaded. Every graphics card supports this texture size
const NARROW = 600; // px; windows of phones
const BLOCK = 64; // px; exact values are read in blocks of this width
const MOST_BLOCKS = 64;
const RADIAN = Math.PI / 180;
const ARCSEC = { arcsec: 1, deg: 3600, arcmin: 60, rad: 3600 / RADIAN, mas: 0.001 };
const NO_SKY = "The header has no coordinates.";
const RESTED_MS = 120;
const WAITING = "…";

/** A part of a plane: {pixels: Float32Array, nx, ny, shape: [NY, NX] of the plane, unit}. asked: plane, x, y, width, height, step. */
export async function readPixels(address, asked, signal = undefined) {
  const answer = await request(`${address}/pixels?${new URLSearchParams(asked)}`, { signal });
  const pair = (name) => answer.headers.get(name).split(",").map(Number);
  const [ny, nx] = pair("X-Pixels-Shape");
  // Browsers run on little-endian machines only, so the bytes are floats as they come.
  const pixels = new Float32Array(await answer.arrayBuffer());
  return { pixels, nx, ny, shape: pair("X-Plane-Shape"), unit: answer.headers.get("X-Pixels-Unit") ?? "" };
}

/** The pixels of a product and of the image before, as sheets: an overview, then all pixels or those in view. */
export class Source {
  /** addresses: {before, after}; before is null if the image was deleted. changed(): called when sheets or planes have changed. */
  constructor(addresses, changed) {
    this.addresses = addresses;
    this.changed = changed;
    this.sheets = [];
    this.wanted = addresses.before === null ? ["after"] : ["before", "after"];
    this.blocks = new Map();
    this.asked = null; // the part in view that is being loaded
  }

  /** Load an overview for a canvas of this size. */
  async open(width, height, shape) {
    const [ny, nx] = shape ?? (await this.read("after", { x: 0, y: 0, width: 1, height: 1 })).shape;
    [this.nx, this.ny] = [nx, ny];
    this.parts = navigator.connection?.saveData || innerWidth < NARROW || Math.max(nx, ny) > LARGEST_WHOLE;
    const most = (length) => Math.min(length, LARGEST_WHOLE);
    const step = Math.max(1, Math.ceil(Math.max(nx / most(width), ny / most(height))));
    return this.load({ x: 0, y: 0, width: nx, height: ny, step });
  }

  /** Load all pixels, unless only parts are loaded for this image. Returns the overview that was replaced, or null. */
  async openAll() {
    const { overview } = this;
    if (this.parts || overview.step === 1) return null;
    await this.show(await this.load({ x: 0, y: 0, width: this.nx, height: this.ny, step: 1 }));
    return overview;
  }

  /** The sheet that shows the whole image. */
  get overview() {
    return this.sheets[0];
  }

  read(name, asked, signal = undefined) {
    const before = name === "before";
    const plane = before || name === "after" ? "image" : name;
    return readPixels(this.addresses[before ? "before" : "after"], { plane, ...asked }, signal);
  }

  async load(asked, signal = undefined) {
    const names = [...this.wanted]; // further planes may be added while these are loaded
    const found = await Promise.all(names.map((name) => this.read(name, asked, signal)));
    for (const { shape } of found) {
      if (shape[1] !== this.nx || shape[0] !== this.ny) {
        throw new Error(`Expected both images to have ${this.nx} x ${this.ny} px; one has ${shape[1]} x ${shape[0]} px.`);
      }
    }
    this.unit = found[names.indexOf("after")].unit;
    const { nx, ny } = found[0];
    const planes = Object.fromEntries(names.map((name, index) => [name, found[index].pixels]));
    return { x: asked.x, y: asked.y, step: asked.step, nx, ny, asked, planes };
  }

  /** Show a sheet of the whole image. */
  async show(sheet) {
    await this.complete(sheet);
    this.sheets = [sheet];
    this.changed();
  }

  /** Also load this plane ("quality" or "error"), for all sheets. */
  async want(name) {
    if (this.wanted.includes(name)) return;
    this.wanted.push(name);
    await Promise.all(this.sheets.map((sheet) => this.complete(sheet)));
    this.changed();
  }

  /** Load the planes that a sheet lacks because they were requested while it was loaded. */
  async complete(sheet) {
    const lacking = this.wanted.filter((name) => !(name in sheet.planes));
    await Promise.all(lacking.map(async (name) => { sheet.planes[name] = (await this.read(name, sheet.asked)).pixels; }));
  }

  /** Unless all pixels are loaded, load the part in view at the resolution of the zoom. Returns the sheet that was replaced, or null. */
  async showPart(width, height, centre, zoom) {
    const step = Math.max(1, Math.floor(1 / zoom));
    if (!this.parts || this.overview === undefined || step >= this.overview.step) return null;
    const [x, y] = [partInView(width, centre.x, zoom, this.nx), partInView(height, centre.y, zoom, this.ny)];
    const asked = { x: x.first, y: y.first, width: Math.min(x.count, step * LARGEST_WHOLE), height: Math.min(y.count, step * LARGEST_WHOLE), step };
    if (this.sheets.length > 1 && encloses(this.sheets[1], width, height, centre, zoom, step, this)) return null;
    this.asked?.abort();
    const controller = new AbortController();
    this.asked = controller;
    const sheet = await this.load(asked, controller.signal);
    await this.complete(sheet);
    if (controller.signal.aborted) return null;
    const old = this.sheets[1] ?? null;
    this.sheets = [this.overview, sheet];
    this.changed();
    return old;
  }

  /** The exact value of a pixel (x, y, counted from 0) of a plane; undefined while it is not loaded. */
  value(name, x, y) {
    for (const sheet of this.sheets) {
      const [column, row] = [x - sheet.x, y - sheet.y];
      if (sheet.step === 1 && name in sheet.planes && column >= 0 && row >= 0 && column < sheet.nx && row < sheet.ny) {
        return sheet.planes[name][row * sheet.nx + column];
      }
    }
    const block = this.blocks.get(blockKey(name, x, y));
    return block?.pixels?.[(y % BLOCK) * block.nx + (x % BLOCK)];
  }

  /** Load the block of pixels around a pixel, unless its values are known. */
  async fetchValue(name, x, y) {
    const key = blockKey(name, x, y);
    if (this.value(name, x, y) !== undefined || this.blocks.has(key)) return;
    this.blocks.set(key, {});
    if (this.blocks.size > MOST_BLOCKS) this.blocks.delete(this.blocks.keys().next().value);
    const [left, low] = [x - (x % BLOCK), y - (y % BLOCK)];
    const asked = { x: left, y: low, width: Math.min(BLOCK, this.nx - left), height: Math.min(BLOCK, this.ny - low), step: 1 };
    try {
      this.blocks.set(key, await this.read(name, asked));
    } catch (error) {
      this.blocks.delete(key);
      throw error;
    }
  }
}

function blockKey(name, x, y) {
  return `${name} ${Math.floor(x / BLOCK)} ${Math.floor(y / BLOCK)}`;
}

/** Whether a sheet already shows what is in view, finely enough. */
function encloses(sheet, width, height, centre, zoom, step, { nx, ny }) {
  const [x, y] = [partInView(width, centre.x, zoom, nx, 0), partInView(height, centre.y, zoom, ny, 0)];
  const covers = (start, count, part) => start <= part.first && start + count * sheet.step >= part.first + part.count;
  return sheet.step <= step && covers(sheet.x, sheet.nx, x) && covers(sheet.y, sheet.ny, y);
}

// --- the values under the cursor ---

export class Readout {
  /** address: the address of the product. failed(error): called when values cannot be loaded. */
  constructor(source, address, failed) {
    this.source = source;
    this.address = address;
    this.failed = failed;
    this.pixel = null;
    this.byKeys = false;
    this.extra = []; // planes of the product beside the image
    this.sky = { reason: WAITING };
  }

  /** Read the header once: coordinates, planes, and what the bits of QUALITY mean. */
  async headers() {
    if (this.asked) return;
    this.asked = true;
    let hdus;
    try {
      hdus = await json(`${this.address}/header`);
    } catch (error) {
      this.asked = false;
      this.sky = { reason: "The header could not be read." };
      return this.failed(error);
    }
    this.sky = coordinates(imageCards(hdus));
    this.extra = ["error", "quality"].filter((name) => hdus.some((hdu) => hdu.name.toLowerCase() === name));
    const cards = hdus.find((hdu) => hdu.name === "QUALITY")?.cards ?? [];
    this.bits = cards.flatMap(([keyword, name, comment]) => (/^QBIT\d+$/.test(keyword) ? [{ value: 2 ** Number(keyword.slice(4)), name, meaning: comment.replace(/^value \d+: /, "") }] : []));
    for (const name of ["error", "quality"]) document.getElementById(name).disabled = !this.extra.includes(name);
    document.getElementById("no-error").hidden = this.extra.includes("error");
    this.refresh();
  }

  /** Show a pixel (x, y, counted from 0); null: none. byKeys: the keyboard moved to it. */
  show(pixel, byKeys = false) {
    this.byKeys = byKeys;
    if (pixel === null) return;
    this.pixel = pixel;
    this.refresh();
    clearTimeout(this.resting);
    this.resting = setTimeout(() => this.load(), RESTED_MS);
  }

  get planes() {
    return [...(this.source.addresses.before === null ? [] : ["before"]), "after", ...this.extra];
  }

  async load() {
    const { x, y } = this.pixel;
    try {
      await Promise.all(this.planes.map((name) => this.source.fetchValue(name, x, y)));
    } catch (error) {
      return this.failed(error);
    }
    this.refresh();
    if (this.byKeys) document.getElementById("spoken").textContent = this.spoken();
  }

  refresh() {
    if (this.pixel === null) return;
    for (const [name, text] of Object.entries(this.texts())) {
      document.querySelector(`[data-value="${name}"]`).textContent = text;
    }
  }

  texts() {
    const { x, y } = this.pixel;
    const [before, after, error, quality] = ["before", "after", "error", "quality"].map((name) => this.planes.includes(name) ? this.source.value(name, x, y) : null);
    const unit = this.source.unit ? ` ${this.source.unit}` : "";
    const shown = (value, none) => (value === null ? none : value === undefined ? WAITING : Number.isNaN(value) ? "no value (NaN)" : `${exactText(value)}${unit}`);
    return {
      pixel: `${x + 1}, ${y + 1}`,
      before: shown(before, "not there"),
      after: shown(after),
      change: changeText(before, after),
      sky: this.skyText(x + 1, y + 1),
      error: shown(error, "no ERROR plane"),
      quality: quality === null ? "no QUALITY plane" : quality === undefined ? WAITING : this.qualityText(quality),
    };
  }

  skyText(x, y) {
    if (this.sky.of === undefined) return this.sky.reason;
    return this.sky.of(x, y).map((angle) => `${angle.toFixed(3)}″`).join(", ");
  }

  qualityText(value) {
    if (value === 0) return "0: good";
    const named = this.bits.filter((bit) => value & bit.value).map((bit) => `${bit.name} (${bit.meaning})`);
    return `${value}: ${named.join(", ") || "bits without a name in the header"}`;
  }

  spoken() {
    const { pixel, before, after, change } = this.texts();
    return `pixel ${pixel}: before ${before}, after ${after}, change ${change}`;
  }

  /** Put the cross on the pixel that the keyboard chose. placeOf: see Viewer.placeOf. */
  showCross(cross, placeOf) {
    cross.hidden = !this.byKeys || this.pixel === null;
    if (cross.hidden) return;
    const { left, top } = placeOf(this.pixel.x, this.pixel.y);
    cross.style.left = `${left}%`;
    cross.style.top = `${top}%`;
  }
}

function changeText(before, after) {
  if (before === undefined || after === undefined) return WAITING;
  if (before === null || !Number.isFinite(before) || !Number.isFinite(after)) return "-";
  if (before <= 0) return "not defined: the value before is not above zero";
  const change = (100 * (after - before)) / before;
  return `${change >= 0 ? "+" : "−"}${Number(Math.abs(change).toPrecision(4))} %`;
}

// --- where on the sky a pixel is: the gnomonic projection (TAN) of a FITS header ---
// Greisen & Calabretta 2002, A&A 395, 1061 (linear part); Calabretta & Greisen 2002, A&A 395, 1077 (projection and rotation).

/** The cards of the first HDU that has coordinates; null: no HDU has coordinates. hdus: the answer of `.../header`. */
function imageCards(hdus) {
  for (const { cards } of hdus) {
    const values = new Map(cards.map(([keyword, value]) => [keyword, value]));
    if (values.has("CTYPE1") && values.has("CRPIX1")) return values;
  }
  return null;
}

/**
 * The coordinates of a header: `{of(x, y)}` gives [longitude, latitude], arcsec, of a pixel counted from 1 as in FITS. `{reason}`:
 * why there are none. cards: a Map from keyword to value.
 */
export function coordinates(cards) {
  if (cards === null) return { reason: NO_SKY };
  const types = [cards.get("CTYPE1"), cards.get("CTYPE2")].map((type) => String(type ?? "").trim());
  if (!/^H[PG]LN-TAN$/.test(types[0]) || !/^H[PG]LT-TAN$/.test(types[1])) {
    return { reason: `The viewer reads coordinates of the type HPLN-TAN, HPLT-TAN; the header has ${types.join(", ") || "none"}.` };
  }
  const value = (name, otherwise) => (Number.isFinite(cards.get(name)) ? cards.get(name) : otherwise);
  const units = ["CUNIT1", "CUNIT2"].map((name) => ARCSEC[String(cards.get(name) ?? "deg").trim().toLowerCase()]);
  const matrix = linear(cards, value);
  if (units.includes(undefined) || matrix === null) return { reason: NO_SKY };
  const [scaleX, scaleY] = units.map((unit) => unit / 3600); // degrees per unit
  const reference = { x: value("CRPIX1", 0), y: value("CRPIX2", 0) };
  const pole = value("LONPOLE", value("CRVAL2", 0) * scaleY >= 90 ? 0 : 180) * RADIAN;
  const [longitude, latitude] = [value("CRVAL1", 0) * scaleX * RADIAN, value("CRVAL2", 0) * scaleY * RADIAN];
  return {
    of(x, y) {
      const [dx, dy] = [x - reference.x, y - reference.y];
      const plane = [(matrix[0] * dx + matrix[1] * dy) * scaleX * RADIAN, (matrix[2] * dx + matrix[3] * dy) * scaleY * RADIAN];
      return onSphere(plane, longitude, latitude, pole).map((angle) => (angle / RADIAN) * 3600);
    },
  };
}

/** The matrix from pixels to the plane of projection, in the units of the axes: CD, or CDELT with PC or CROTA2; null: the scale is missing. */
function linear(cards, value) {
  const names = ["1_1", "1_2", "2_1", "2_2"];
  if (names.some((name) => cards.has(`CD${name}`))) return names.map((name) => value(`CD${name}`, 0));
  const scale = [value("CDELT1", NaN), value("CDELT2", NaN)];
  if (scale.some(Number.isNaN)) return null;
  let turn = names.map((name, index) => value(`PC${name}`, index % 3 === 0 ? 1 : 0));
  if (!names.some((name) => cards.has(`PC${name}`)) && cards.has("CROTA2")) {
    const angle = value("CROTA2", 0) * RADIAN;
    const [sine, cosine, ratio] = [Math.sin(angle), Math.cos(angle), scale[1] / scale[0]];
    turn = [cosine, -sine * ratio, sine / ratio, cosine];
  }
  return turn.map((part, index) => part * scale[index < 2 ? 0 : 1]);
}

/** From the plane of projection (radians) to longitude and latitude (radians), the longitude between -pi and pi. */
function onSphere([x, y], longitude, latitude, pole) {
  const [phi, theta] = [Math.atan2(x, -y), Math.atan2(1, Math.hypot(x, y))];
  const turned = phi - pole;
  const [sine, cosine] = [Math.sin(theta), Math.cos(theta)];
  const east = -cosine * Math.sin(turned);
  const north = sine * Math.cos(latitude) - cosine * Math.sin(latitude) * Math.cos(turned);
  const up = sine * Math.sin(latitude) + cosine * Math.cos(latitude) * Math.cos(turned);
  const found = longitude + Math.atan2(east, north);
  return [Math.atan2(Math.sin(found), Math.cos(found)), Math.atan2(up, Math.hypot(east, north))];
}
