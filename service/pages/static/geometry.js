// Which pixels of the image a place on the canvas shows. Axes are treated alike, one at a time. Image coordinates: pixel n, counted
// from 0, reaches from n to n + 1. A view has a centre in image coordinates and a zoom: device pixels per pixel of the image.

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
