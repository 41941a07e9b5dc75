// Shows the values of the pixel under the cursor: the values in the files, never means of an overview.
import { exactText } from "./stretch.js";
import { coordinates, imageCards } from "./coordinates.js";
import { json } from "./page.js";

const RESTED_MS = 120;
const WAITING = "…";

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
