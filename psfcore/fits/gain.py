"""Saturation level and noise, which depend on the gain mode of an image.

Some detectors are read with a high and a low gain. Saturation level, photon gain and read noise then depend on the
mode, which the card GAINCOMB names (`combined`, `high-only`, `low-only`). The values come from the table
[detector.gain_modes] of the instrument description.
"""

from __future__ import annotations

from astropy.io.fits import Header

from psfcore.fits.header import optional_text
from psfcore.instruments.model import GainMode, Instrument
from psfcore.noise import Noise


def gain_mode(instrument: Instrument, header: Header) -> GainMode | None:
    """The mode that GAINCOMB names, in upper or lower case.

    None if the card is missing, or if the instrument description does not have this mode.
    """
    named = (optional_text(header, "GAINCOMB") or "").lower()
    modes = {name.lower(): mode for name, mode in instrument.detector.gain_modes.items()}
    return modes.get(named)


def saturation_for(instrument: Instrument, header: Header) -> float | None:
    """Level (DN in one exposure) from which a pixel is saturated; None if it is not known."""
    mode = gain_mode(instrument, header)
    return None if mode is None else mode.saturation_dn


def noise_for(instrument: Instrument, header: Header) -> Noise | None:
    """Photon gain and read noise of the image's gain mode; None if one of the two is not known."""
    mode = gain_mode(instrument, header)
    if mode is None or mode.photon_gain_dn is None or mode.read_noise_dn is None:
        return None
    return Noise(photon_gain_dn=mode.photon_gain_dn, read_noise_dn=mode.read_noise_dn)
