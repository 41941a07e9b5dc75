from __future__ import annotations

from dataclasses import replace

import pytest
from astropy.io.fits import Header

from psfcore.fits.gain import noise_for, saturation_for
from psfcore.instruments.model import GainMode, Instrument, load_instrument
from psfcore.noise import Noise


@pytest.fixture
def instrument() -> Instrument:
    hri = load_instrument("hri_euv")
    modes = {
        "combined": GainMode(saturation_dn=48000, photon_gain_dn=6.0, read_noise_dn=2.0, basis="assumed"),
        "high-only": GainMode(saturation_dn=3500, basis="assumed"),
    }
    detector = replace(hri.detector, gain_modes=modes)
    return replace(hri, detector=detector)


@pytest.mark.parametrize(
    ("mode", "level"),
    [
        ("combined", 48000),
        (" Combined ", 48000),
        ("high-only", 3500),
        ("low-only", None),
        ("", None),
        (3, None),
    ],
)
def test_saturation_depends_on_gain_mode(instrument: Instrument, mode: object, level: float | None) -> None:
    assert saturation_for(instrument, Header({"GAINCOMB": mode})) == level


def test_an_image_without_a_gain_mode_has_no_saturation_level(instrument: Instrument) -> None:
    assert saturation_for(instrument, Header()) is None


def test_noise_needs_photon_gain_and_read_noise(instrument: Instrument) -> None:
    assert noise_for(instrument, Header({"GAINCOMB": "combined"})) == Noise(6.0, 2.0)
    assert noise_for(instrument, Header({"GAINCOMB": "high-only"})) is None
    assert noise_for(instrument, Header()) is None
