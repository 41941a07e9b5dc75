"""Assumptions about the scene beyond the field: zero, the field's mirror image, or an unknown scene.

- zero: the scene is zero beyond the field, as in Hofmeister et al. (2024).
- symmetric: the mirror image of the field fills a margin around it. Field and margin are deconvolved, and then the
  margin is cut off.
- extended: the scene is estimated on field and margin, although no pixel of the margin was observed
  (Bertero & Boccacci 2005, A&A 437, 369). The estimate starts from the mirror image.
- periodic: the field continues with its opposite side, as in programs that use a Fourier transform of the size of the
  image, such as aiapy. The transforms are the shortest ones, but light that leaves the field at one edge enters it at
  the opposite edge.

The PSF determines how far from an edge the scene beyond the edge matters. In a uniform scene, a pixel at distance d
from a straight edge (d = 0 for the outermost pixels) receives the share b(d) of its light from beyond the edge:

    b(d) = sum over o > d of l[o],   l[o] = sum of the weights whose offset across the edge is o      Eq. (1)

b is the mean over the four edges of the image.

With periodic edges, the light that enters at an edge is at most the light that falls just beyond the opposite edge:

    w = max over k outside [0, N) of sum over i of l[k - i] m[i]      Eq. (2), for both axes, added

| symbol | name | unit |
|---|---|---|
| d | distance from the edge | px |
| o | offset from the PSF's centre, perpendicular to the edge | px |
| b | share_from_beyond | - |
| w | light_across | image unit |
| m[i], N | largest absolute pixel of row or column i, and their number | image unit, - |
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.engine import PERIODIC
from psfcore.convolution.kernels import BLOCK_ROWS
from psfcore.deconvolve.declaration import WITHOUT_MARGIN, Edges
from psfcore.errors import DataError
from psfcore.image import Image
from psfcore.psf import Psf
from psfcore.psf_field import common_shape, factors_at, nine_places

EDGES: tuple[Edges, ...] = get_args(Edges)

# If more than this share of a pixel's light may come from beyond the field, the pixel is flagged and left out of chi2.
FLAGGED_SHARE = 0.05

# The scales for which single precision represents a result: 1e18 times brighter and fainter than the brightest pixel.
_IN_SINGLE = (1e-20, 1e20)

Plane = NDArray[np.float32]
Trust = NDArray[np.bool_]
Number = TypeVar("Number", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Domain:
    """The plane on which a method estimates the scene: the field and its margin.

    Attributes
    ----------
    pixels
        The image [y, x] divided by `scale`, and 0 where it is not finite; the margin holds the mirror image of the
        field.
    trusted
        Pixels to which the estimate is fitted.
    finite
        Pixels whose values can start the estimate.
    field
        Position of the field in the plane.
    scale
        The largest absolute pixel value. After the division by this value, float32 can represent any image.
    """

    pixels: Plane
    trusted: Trust
    finite: Trust
    field: tuple[slice, slice]
    scale: float
    edges: Edges
    margin_px: int

    def release(self) -> None:
        """Free the memory of `pixels` and `trusted` and `finite`, when the iteration holds what it needs of them."""
        for name in ("pixels", "trusted", "finite"):
            plane = getattr(self, name)
            empty = np.broadcast_to(plane.dtype.type(0), plane.shape)  # one number, so that the shape is kept
            object.__setattr__(self, name, empty)

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx) of field and margin."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def span(self) -> tuple[int, int]:
        """Distance (ny, nx) within which the convolution must be exact.

        With extended edges, the distance covers every pixel whose light reaches the field. With other edges it is the
        size of the field, because light need not travel from one margin to the opposite one. Periodic edges have no
        such distance.
        """
        if self.edges == "periodic":
            return PERIODIC
        sought = self.margin_px if self.edges == "extended" else 0
        ny, nx = (part.stop - part.start for part in self.field)
        return ny + sought, nx + sought

    def cut(self, blocks: Iterable[tuple[int, Plane]]) -> NDArray[np.floating]:
        """Cut the field out of a plane, in the image's unit: in single precision, if it can represent the image.

        Parameters
        ----------
        blocks
            Pairs of the number of the first row and the rows of the plane that begin there.
        """
        rows, columns = self.field
        low, high = _IN_SINGLE
        single = low <= self.scale <= high
        pixels = np.empty(
            (rows.stop - rows.start, columns.stop - columns.start), np.float32 if single else np.float64
        )
        for first, block in blocks:
            part = block[max(rows.start - first, 0) : max(rows.stop - first, 0), columns]
            start = max(first - rows.start, 0)
            here = pixels[start : start + len(part)]
            np.multiply(part, self.scale, out=here, dtype=np.float64, casting="same_kind")
        return pixels


def share_from_beyond(psf: Psf) -> NDArray[np.float64]:
    """Compute b of Eq. (1) for d = 0, 1, ... px, up to half the size of the PSF. If the PSF changes over the field, it
    is the largest b of nine places.
    """
    return np.asarray(np.max([_share(*sums) for sums in _sums(psf)], axis=0))


def _sums(psf: Psf) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """The sums of a PSF's rows and of its columns; at nine places, if it changes over the field."""
    kernels = common_shape([psf.kernel, *(term.kernel for term in psf.field_terms)])
    along_y, along_x = (np.array([one.sum(axis=axis) for one in kernels]) for axis in (1, 0))
    places = nine_places() if psf.field_terms else [(0.0, 0.0)]
    return [(of @ along_y, of @ along_x) for of in factors_at(psf.field_terms, places)]


