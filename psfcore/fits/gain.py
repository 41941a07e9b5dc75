"""Saturation level and noise, which depend on the gain mode of an image.

Some detectors are read with a high and a low gain. Saturation level, photon gain and read noise then depend on the
mode, which the card GAINCOMB names (`combined`, `high-only`, `low-only`). The values come from the table
[detector.gain_modes] of the instrument description.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfcore.errors import DataError
from psfcore.fits.cards import Cards, optional_text
from psfcore.instruments.model import GainMode, Instrument

if TYPE_CHECKING:
    from psfcore.noise import Noise


def gain_mode(instrument: Instrument, header: Cards) -> GainMode | None:
    """The mode that GAINCOMB names, in upper or lower case.

    None if the card is missing, or if the instrument description does not have this mode.
    """
    named = (optional_text(header, "GAINCOMB") or "").lower()
    modes = {name.lower(): mode for name, mode in instrument.detector.gain_modes.items()}
    return modes.get(named)


def saturation_for(instrument: Instrument, header: Cards) -> float | None:
    """Level (DN in one exposure) from which a pixel is saturated; None if it is not known."""
    mode = gain_mode(instrument, header)
    return None if mode is None else mode.saturation_dn


def noise_figures_for(instrument: Instrument, header: Cards) -> tuple[float, float] | None:
    """Photon gain (DN per photon) and read noise (DN rms) of the image's gain mode; None if one of the two is not known."""
    mode = gain_mode(instrument, header)
    if mode is None or mode.photon_gain_dn is None or mode.read_noise_dn is None:
        return None
    return mode.photon_gain_dn, mode.read_noise_dn


def noise_for(instrument: Instrument, header: Cards) -> Noise | None:
    """The noise model with the figures of `noise_figures_for`; None if the figures are not known."""
    figures = noise_figures_for(instrument, header)
    if figures is None:
        return None
    from psfcore.noise import Noise

    return Noise(*figures)


def no_noise_figures() -> DataError:
    """The error if noise realisations are requested but the noise of the camera is not known."""
    return DataError(
        "no-noise-figures",
        "expected noise (photon_gain_dn and read_noise_dn) to simulate noise realisations; got none, and the instrument's "
        "figures are unknown: give them (noise=(GAIN, READ) in Python, --noise GAIN READ on the command line, noise in a "
        "request), or ask for 0 noise realisations",
    )
