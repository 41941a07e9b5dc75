"""What lies beyond the field: nothing, the field's mirror image, or a scene that nobody saw.

- zero: the scene ends with the field, as Hofmeister et al. have it.
- symmetric: the field is continued by its mirror image for a margin, deconvolved and cut.
- extended: the scene is sought on field and margin, where no pixel of the margin was observed
  (Bertero & Boccacci 2005, A&A 437, 369); it starts from the mirror image.

How far the scene beyond an edge matters is read off the PSF. Of a uniform scene that goes on, a pixel at
distance d from a straight edge (0 for the pixels along it) holds the share

    b(d) = sum over o > d of l[o],   l[o] = sum of the weights whose offset across the edge is o      Eq. (1)

of light from beyond the edge; l is taken as the mean over the four directions.

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

# A pixel is flagged, and left out of the judgement of the fit, where more of its light than this may come
# from beyond the field.
FLAGGED_SHARE = 0.05

Plane = NDArray[np.float32]
Trust = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Domain:
    """The plane on which a scene is sought: the field and its margin.

    pixels [y, x]: the image over `scale`, 0 where it is not finite; beyond the field its mirror image.
    trusted: where a pixel pulls the estimate. finite: where it may at least start it.
    field: the field's place in the plane. scale: the largest absolute value, so that float32 holds any image.
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
        """How far apart pixels may lie and be joined: all that reach the field, where the margin is sought for
        itself; else what the field spans, for a mirror image need not be joined to the opposite one."""
        sought = self.margin_px if self.edges == "extended" else 0
        ny, nx = (part.stop - part.start for part in self.field)
        return ny + sought, nx + sought

    def cut(self, plane: Plane) -> NDArray[np.float64]:
        """The field's part of a plane, in the image's unit."""
        return plane[self.field].astype(np.float64) * self.scale


def share_from_beyond(psf: Psf) -> NDArray[np.float64]:
    """b of Eq. (1) for d = 0, 1, ... up to the PSF's reach along an axis."""
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
    """Width of the band along an edge in which more than `fraction` of a pixel's light may come from beyond."""
    if not 0 < fraction < 1:
        raise DataError("bad-fraction", f"expected a fraction between 0 and 1; got {fraction}")
    return band_px(share_from_beyond(psf), fraction)


def band_px(shares: NDArray[np.float64], fraction: float) -> int:
    """The same of b itself, which takes a pass over the whole PSF."""
    return int(np.count_nonzero(shares > fraction))


def margin_for(shares: NDArray[np.float64], field_shape: tuple[int, int], *, share: float) -> int:
    """How far beyond the field to follow the scene: what lies farther gives a pixel at the edge `share` at most.

    shares: b of Eq. (1). Not farther than half the field, whose mirror image it is; rounded up to half a block
    of the engine.
    """
    half_block = BLOCK_ROWS // 2
    wanted = half_block * -(-band_px(shares, share) // half_block)
    return min(wanted, min(field_shape) // 2)


def lay_out(image: Image, *, edges: Edges, margin_px: int) -> Domain:
    """Put an image and what lies beyond its edges on one plane.

    Raises DataError: "bad-edges", "all-masked", "no-signal".
    """
    if edges not in EDGES:
        raise DataError("bad-edges", f"expected edges to be one of {', '.join(EDGES)}; got {edges}")
    if not image.valid.any():
        raise DataError("all-masked", "expected a pixel that can be trusted; every one is masked")
    finite = (image.mask & MaskBit.NONFINITE) == 0
    scale = float(np.abs(image.pixels[finite]).max())
    if scale == 0:
        raise DataError("no-signal", "expected a pixel that is not zero; got none")
    # Divided in float64: neither 1e-300 nor 1e300 fits float32.
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
