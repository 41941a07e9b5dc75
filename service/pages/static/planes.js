// Gets the pixels of the two images from the service, and keeps the parts that the viewer shows.
import { request } from "./page.js";
import { partInView } from "./view.js";

const LARGEST_WHOLE = 2048; // px; of larger images only the part in view is loaded. Every graphics card supports this texture size
const NARROW = 600; // px; windows of phones
const BLOCK = 64; // px; exact values are read in blocks of this width
const MOST_BLOCKS = 64;

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
