"""Read an image for deconvolution, and mask its saturated pixels with all known saturation levels and a test of the
pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.fits.gain import saturation_for
from psfcore.fits.header import FitsLimits, first_image_header, known_instrument
from psfcore.fits.images import image_of, read_image
from psfcore.fits.saturation import with_saturation
from psfcore.image import Image
from psfcore.instruments.model import load_instrument


def read_observation(path: str | Path, limits: FitsLimits, *, saturation_dn: float | None = None) -> Image:
    """Read the first 2-D image of a file. The field ``saturation`` of the image says how its saturated pixels were
    found.

    saturation_dn: the saturation level in DN of one exposure; None: the level is taken from the header or the
    instrument file, and the pixels are tested, see `psfcore.fits.saturation`. Raises the errors of
    `psfcore.fits.images.read_image`.
    """
    known = _instrument_level_dn(first_image_header(path, limits))
    image = read_image(path, limits, saturation_dn=saturation_dn or known)
    return with_saturation(image, requested_dn=saturation_dn, instrument_dn=known)


def observation_of(
    pixels: NDArray[np.float64],
    header: Header,
    *,
    saturation_dn: float | None = None,
    stored_as_integer: bool = False,
) -> Image:
    """Make an image from pixels [y, x] and a header in memory. Its saturated pixels are masked as in
    `read_observation`.

    Raises the errors of `psfcore.fits.images.image_of`.
    """
    known = _instrument_level_dn(header)
    image = image_of(
        pixels, header, saturation_dn=saturation_dn or known, stored_as_integer=stored_as_integer
    )
    return with_saturation(image, requested_dn=saturation_dn, instrument_dn=known)


def _instrument_level_dn(header: Header) -> float | None:
    """The level that the instrument file gives for the image's gain mode, in DN of one exposure; None if unknown."""
    name = known_instrument(header)
    return None if name is None else saturation_for(load_instrument(name), header)
