"""Assumptions about the scene beyond the field: zero, the field's mirror image, or an unknown scene.

- zero: the scene is zero beyond the field, as in Hofmeister et al. (2024).
- symmetric: a margin continues the field by its mirror image; field and margin are deconvolved, then the margin is
  cut off.
- extended: the scene is estimated on field and margin, although no pixel of the margin was observed
  (Bertero & Boccacci 2005, A&A 437, 369). The estimate starts from the mirror image.

The PSF tells how far from an edge the scene beyond it matters. For a uniform scene, a pixel at distance d from a
straight edge (0 for the outermost pixels) receives from beyond the edge the share

    b(d) = sum over o > d of l[o],   l[o] = sum of the weights whose offset across the edge is o      Eq. (1)

of its light; l is the mean over the four directions.

| symbol | name | unit |
|---|---|---|
| d | distance from the edge | px |
| b | share_from_beyond | - |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.engine import BLOCK_ROWS
from psfcore.errors import DataError
from psfcore.image import Image, MaskBit
from psfcore.psf import Psf

Edges = Literal["zero", "symmetric", "extended"]
EDGES: tuple[Edges, ...] = ("zero", "symmetric", "extended")

# If more than this share of a pixel's light may come from beyond the field, the pixel is flagged, and chi2 does
# not include it.
FLAGGED_SHARE = 0.05

Plane = NDArray[np.float32]
Trust = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Domain:
    """The plane on which a method estimates the scene: the field and its margin.

    pixels [y, x]: the image divided by `scale`, 0 where it is not finite; in the margin its mirror image.
    trusted: pixels that the estimate is fitted to. finite: pixels that can serve as its starting value.
    field: position of the field in the plane. scale: the largest absolute pixel value, so that float32 can hold
    any image.
    """

    pixels: Plane
    trusted: Trust
    finite: Trust
    field: tuple[slice, slice]
    scale: float
    edges: Edges
    margin_px: int

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx) of field and margin."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def span(self) -> tuple[int, int]:
        """Distance (ny, nx) within which the convolution must be exact.

        With extended edges it covers every pixel whose light reaches the field. Otherwise it is the size of the
        field: opposite mirror images need no connection.
        """
        sought = self.margin_px if self.edges == "extended" else 0
        ny, nx = (part.stop - part.start for part in self.field)
        return ny + sought, nx + sought

    def cut(self, plane: Plane) -> NDArray[np.float64]:
        """Cut the field out of a plane, in the image's unit."""
        return plane[self.field].astype(np.float64) * self.scale


def share_from_beyond(psf: Psf) -> NDArray[np.float64]:
    """b of Eq. (1) for d = 0, 1, ... px, up to half the PSF's size."""
    ny, nx = psf.kernel.shape
    shares = np.zeros((4, max(ny, nx) + 1))
    for n, (line, centre) in enumerate(
        (line, centre)
        for total, size in ((psf.kernel.sum(axis=1), ny), (psf.kernel.sum(axis=0), nx))
        for line, centre in ((total, size // 2), (total[::-1], size - 1 - size // 2))
    ):
        beyond = line[centre + 1 :]
        shares[n, : beyond.size] = np.cumsum(beyond[::-1])[::-1]
    return np.asarray(shares.mean(axis=0)[: max(ny, nx) // 2 + 1])  # Eq. (1)


def edge_band_px(psf: Psf, fraction: float = FLAGGED_SHARE) -> int:
    """Width of the band along an edge in which more than `fraction` of a pixel's light may come from beyond it.

    Raises DataError "bad-fraction".
    """
    if not 0 < fraction < 1:
        raise DataError("bad-fraction", f"expected a fraction between 0 and 1; got {fraction}")
    return band_px(share_from_beyond(psf), fraction)


def band_px(shares: NDArray[np.float64], fraction: float) -> int:
    """As `edge_band_px`, from b of Eq. (1). To compute b takes a pass over the whole PSF."""
    return int(np.count_nonzero(shares > fraction))


def margin_for(shares: NDArray[np.float64], field_shape: tuple[int, int], *, share: float) -> int:
    """Width of the margin in px: light from farther away is at most `share` of an edge pixel's light.

    shares: b of Eq. (1). The width is rounded up to half a block of the engine. It is at most half the field.
    """
    half_block = BLOCK_ROWS // 2
    wanted = half_block * -(-band_px(shares, share) // half_block)
    return min(wanted, min(field_shape) // 2)


def lay_out(image: Image, *, edges: Edges, margin_px: int) -> Domain:
    """Put an image and its margin on one plane.

    Raises DataError: "bad-edges", "all-masked", "no-signal".
    """
    if edges not in EDGES:
        raise DataError("bad-edges", f"expected edges to be one of {', '.join(EDGES)}; got {edges}")
    if not image.valid.any():
        raise DataError("all-masked", "expected at least one pixel that is not masked; all pixels are masked")
    finite = (image.mask & MaskBit.NONFINITE) == 0
    scale = float(np.abs(image.pixels[finite]).max())
    if scale == 0:
        raise DataError("no-signal", "expected at least one pixel other than zero; all are zero")
    # Divide in float64, because float32 can hold neither 1e-300 nor 1e300.
    scaled = np.where(finite, image.pixels, 0.0) / scale
    margin = 0 if edges == "zero" else margin_px
    ny, nx = scaled.shape
    trusted = np.pad(image.valid, margin, mode="symmetric")
    field = (slice(margin, margin + ny), slice(margin, margin + nx))
    if edges == "extended":
        observed = np.zeros_like(trusted)
        observed[field] = True
        trusted &= observed
    return Domain(
        pixels=np.pad(scaled.astype(np.float32), margin, mode="symmetric"),
        trusted=trusted,
        finite=np.pad(finite, margin, mode="symmetric"),
        field=field,
        scale=scale,
        edges=edges,
        margin_px=margin,
    )
