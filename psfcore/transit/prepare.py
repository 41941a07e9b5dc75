"""Makes frames from exposures: all pixels are in DN/s, and every pixel has a value.

Paper (Hofmeister et al.), section "The observations": images are normalised by their exposure time, and saturated
pixels are replaced by the pixels of the unsaturated image that is nearest in time. Here this image must have the same
pointing, because the scene moves on the detector with the pointing. The values of the other image are scaled:

    s = median of I_i / I_j over the bright pixels near the gap, unsaturated in both    Eq. (1)
    I_i(gap) = s I_j(gap)                                                               Eq. (2)

| symbol | name | unit |
|---|---|---|
| I_i, I_j | pixels of the frame with the gap, and of the frame from which the gap is filled | DN/s |
| s | scale | 1 |

``Frame.filled`` marks the pixels of all gaps; analyses of the occulter do not use these pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from psfcore.errors import DataError
from psfcore.fits.units import parse_unit
from psfcore.image import Image, MaskBit
from psfcore.transit.transit import Frame, PixelMask, Pixels, Place

NEAR_PX = 16  # the scale s is measured on pixels up to this distance from a gap
FEWEST_SCALE_PIXELS = 100
OCCULTER_MARGIN_PX = 5.0  # margin around the disc, for the error of the ephemeris and the blurred edge
NEIGHBOUR_PX = 2  # half width of the window of the local median
_CHUNK = 65_536
_CHUNK_ROWS = 16

Places = NDArray[np.intp]


@dataclass(eq=False)
class Exposure:
    """An image as it was read, with gaps: pixels [y, x] in DN/s. The pixels are changed in place when gaps are filled.

    Attributes
    ----------
    gaps
        True for pixels that the mask marks (for example saturated pixels) or that are not finite; None if there are
        none.
    saturated
        The number of saturated pixels.
    """

    file: str
    pixels: Pixels
    pointing: int
    place: Place
    exposure_s: float
    time_s: float
    gain_mode: str | None = None
    gaps: PixelMask | None = None
    saturated: int = 0


@dataclass(frozen=True)
class FrameCounts:
    """The numbers of saturated and of non-finite pixels of one frame, and the ways in which their values were replaced.

    Attributes
    ----------
    from_frames
        Number of pixels with a value from another frame.
    from_neighbours
        Number of pixels with the median of pixels near them.
    unfilled
        Number of saturated pixels that no other frame of the pointing can fill; these pixels keep their values.
    """

    file: str
    saturated: int = 0
    nonfinite: int = 0
    from_frames: int = 0
    from_neighbours: int = 0
    unfilled: int = 0


@dataclass(frozen=True)
class Prepared:
    """The counts of all frames, in their order."""

    frames: tuple[FrameCounts, ...]

    @property
    def unfilled(self) -> int:
        """The number of unfilled saturated pixels in all frames."""
        return sum(frame.unfilled for frame in self.frames)

    def to_json(self) -> dict[str, object]:
        """JSON values: the number of frames, and the counts of the frames that have saturated or not finite pixels."""
        counts = [asdict(frame) for frame in self.frames if frame.saturated or frame.nonfinite]
        return {"images": len(self.frames), "unfilled": self.unfilled, "frames": counts}


def exposure_of(
    image: Image, *, file: str, pointing: int, place: Place, time_s: float, gain_mode: str | None
) -> Exposure:
    """The exposure of an image in DN or DN/s. Its gaps are the pixels that the mask marks or that are not finite.

    Raises DataError "no-exposure", and "unknown-unit" if BUNIT is neither DN nor DN/s.
    """
    unit = parse_unit(image.unit)
    if unit.kind not in ("count", "rate"):
        raise DataError(
            "unknown-unit",
            f"{file}: expected BUNIT 'DN' or 'DN/s'; got {image.unit!r:.40}: convert the image, or correct BUNIT",
        )
    if image.exposure_s is None:
        raise DataError(
            "no-exposure",
            f"{file}: expected XPOSURE or EXPTIME above 0 s in the header; got neither: add one of these keywords",
        )
    dn_per_unit = 1.0 if unit.kind == "rate" else image.exposure_s
    pixels = np.empty(image.pixels.shape, np.float32)
    with np.errstate(over="ignore"):  # a value too large for float32 becomes infinite and so a gap
        for first in range(0, len(pixels), _CHUNK_ROWS):  # whole planes would leave the cache
            rows = slice(first, first + _CHUNK_ROWS)
            pixels[rows] = image.pixels[rows] * unit.scale / dn_per_unit
    gaps = ~np.isfinite(pixels)
    gaps |= image.mask != 0
    return Exposure(
        file=file,
        pixels=pixels,
        pointing=pointing,
        place=place,
        exposure_s=image.exposure_s,
        time_s=time_s,
        gain_mode=gain_mode,
        gaps=gaps if gaps.any() else None,
        saturated=int(np.count_nonzero(image.mask & MaskBit.SATURATED)),
    )


def prepare(exposures: Sequence[Exposure]) -> tuple[tuple[Frame, ...], Prepared]:
    """Return frames without gaps, in the given order, and the counts of each frame.

    A pixel in a gap gets its value from another frame of the same pointing: from the frame nearest in time that has no
    gap at this pixel. If there is no such frame, a finite (saturated) pixel keeps its value. Any other pixel then gets
    the median of its neighbours. The pixel arrays of the exposures are changed in place; the frames use the same
    arrays. Raises DataError "all-saturated" if more than half of the pixels of a frame stay saturated.
    """
    counts = [_fill(exposure, exposures) for exposure in exposures]
    frames = tuple(
        Frame(
            file=exposure.file,
            pixels=exposure.pixels,
            pointing=exposure.pointing,
            place=exposure.place,
            exposure_s=exposure.exposure_s,
            time_s=exposure.time_s,
            gain_mode=exposure.gain_mode,
            filled=exposure.gaps,
        )
        for exposure in exposures
    )
    return frames, Prepared(tuple(counts))


def _fill(exposure: Exposure, exposures: Sequence[Exposure]) -> FrameCounts:
    """Fill the gaps of one exposure in place."""
    if exposure.gaps is None:
        return FrameCounts(exposure.file)
    left = _fill_from_frames(exposure, exposures)
    of_gaps = int(np.count_nonzero(exposure.gaps))
    unfinished = int(np.count_nonzero(left))
    kept = left & np.isfinite(exposure.pixels)
    unfilled = int(np.count_nonzero(kept))
    if 2 * unfilled > kept.size:
        message = (
            "expected mostly unsaturated pixels, or another image of the same pointing to fill them from"
        )
        share = 100 * unfilled / kept.size
        raise DataError(
            "all-saturated",
            f"{exposure.file}: {message}; got {share:.0f} % saturated pixels that cannot be filled: leave this image "
            "out",
        )
    _fill_from_neighbours(exposure.pixels, left & ~kept, exposure.gaps)
    return FrameCounts(
        file=exposure.file,
        saturated=exposure.saturated,
        nonfinite=of_gaps - exposure.saturated,
        from_frames=of_gaps - unfinished,
        from_neighbours=unfinished - unfilled,
        unfilled=unfilled,
    )


def _fill_from_frames(exposure: Exposure, exposures: Sequence[Exposure]) -> PixelMask:
    """Fill the gaps from other frames; returns the remaining gaps [y, x]."""
    assert exposure.gaps is not None
    left = exposure.gaps.copy()
    rows, columns = np.nonzero(left)
    # Gaps on the occulter are not filled here, because another frame shows the Sun at these pixels.
    off = ~_on_disc(exposure.place, rows, columns)
    rows, columns = rows[off], columns[off]
    donors = [other for other in exposures if other is not exposure and other.pointing == exposure.pointing]
    for donor in sorted(donors, key=lambda other: abs(other.time_s - exposure.time_s)):
        if not rows.size:
            break
        shown = ~_on_disc(donor.place, rows, columns)
        if donor.gaps is not None:
            shown &= ~donor.gaps[rows, columns]
        if shown.any():
            here = rows[shown], columns[shown]
            exposure.pixels[here] = _scale(exposure, donor, here) * donor.pixels[here]  # Eq. (2)
            left[here] = False
            rows, columns = rows[~shown], columns[~shown]
    return left


def _on_disc(place: Place, rows: Places, columns: Places) -> PixelMask:
    """True for pixels on the occulter or in a margin around the occulter."""
    dy, dx = rows - place.y_px, columns - place.x_px
    return np.asarray(dx * dx + dy * dy <= (place.radius_px + OCCULTER_MARGIN_PX) ** 2)


def _scale(exposure: Exposure, donor: Exposure, here: tuple[Places, Places]) -> float:
    """The scale s of Eq. (1): the brightness of the frame divided by the brightness of the donor.

    The scale is measured near the gaps. If too few pixels near the gaps can be used, the scale is measured in the whole
    image. If too few pixels can be used in the whole image, the scale is 1.
    """
    gap = np.zeros(exposure.pixels.shape, dtype=bool)
    gap[here] = True
    valid = np.ones_like(gap)
    for gaps in (exposure.gaps, donor.gaps):
        if gaps is not None:
            valid &= ~gaps
    if not valid.any():
        return 1.0
    floors = [max(0.0, float(np.median(one.pixels[valid]))) for one in (exposure, donor)]
    bright = valid & (exposure.pixels > floors[0]) & (donor.pixels > floors[1])
    near = bright & ndimage.maximum_filter(gap, size=2 * NEAR_PX + 1)
    for these in (near, bright):
        if np.count_nonzero(these) >= FEWEST_SCALE_PIXELS:
            ratio = exposure.pixels[these].astype(np.float64) / donor.pixels[these]
            return float(np.median(ratio))  # Eq. (1)
    return 1.0


def _fill_from_neighbours(pixels: Pixels, targets: PixelMask, gaps: PixelMask) -> None:
    """Fill each pixel of `targets` with the median of the valid pixels near it.

    If there are none, the median is taken near the closest valid pixel.
    """
    if not targets.any():
        return
    rows, columns = np.nonzero(targets)
    valid = np.where(gaps, np.float32(np.nan), pixels)
    values = _local_median(valid, rows, columns)
    lost = np.isnan(values)
    if lost.any() and not gaps.all():
        nearest = ndimage.distance_transform_edt(gaps, return_distances=False, return_indices=True)
        values[lost] = _local_median(valid, *(axis[rows[lost], columns[lost]] for axis in nearest))
    pixels[rows, columns] = np.nan_to_num(values, nan=0.0)


def _local_median(valid: Pixels, rows: Places, columns: Places) -> NDArray[np.float32]:
    """The median of the valid (not NaN) pixels in a window around each pixel; NaN if there are none."""
    padded = np.pad(valid, NEIGHBOUR_PX, constant_values=np.nan)
    side = 2 * NEIGHBOUR_PX + 1
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    parts = [np.empty(0, dtype=np.float32)]
    for start in range(0, rows.size, _CHUNK):
        these = slice(start, start + _CHUNK)
        window = np.sort(windows[rows[these], columns[these]].reshape(-1, side * side), axis=1)  # NaN last
        count = np.count_nonzero(np.isfinite(window), axis=1)
        line = np.arange(count.size)
        middle = window[line, np.maximum(count - 1, 0) // 2] + window[line, count // 2 * (count > 0)]
        parts.append(np.where(count > 0, 0.5 * middle, np.nan).astype(np.float32))
    return np.concatenate(parts)
