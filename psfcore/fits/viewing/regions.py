"""Cut a circle, a box or a polygon out of a product, as a FITS file with the image and its planes.

The cut-out is the smallest rectangle of whole pixels that contains the region. Its pixels are those of the product;
pixels of the rectangle outside the region are kept. The reference pixels (CRPIX) of all coordinate systems are moved,
so each pixel keeps its place on the sky.

Positions are in pixels, counted from 0 at the centre of the first pixel, or helioprojective (arcsec), which the header
converts (W. T. Thompson, A&A 449, 791, 2006). The edges of a region are sampled at EDGE points, because a straight line
or a circle on the sky need not be one on the detector.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits, first_image
from psfcore.fits.cards import number_of, without_cards
from psfcore.fits.hdus import readable_pixels
from psfcore.fits.header import all_hdus, shape_of
from psfcore.limited import run_limited

Frame = Literal["pixel", "helioprojective"]
Points = NDArray[np.float64]
EDGE = 64
_ARCSEC_PER_DEG = 3600.0
_OF_TWO_AXES = re.compile(
    r"C(TYPE|UNIT|RPIX|RVAL|DELT|ROTA)[12]|(PC|CD)[12]_[12]|PV[12]_[0-4]|LONPOLE|LATPOLE|RADESYS|DATE-OBS"
)
_MOVED = re.compile(r"CRPIX([12])([A-Z]?)")
# Cards that describe the whole image, or the part of the detector that was read, and would be wrong in a cut-out.
_DROPPED = (
    *("CHECKSUM", "DATASUM", "DATAMIN", "DATAMAX", "DATAMEAN", "DATAMEDN", "DATARMS"),
    *("PXBEG1", "PXBEG2", "PXEND1", "PXEND2"),
)


@dataclass(frozen=True)
class Region:
    """The corners or the sampled edge (n, 2) of a region, closed, in the coordinates of ``frame``."""

    frame: Frame
    edge: Points

    @classmethod
    def circle(cls, frame: Frame, x: float, y: float, radius: float) -> Region:
        """The circle around (x, y)."""
        angles = np.linspace(0, 2 * math.pi, 4 * EDGE + 1)
        return cls(frame, np.column_stack((x + radius * np.cos(angles), y + radius * np.sin(angles))))

    @classmethod
    def box(cls, frame: Frame, x: float, y: float, width: float, height: float) -> Region:
        """The box with its centre at (x, y)."""
        right, up = width / 2, height / 2
        return cls.polygon(
            frame, [(x - right, y - up), (x + right, y - up), (x + right, y + up), (x - right, y + up)]
        )

    @classmethod
    def polygon(cls, frame: Frame, corners: Sequence[tuple[float, float]]) -> Region:
        """The polygon with these corners; its last corner is joined to its first."""
        points = np.asarray([*corners, corners[0]], dtype=np.float64)
        steps = np.linspace(0, 1, EDGE, endpoint=False)[:, None]
        return cls(frame, np.concatenate([start + steps * (end - start) for start, end in pairwise(points)]))


def write_cutout(path: str | Path, region: Region, limits: FitsLimits, target: BinaryIO) -> None:
    """Write the cut-out of a product to ``target``, in a process of its own.

    Raises HeaderError for an unusable header, and DataError "region-outside" if the region contains no pixel of the
    image, "no-helioprojective" if the header gives no helioprojective coordinates, and "unreadable-pixels".
    """
    image = first_image(iter(all_hdus(path, limits)), limits)
    run_limited(
        cut_out,
        path,
        target,
        pixels=math.prod(shape_of(image.header)),
        frame=region.frame,
        edge=region.edge.tolist(),
    )


def cut_out(target: BinaryIO, *, path: str, frame: Frame, edge: list[list[float]]) -> dict[str, object]:
    """Write the cut-out of a product to ``target``. Call it in a limited process (`psfcore.limited`)."""
    with readable_pixels(path, "the region"), fits.open(path, memmap=False) as hdus:
        image = hdus[0]
        ny, nx = image.shape
        columns, rows = _window(Region(frame, np.asarray(edge)), image.header, (ny, nx))
        planes = [hdu for hdu in hdus[1:] if isinstance(hdu, fits.ImageHDU) and hdu.shape == (ny, nx)]
        parts = [_cut(hdu, columns, rows) for hdu in (image, *planes)]
        parts[0].header.add_history(
            f"heliopsf: columns {columns.start} to {columns.stop - 1}, rows {rows.start} to {rows.stop - 1} (counted "
            f"from 0) of {nx} x {ny} px"
        )
        fits.HDUList(parts).writeto(target, checksum=True)
    return {}


def _window(region: Region, header: fits.Header, shape: tuple[int, int]) -> tuple[slice, slice]:
    """The columns and rows that contain the region, inside the image."""
    ny, nx = shape
    points = region.edge if region.frame == "pixel" else _pixels_of(region.edge, header)
    parts = []
    for axis, size in ((0, nx), (1, ny)):
        # Pixel i extends from i - 0.5 to i + 0.5.
        first = max(0, math.floor(float(points[:, axis].min()) + 0.5))
        last = min(size - 1, math.ceil(float(points[:, axis].max()) - 0.5))
        parts.append(slice(first, last + 1))
    if any(part.start >= part.stop for part in parts):
        box = ", ".join(f"{points[:, axis].min():.1f} to {points[:, axis].max():.1f}" for axis in (0, 1))
        raise DataError(
            "region-outside",
            f"expected a region with pixels of the image, {nx} x {ny} px; got a region at x and y {box} px: move the "
            "region",
        )
    return parts[0], parts[1]


def _pixels_of(points: Points, header: fits.Header) -> Points:
    """Helioprojective coordinates in arcsec as pixels, counted from 0."""
    from astropy.wcs import WCS  # loads slowly, and a deconvolution of a box only moves the reference pixels

    # The cards of a file go into a C library, so it gets those of the two axes of the image alone.
    own = [card for card in header.cards if _OF_TWO_AXES.fullmatch(card.keyword)]
    wcs = WCS(fits.Header(own), fix=False)
    axes = [str(name)[:4] for name in wcs.wcs.ctype]
    if axes != ["HPLN", "HPLT"]:
        raise DataError(
            "no-helioprojective",
            "expected an image with helioprojective coordinates (CTYPE1 HPLN-..., CTYPE2 HPLT-...); got "
            f"{', '.join(filter(None, axes)) or 'none'}: give the region in pixels, FRAME=pixel",
        )
    pixels: Points = wcs.wcs_world2pix(points / _ARCSEC_PER_DEG, 0)
    if not np.isfinite(pixels).all():
        raise DataError(
            "region-outside",
            "expected a region that the image's coordinates can show; got one partly beyond them: move it, or make it "
            "smaller",
        )
    return pixels


def moved_header(whole: fits.Header, columns: slice, rows: slice) -> fits.Header:
    """The header of these columns and rows of an image. Their pixels keep their places on the sky."""
    header = without_cards(whole, _DROPPED)
    for card in list(header.cards):
        moved = _MOVED.fullmatch(card.keyword)
        if moved is not None and (at := number_of(card.value)) is not None:
            header[card.keyword] = at - (columns if moved[1] == "1" else rows).start
    return header


def _cut(hdu: fits.ImageHDU, columns: slice, rows: slice) -> fits.ImageHDU:
    make = fits.PrimaryHDU if isinstance(hdu, fits.PrimaryHDU) else fits.ImageHDU
    return make(np.asarray(hdu.section[rows, columns]), moved_header(hdu.header, columns, rows))
