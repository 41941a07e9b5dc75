"""Saturation level and noise, which depend on the gain mode of an image.

Some detectors are read with a high and a low gain. Saturation level, photon gain and read noise then depend on the
mode, which the card GAINCOMB names (`combined`, `high-only`, `low-only`). The values come from the table
[detector.gain_modes] of the instrument description.
"""

from __future__ import annotations

from psfcore.fits.cards import Cards, optional_text
from psfcore.instruments.model import GainMode, Instrument


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