def _share(along_y: NDArray[np.float64], along_x: NDArray[np.float64]) -> NDArray[np.float64]:
    """B of Eq. (1) from the sums of a PSF's rows and of its columns."""
    ny, nx = along_y.size, along_x.size
    shares = np.zeros((4, max(ny, nx) + 1))
    for n, (line, centre) in enumerate(
        (line, centre)
        for total, size in ((along_y, ny), (along_x, nx))
        for line, centre in ((total, size // 2), (total[::-1], size - 1 - size // 2))
    ):
        beyond = line[centre + 1 :]
        shares[n, : beyond.size] = np.cumsum(beyond[::-1])[::-1]
    return np.asarray(shares.mean(axis=0)[: max(ny, nx) // 2 + 1])  # Eq. (1)


def light_across(image: Image, psf: Psf) -> float:
    """Compute w of Eq. (2): with periodic edges, no pixel gets more light than this from beyond the edges, if the
    brightness of the scene is that of the image.
    """
    across = 0.0
    for axis, (n, sums) in enumerate(zip(image.pixels.shape, zip(*_sums(psf), strict=True), strict=True)):
        others = 1 - axis
        brightest = np.maximum(
            image.pixels.max(axis=others, where=image.finite, initial=0.0),
            -image.pixels.min(axis=others, where=image.finite, initial=0.0),
        )
        weights = np.max(sums, axis=0)
        light, first = np.convolve(brightest, weights), weights.size // 2
        across += float(np.concatenate([light[:first], light[first + n :]]).max(initial=0.0))  # Eq. (2)
    return across


def band_px(shares: NDArray[np.float64], fraction: float) -> int:
    """Width of the band along an edge in which more than `fraction` of a pixel's light comes from beyond the edge.

    The width holds for a uniform scene.

    Parameters
    ----------
    shares
        The shares b of Eq. (1).
    """
    return int(np.count_nonzero(shares > fraction))


def inside_band(shape: tuple[int, ...], band_px: int) -> Trust:
    """True for the pixels [y, x] that are not in a band of this width along the edges."""
    inside = np.zeros(shape, np.bool_)
    inside[band_px : shape[0] - band_px, band_px : shape[1] - band_px] = True
    return inside


def margin_for(shares: NDArray[np.float64], field_shape: tuple[int, int], *, share: float) -> int:
    """Width of the margin, px: a pixel at the edge gets at most `share` of its light from beyond the margin.

    The width is rounded up to a multiple of 16 px, half a block of the engine. It is at most half the width of the
    field.

    Parameters
    ----------
    shares
        The shares b of Eq. (1).
    """
    half_block = BLOCK_ROWS // 2
    width = half_block * -(-band_px(shares, share) // half_block)
    return min(width, min(field_shape) // 2)


def lay_out(image: Image, *, edges: Edges, margin_px: int) -> Domain:
    """Put an image and its margin on one plane.

    Raises DataError: "bad-edges", "all-masked", "no-signal".
    """
    if edges not in EDGES:
        raise DataError("bad-edges", f"expected edges to be one of {', '.join(EDGES)}; got {edges}")
    if not image.valid.any():
        raise DataError(
            "all-masked",
            "expected at least one pixel that is not masked; all pixels are masked: check the mask",
        )
    finite = image.finite
    scale = float(
        max(
            np.max(image.pixels, where=finite, initial=-np.inf),
            -np.min(image.pixels, where=finite, initial=np.inf),
        )
    )
    if scale == 0:
        raise DataError(
            "no-signal", "expected at least one pixel other than zero; all are zero: use another image"
        )
    # Divide in float64: float32 cannot hold numbers such as 1e-300 and 1e300.
    scaled = np.empty(image.pixels.shape, np.float32)
    np.divide(image.pixels, scale, out=scaled, dtype=np.float64, casting="same_kind")
    np.copyto(scaled, 0, where=~finite)
    margin = 0 if edges in WITHOUT_MARGIN else margin_px
    ny, nx = image.pixels.shape
    trusted = _continued(image.valid, margin)
    field = (slice(margin, margin + ny), slice(margin, margin + nx))
    if edges == "extended":
        observed = np.zeros_like(trusted)
        observed[field] = True
        trusted &= observed
    return Domain(
        pixels=_continued(scaled, margin),
        trusted=trusted,
        finite=_continued(finite, margin),
        field=field,
        scale=scale,
        edges=edges,
        margin_px=margin,
    )


def _continued(plane: NDArray[Number], margin_px: int) -> NDArray[Number]:
    """The plane [y, x] with its mirror image in a margin."""
    return np.pad(plane, margin_px, mode="symmetric") if margin_px else plane
