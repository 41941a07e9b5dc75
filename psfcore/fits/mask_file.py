"""Mask images of a mount, from PNG or FITS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.image import imread
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.fits_io import read_plane
from psfcore.fits.header import FitsLimits

LARGEST_MASK_PX = 16384


def read_mask_image(path: Path) -> NDArray[np.float64]:
    """Pixels [y, x] of a mount's mask image, row 0 at the lowest y.

    A PNG has its lowest row last, and is turned; of colours the mean counts, of transparency nothing.
    Raises DataError "bad-mount" (names the key), for FITS HeaderError and DataError "unreadable-pixels".
    """
    if path.suffix.lower() == ".png":
        return _png(path)
    if not path.is_file():
        raise DataError("bad-mount", f"mount.mask_image.file: expected a file; {path.name} is not there")
    return read_plane(path, FitsLimits(max_pixels=LARGEST_MASK_PX**2))


def _png(path: Path) -> NDArray[np.float64]:
    try:
        picture = np.asarray(imread(path, format="png"), dtype=np.float64)
    except (OSError, ValueError, SyntaxError) as error:  # a broken PNG is a SyntaxError to Pillow
        reason = " ".join(str(error).split())
        raise DataError("bad-mount", f"mount.mask_image.file: expected a PNG; {reason:.120}") from None
    if picture.ndim == 3:
        colours = picture.shape[2] - 1 if picture.shape[2] in (2, 4) else picture.shape[2]
        picture = picture[:, :, :colours].mean(axis=2)
    return picture[::-1].copy()
