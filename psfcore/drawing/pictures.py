"""Pictures of decoded images for pages, as PNG."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from psfcore.drawing.thumbnail import png_of, png_of_weights
from psfcore.fits.viewing.planes import Plane
from psfcore.fits.viewing.windows import pixels, window_of


def picture(plane: Plane, most_px: int) -> bytes:
    """A picture of an image, at most ``most_px`` wide and high. Its pixels are means of blocks. Raises EOFError."""
    window = window_of(plane.shape, step=-(-max(plane.shape) // most_px))
    return png_of(_numbers(pixels(plane, window, bits=False), window.shape))


def core_picture(plane: Plane, most_px: int) -> bytes:
    """A picture of the central part of a PSF, at most ``most_px`` wide and high. Raises EOFError."""
    ny, nx = plane.shape
    edge = min(most_px, ny, nx)
    x, y = nx // 2 - edge // 2, ny // 2 - edge // 2
    window = window_of(plane.shape, x=x, y=y, width=edge, height=edge)
    return png_of_weights(_numbers(pixels(plane, window, bits=False), window.shape))


def _numbers(pieces: Iterator[bytes], shape: tuple[int, int]) -> NDArray[np.float32]:
    return np.frombuffer(b"".join(pieces), dtype="<f4").reshape(shape)
