// Shows the values of the pixel under the cursor: the values in the files, never means of an overview.
import { exactText } from "./stretch.js";
import { json } from "./page.js";

const RADIAN = Math.PI / 180;
const ARCSEC = { arcsec: 1, deg: 3600, arcmin: 60, rad: 3600 / RADIAN, mas: 0.001 };
const NO_SKY = "The header has no coordinates.";
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
