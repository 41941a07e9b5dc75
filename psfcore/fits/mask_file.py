"""Read the mask image of a mount from a PNG or FITS file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError, module_of_extra
from psfcore.fits.header import FitsLimits
from psfcore.fits.images import read_plane

LARGEST_MASK_PX = 16384


def read_mask_image(path: Path) -> NDArray[np.float64]:
    """Read a mount's mask image as pixels [y, x], row 0 at the lowest y.

    A PNG stores its lowest row last, so its rows are reversed. Colours are averaged; transparency is ignored. Raises
    DataError "bad-mount"; its message names the key of the instrument file. A FITS file can also raise HeaderError and
    DataError "unreadable-pixels".
    """
    if path.suffix.lower() == ".png":
        return _png(path)
    if not path.is_file():
        raise DataError(
            "bad-mount", f"mount.mask_image.file: expected an existing file; {path.name} does not exist"
        )
    return read_plane(path, FitsLimits(max_pixels=LARGEST_MASK_PX**2))


def _png(path: Path) -> NDArray[np.float64]:
    imread = module_of_extra("plot", "matplotlib.image").imread
    try:
        picture = np.asarray(imread(path, format="png"), dtype=np.float64)
    except (OSError, ValueError, SyntaxError) as error:  # Pillow raises SyntaxError for a broken PNG
        reason = " ".join(str(error).split())
        raise DataError(
            "bad-mount", f"mount.mask_image.file: expected a PNG that can be read; got: {reason:.120}"
        ) from None
    if picture.ndim == 3:
        colours = picture.shape[2] - 1 if picture.shape[2] in (2, 4) else picture.shape[2]
        picture = picture[:, :, :colours].mean(axis=2)
    return picture[::-1].copy()
