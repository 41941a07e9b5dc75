"""Pictures of a decoded image and of the core of a stored PSF, as PNG."""

from __future__ import annotations

import numpy as np

from psfcore.drawing.thumbnail import png_of, png_of_weights
from psfcore.fits.stored_psf import Cutout
from psfcore.fits.viewing.planes import Plane
from psfcore.fits.viewing.windows import pixels, window_of


def picture(plane: Plane, most_px: int) -> bytes:
    """A picture of an image, at most ``most_px`` wide and high. Its pixels are means of blocks. Raises EOFError."""
    window = window_of(plane.shape, step=-(-max(plane.shape) // most_px))
    blocks = np.frombuffer(b"".join(pixels(plane, window, bits=False)), dtype="<f4")
    return png_of(blocks.reshape(window.shape))


def core_picture(part: Cutout) -> bytes:
    """A picture of the central part of a PSF. Raises the errors of ``Cutout.rows``."""
    weights = np.frombuffer(b"".join(part.rows()), dtype=f">f{abs(part.bitpix) // 8}")
    return png_of_weights(weights.reshape(part.size, part.size))
