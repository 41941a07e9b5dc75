// Where on the sky a pixel is: the gnomonic projection (TAN) of a FITS header.
// Greisen & Calabretta 2002, A&A 395, 1061 (linear part); Calabretta & Greisen 2002, A&A 395, 1077 (projection and rotation).

const RADIAN = Math.PI / 180;
const ARCSEC = { arcsec: 1, deg: 3600, arcmin: 60, rad: 3600 / RADIAN, mas: 0.001 };
export const NONE = "The header has no coordinates.";

/** The cards of the first HDU that has coordinates; null: no HDU has coordinates. hdus: the answer of `.../header`. */
export function imageCards(hdus) {
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
  if (cards === null) return { reason: NONE };
  const types = [cards.get("CTYPE1"), cards.get("CTYPE2")].map((type) => String(type ?? "").trim());
  if (!/^H[PG]LN-TAN$/.test(types[0]) || !/^H[PG]LT-TAN$/.test(types[1])) {
    return { reason: `The viewer reads coordinates of the type HPLN-TAN, HPLT-TAN; the header has ${types.join(", ") || "none"}.` };
  }
  const value = (name, otherwise) => (Number.isFinite(cards.get(name)) ? cards.get(name) : otherwise);
  const units = ["CUNIT1", "CUNIT2"].map((name) => ARCSEC[String(cards.get(name) ?? "deg").trim().toLowerCase()]);
  const matrix = linear(cards, value);
  if (units.includes(undefined) || matrix === null) return { reason: NONE };
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
