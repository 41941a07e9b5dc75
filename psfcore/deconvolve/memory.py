"""The memory that a deconvolution needs, before anything is read.

It follows from the sizes of image and PSF:

    bytes = plane_bytes P + (transform_bytes + term_bytes M) L + image_bytes I + psf_bytes (1 + M) K        Eq. (1)

`python -m benchmarks.growth memory` measures both sides of Eq. (1). The size of the margin follows from the PSF, which
may not exist yet; the figure margin_of_psf of each method was measured with the PSF of HRI_EUV, which scatters much
light. This module imports no numerical libraries, because the web process uses it too.

| symbol | name | unit |
|---|---|---|
| I | pixels of the image | px |
| P | pixels of the plane: image and margins | px |
| L | pixels of the transforms: the plane, padded for the reach of the PSF | px |
| K | pixels of the PSF | px |
| M | terms of a PSF that changes over the field | - |
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from psfcore.convolution.lengths import LARGEST_LENGTH, good_length
from psfcore.deconvolve.declaration import WITHOUT_MARGIN, KnownScene
from psfcore.deconvolve.methods.registry import method_names, properties_of
from psfcore.errors import DataError

EXPECTED_RIM_PX = 384  # for estimates; the width of the rim follows from the pixels

Shape = tuple[int, int]
IMAGE_BYTES = 20.0  # the image in float64, the result and the compared planes in float32, and the masks
ERRORS_BYTES = 240.0  # further bytes for each pixel of the image, if errors are estimated
PSF_BYTES = 8.0
TERM_BYTES = 10.0  # a transfer function (complex), and a further spectrum of the plane
ASSESSED_BYTES = (
    12.0  # for each pixel of an image: to measure the changes, and to draw the pictures of a product
)
# Of a convolution: the measured memory with images of 1024 to 3072 px and PSFs of 512 and 2048 px, rounded up.
CONVOLVED_PLANE_BYTES, CONVOLVED_TRANSFORM_BYTES, CONVOLVED_IMAGE_BYTES = 8.0, 12.0, 24.0
READ_BYTES = 25.0  # for each pixel of the image beyond the region that is deconvolved
MIB = 2**20


@dataclass(frozen=True)
class Demand:
    """A deconvolution: the method, the shapes (ny, nx) of image and PSF, and the options that determine its memory.

    Attributes
    ----------
    edges, margin_px
        Edges and width of the margin; None: the default of the method.
    draws
        Number of noise realisations.
    terms
        Number of the terms of a PSF that changes over the field.
    """

    method: str
    image: Shape
    psf: Shape
    edges: str | None = None
    margin_px: int | None = None
    draws: int = 0
    terms: int = 0

    @property
    def margin(self) -> int:
        """Expected width of the margin, px."""
        if self.edges in WITHOUT_MARGIN:
            return 0
        if self.margin_px is not None:
            return self.margin_px
        share = _figure(self.method, "margin_of_psf")
        return int(min(share * max(self.psf) / 2, min(self.image) / 2))

    @property
    def plane(self) -> Shape:
        """Shape of the plane: image and margins."""
        ny, nx = self.image
        return ny + 2 * self.margin, nx + 2 * self.margin

    @property
    def transform(self) -> Shape:
        """Lengths of the transforms: the plane, and the light that crosses its edge must not wrap into the image."""
        if self.edges == "periodic":
            return self.image
        extended = (self.edges or properties_of(self.method).edges) == "extended"
        sought = self.margin if extended else 0
        ny, nx = (
            max(side, size + sought + min(psf // 2, size + sought - 1))
            for side, size, psf in zip(self.plane, self.image, self.psf, strict=True)
        )
        return _length(ny), _length(nx)


def deconvolution_bytes(demand: Demand) -> float:
    """Eq. (1): the memory of a deconvolution, with its image, its PSF and its result, in bytes."""
    image_bytes = IMAGE_BYTES + (ERRORS_BYTES if demand.draws else 0.0)
    plane_bytes, transform_bytes = (_figure(demand.method, one) for one in ("plane_bytes", "transform_bytes"))
    return (
        plane_bytes * math.prod(demand.plane)
        + (transform_bytes + TERM_BYTES * demand.terms) * math.prod(demand.transform)
        + image_bytes * math.prod(demand.image)
        + PSF_BYTES * (1 + demand.terms) * math.prod(demand.psf)
    )


def product_bytes(demand: Demand, image_px: int) -> float:
    """The memory of a deconvolution whose changes are measured, in bytes.

    Parameters
    ----------
    image_px
        Number of pixels of the whole image.
    """
    part_px = math.prod(demand.image)
    return deconvolution_bytes(demand) + ASSESSED_BYTES * part_px + READ_BYTES * (image_px - part_px)


def convolution_bytes(image: Shape, psf: Shape, edges: KnownScene) -> float:
    """The memory of a convolution, with its image, its PSF and its result, in bytes: Eq. (1) for a plane with the
    margin that the light of the PSF can cross.
    """
    margin = 0 if edges == "zero" else min(max(psf) // 2, min(image) // 2)
    plane = image[0] + 2 * margin, image[1] + 2 * margin
    transform = [_length(size + min(reach // 2, size - 1)) for size, reach in zip(plane, psf, strict=True)]
    return (
        CONVOLVED_PLANE_BYTES * math.prod(plane)
        + CONVOLVED_TRANSFORM_BYTES * math.prod(transform)
        + CONVOLVED_IMAGE_BYTES * math.prod(image)
        + PSF_BYTES * math.prod(psf)
    )


def check_memory(
    image: Shape,
    needed_bytes: float,
    free_bytes: int,
    *,
    task: str = "deconvolution",
    advice: str = "deconvolve a part of the image (--region, in Python region=)",
) -> None:
    """Raise DataError "too-much-memory" if the task on an image of this shape needs more than the free memory.

    Without this error, the system would end the process without a message.

    Parameters
    ----------
    advice
        A way in which the task needs less memory, for the message.
    """
    if needed_bytes <= free_bytes:
        return
    ny, nx = image
    raise DataError(
        "too-much-memory",
        f"expected a {task} that fits into the free memory, {free_bytes / MIB:.0f} MiB; an image of {nx} x "
        f"{ny} px needs about {needed_bytes / MIB:.0f} MiB: {advice}, end other programs, or use a machine with more "
        "memory",
        {"needed_mib": round(needed_bytes / MIB), "free_mib": round(free_bytes / MIB)},
    )


def _figure(method: str, name: str) -> float:
    """A measured figure of a method; the largest one of all methods if it was not measured for this one."""
    figures = {one: getattr(properties_of(one), name) for one in method_names()}
    return float(figures[method] or max(filter(None, figures.values())))


def _length(at_least: int) -> int:
    # A longer transform is refused when the deconvolution begins.
    return good_length(at_least) if at_least <= LARGEST_LENGTH else at_least
