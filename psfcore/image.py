"""An image, with a mask that marks the pixels that cannot be trusted and says why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntFlag

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.errors import DataError

SMALLEST_SIDE_PX = 16


class MaskBit(IntFlag):
    """Bits of the mask plane. Negative pixels are valid, because noise scatters around zero; they have no bit."""

    NONFINITE = 1
    SATURATED = 2
    LOST = 128  # always together with NONFINITE


@dataclass(frozen=True)
class Saturation:
    """How the saturated pixels of an image were found, see `psfcore.fits.saturation`.

    Attributes
    ----------
    level
        The saturation level in the unit of the image; None: unknown.
    found
        The source of the level: a card, "request", "instrument file" or "pixels".
    warning
        A sentence for the user if pixels may be marked wrongly.
    """

    level: float | None
    found: str | None
    warning: str | None


@dataclass(frozen=True)
class Image:
    """Pixels [y, x] (float64, in `unit`), mask [y, x] (bits of MaskBit), header, and exposure time in seconds.

    Raises DataError: "not-2d", "too-small", "mask-shape", "unmasked-nonfinite".

    Attributes
    ----------
    saturation
        How the saturated pixels were found; None: this was not recorded.
    warnings
        Sentences about the image, by their codes.
    """

    pixels: NDArray[np.float64]
    mask: NDArray[np.uint8]
    header: Header
    unit: str | None
    exposure_s: float | None
    saturation: Saturation | None = None
    warnings: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pixels", np.ascontiguousarray(self.pixels, dtype=np.float64))
        object.__setattr__(self, "mask", np.ascontiguousarray(self.mask, dtype=np.uint8))
        if self.pixels.ndim != 2:
            raise DataError("not-2d", f"expected an image with two axes; got {self.pixels.ndim}")
        if min(self.pixels.shape) < SMALLEST_SIDE_PX:
            ny, nx = self.pixels.shape
            raise DataError("too-small", f"expected at least {SMALLEST_SIDE_PX} px per side; got {nx} x {ny}")
        if self.mask.shape != self.pixels.shape:
            raise DataError("mask-shape", f"expected a mask of {self.pixels.shape}; got {self.mask.shape}")
        bad = ~np.isfinite(self.pixels)
        if bad.any() and (bad & self.finite).any():
            raise DataError(
                "unmasked-nonfinite",
                "expected every NaN or infinite pixel to be masked; got at least one such pixel without a mask: set "
                "MaskBit.NONFINITE in its mask",
            )

    def warned(self, warnings: Mapping[str, str]) -> Image:
        """The image with these warnings added."""
        return replace(self, warnings={**self.warnings, **warnings})

    @property
    def finite(self) -> NDArray[np.bool_]:
        """True for pixels that hold a number, [y, x]; some of them may be saturated."""
        # The value is a plain int: numpy would turn the mask into int64 for a member of the class.
        return np.asarray((self.mask & MaskBit.NONFINITE.value) == 0)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True for pixels that can be trusted, [y, x]."""
        return np.asarray(self.mask == 0)
