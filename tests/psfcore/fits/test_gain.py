"""Saturation level and noise depend on the gain mode of an image."""

from __future__ import annotations

from pathlib import Path

import pytest
from astropy.io.fits import Header

from psfcore.fits import observation
from psfcore.fits.gain import noise_for
from psfcore.fits.header import FitsLimits
from psfcore.instruments.model import Instrument, parse_instrument
from psfcore.noise import Noise
from tests.conftest import SMALL_INSTRUMENT, write_image

MODES = """
[detector.gain_modes.combined]
saturation_dn = 400.0
photon_gain_dn = 6.0
read_noise_dn = 2.0
basis = "assumed"
[detector.gain_modes.high-only]
saturation_dn = 300.0
basis = "assumed"
"""


def instrument(name: str = "small") -> Instrument:
    return parse_instrument(SMALL_INSTRUMENT + MODES, name)


LEVELS = [
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": "combined"}, None, 200.0, "instrument file"),
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": " Combined "}, None, 200.0, "instrument file"),
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": "high-only"}, None, 150.0, "instrument file"),
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": "low-only"}, None, None, None),
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": 3}, None, None, None),
    ({"DETECTOR": "HRI_EUV"}, None, None, None),
    ({"DETECTOR": "FSI", "GAINCOMB": "combined"}, None, None, None),
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": "combined"}, 500.0, 250.0, "request"),
]


def test_the_level_is_that_of_the_gain_mode_in_the_header(
    tmp_path: Path, limits: FitsLimits, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image is in DN/s, from an exposure of 2 s."""
    monkeypatch.setattr(observation, "load_instrument", instrument)
    for number, (cards, saturation_dn, level, source) in enumerate(LEVELS):
        path = tmp_path / f"{number}.fits"
        write_image(path, **cards)
        image = observation.read_observation(path, limits, saturation_dn=saturation_dn)
        assert image.saturation is not None
        assert (image.saturation.level, image.saturation.found) == (level, source), cards
        assert image.valid.all() == (level is None)


def test_noise_needs_photon_gain_and_read_noise() -> None:
    assert noise_for(instrument(), Header({"GAINCOMB": "combined"})) == Noise(6.0, 2.0)
    assert noise_for(instrument(), Header({"GAINCOMB": "high-only"})) is None
    assert noise_for(instrument(), Header()) is None
