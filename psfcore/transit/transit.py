"""A transit, ready for analysis: images of a dark disc in front of the Sun, all in DN/s; folds of a cross-validation.

Folds are sequential blocks of held-out images, with a guard on both sides. Hofmeister et al., The point-spread function
of HRI_EUV, section "Accuracy and robustness": 126 images are divided into ten sequential blocks. Three images on each
side of a block are not used. Here N images give min(10, N // 3) blocks and a guard of round(3 N / 126) images on each
side; if N >= 12, the guard has at least one image.

| symbol | name | unit |
|---|---|---|
| x, y | x_px, y_px: centre of the occulter; the centre of the first pixel is 0 | px |
| r | radius_px of the occulter | px |
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.noise import Noise

MOST_BLOCKS = 10
IMAGES_A_BLOCK = 3
GUARD_SHARE = 3 / 126
GUARD_FROM = 12

Pixels = NDArray[np.float32]
Kernel = NDArray[np.float64]
PixelMask = NDArray[np.bool_]


@dataclass(frozen=True)
class Place:
    """The position of an occulter: its centre and its radius, px."""

    x_px: float
    y_px: float
    radius_px: float


def check_reaches_in(place: Place, shape: tuple[int, ...], label: str) -> None:
    """Raise DataError "occulter-outside" if the square around a disc lies completely outside an image of (ny, nx) px.

    Parameters
    ----------
    label
        The beginning of the message.
    """
    ny, nx = shape
    out_x = max(-0.5 - place.x_px, place.x_px - (nx - 0.5))
    out_y = max(-0.5 - place.y_px, place.y_px - (ny - 0.5))
    if not max(out_x, out_y) <= place.radius_px:
        got = f"x = {place.x_px:g}, y = {place.y_px:g}, r = {place.radius_px:g}"
        raise DataError(
            "occulter-outside",
            f"{label}: expected an occulter at least partly inside the image of {nx} x {ny} px; got {got}: correct "
            "the position",
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a transit: pixels [y, x] in DN/s (float32, finite), and the occulter's position from the ephemeris.

    Raises DataError "frame-shape", "frame-nonfinite", "frame-exposure", "occulter-outside".

    Attributes
    ----------
    time_s
        Seconds since the start of the first frame.
    filled
        True for pixels [y, x] without a valid value of their own. Their values come from another frame or from
        neighbouring pixels, or they are saturated. An analysis of the occulter must not use these pixels.
    """

    file: str
    pixels: Pixels
    pointing: int
    place: Place
    exposure_s: float
    time_s: float
    gain_mode: str | None = None
    filled: PixelMask | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "pixels", np.ascontiguousarray(self.pixels, dtype=np.float32))
        if self.pixels.ndim != 2:
            raise DataError(
                "frame-shape", f"{self.file}: expected pixels with two axes; got shape {self.pixels.shape}"
            )
        if self.filled is not None and self.filled.shape != self.pixels.shape:
            raise DataError(
                "frame-shape",
                f"{self.file}: expected a plane `filled` of the shape {self.pixels.shape} of the pixels; got "
                f"{self.filled.shape}",
            )
        if not np.isfinite(self.pixels).all():
            raise DataError(
                "frame-nonfinite",
                f"{self.file}: expected finite pixels; got NaN or infinite ones: fill them first",
            )
        if not (np.isfinite(self.exposure_s) and self.exposure_s > 0):
            raise DataError(
                "frame-exposure", f"{self.file}: expected an exposure > 0 s; got {self.exposure_s}"
            )
        check_reaches_in(self.place, self.pixels.shape, self.file)


@dataclass(frozen=True, eq=False)
class Transit:
    """All frames of a transit, in time order and of equal shape, with the known part of the PSF and the noise.

    Raises DataError "transit-shapes" if the shapes differ, "transit-empty" if there is no frame.

    Attributes
    ----------
    diffraction
        The known part of the PSF, weights [y, x], centre at [n // 2, n // 2], sum 1 on this array.
    sha256
        The SHA-256 of each input file, by name.
    """

    frames: tuple[Frame, ...]
    diffraction: Kernel
    noise: Noise
    instrument: str | None = None
    plate_scale_arcsec: float | None = None
    sha256: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.frames:
            raise DataError("transit-empty", "expected at least one image; got none")
        shapes = {frame.pixels.shape for frame in self.frames}
        if len(shapes) > 1:
            raise DataError(
                "transit-shapes",
                f"expected images of equal shape; got {sorted(shapes)}: cut all images to one size",
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx) of every frame."""
        ny, nx = self.frames[0].pixels.shape
        return ny, nx


@dataclass(frozen=True)
class Fold:
    """The held-out images of a block, and the images to fit: all other images except the guard. Indices in time
    order.
    """

    held_out: tuple[int, ...]
    fitted: tuple[int, ...]


def folds(images: int) -> tuple[Fold, ...]:
    """One fold per block; empty if there are fewer than six images (two blocks)."""
    count = min(MOST_BLOCKS, images // IMAGES_A_BLOCK)
    if count < 2:
        return ()
    guard = max(round(GUARD_SHARE * images), 1 if images >= GUARD_FROM else 0)
    out = []
    for block in np.array_split(np.arange(images), count):
        first, last = int(block[0]), int(block[-1])
        fitted = [k for k in range(images) if k < first - guard or k > last + guard]
        out.append(Fold(tuple(int(k) for k in block), tuple(fitted)))
    return tuple(out)
