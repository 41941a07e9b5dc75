"""What the readout mode of an image means for its pixels.

A detector that is read with a high and a low gain saturates, and turns photons into DN, by mode: GAINCOMB
says which (`combined`, `high-only`, `low-only`). The figures are those of the instrument's [detector.gain_modes].
"""

from __future__ import annotations

from astropy.io.fits import Header

from psfcore.fits.header import optional_text
from psfcore.instruments.model import GainMode, Instrument
from psfcore.noise import Noise


def gain_mode(instrument: Instrument, header: Header) -> GainMode | None:
    """The mode that GAINCOMB names, in any case; None where it names none or the instrument lacks it."""
    named = (optional_text(header, "GAINCOMB") or "").lower()
    modes = {name.lower(): mode for name, mode in instrument.detector.gain_modes.items()}
    return modes.get(named)


def saturation_for(instrument: Instrument, header: Header) -> float | None:
    """Level in DN of one exposure from which a pixel counts as saturated, or None where it is not known."""
    mode = gain_mode(instrument, header)
    return None if mode is None else mode.saturation_dn


def noise_for(instrument: Instrument, header: Header) -> Noise | None:
    """Photon gain and read noise of the image's mode, or None where one of the two is not known."""
    mode = gain_mode(instrument, header)
    if mode is None or mode.photon_gain_dn is None or mode.read_noise_dn is None:
        return None
    return Noise(photon_gain_dn=mode.photon_gain_dn, read_noise_dn=mode.read_noise_dn)
