"""Read an image that is to be deconvolved, with its saturated pixels masked by everything that is known about them."""

from __future__ import annotations

from pathlib import Path

from astropy.io.fits import Header

from psfcore.fits.gain import saturation_for
from psfcore.fits.header import FitsLimits, first_image_header, optional_text
from psfcore.fits.images import read_image
from psfcore.fits.saturation import with_saturation
from psfcore.image import Image
from psfcore.instruments.files import match_instrument
from psfcore.instruments.model import load_instrument


def read_observation(path: str | Path, limits: FitsLimits, *, saturation_dn: float | None = None) -> Image:
    """Read the first 2-D image of a file; ``saturation`` of the image says how its saturated pixels were found.

    saturation_dn: the level in DN of one exposure; None: the level of the header or of the instrument file, or what the
    pixels show. Raises the errors of `psfcore.fits.images.read_image`.
    """
    known = _instrument_level_dn(first_image_header(path, limits))
    image = read_image(path, limits, saturation_dn=saturation_dn or known)
    return with_saturation(image, requested_dn=saturation_dn, instrument_dn=known)


def _instrument_level_dn(header: Header) -> float | None:
    """The level that the instrument file gives for the image's gain mode, in DN of one exposure; None if unknown."""
    name = match_instrument({key: optional_text(header, key) for key in ("TELESCOP", "INSTRUME", "DETECTOR")})
    return None if name is None else saturation_for(load_instrument(name), header)
