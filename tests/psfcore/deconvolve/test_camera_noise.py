"""The noise of a camera: given, published for its telescope, or measured in the image."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io.fits import Header

from psfcore.deconvolve.camera_noise import camera_noise, measured_noise
from psfcore.errors import DataError
from psfcore.fits.observation import observation_of, read_observation
from psfcore.image import Image
from psfcore.instruments.model import Instrument, parse_instrument
from psfcore.noise import Noise
from tests.conftest import SMALL_INSTRUMENT
from tests.psfcore.conftest import LIMITS

AIA = {"TELESCOP": "SDO/AIA", "WAVELNTH": 171, "PIXLUNIT": "DN", "EXPTIME": 2.0}
BRIGHTNESS = np.array([30.0, 100.0, 400.0])  # of most pixels of the scene, DN


def scene(seed: int, shape: tuple[int, int] = (320, 384)) -> np.ndarray:
    """Sources of 3 to 40 px on a faint background, DN."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(shape)
    light = np.full(shape, 20.0)
    for _ in range(40):
        width, peak = rng.uniform(3, 40), rng.uniform(20, 600)
        distance2 = (x - rng.uniform(0, shape[1])) ** 2 + (y - rng.uniform(0, shape[0])) ** 2
        light += peak * np.exp(-distance2 / (2 * width**2))
    return light


def image_of(noise: Noise, *, seed: int = 1, exposure_s: float = 1.0, **cards: Any) -> Image:
    """A noisy image of the scene; in DN/s if the cards say so."""
    dn = exposure_s if cards.get("BUNIT") == "DN/s" else 1.0
    pixels = noise.observe(scene(seed) / dn, dn, np.random.default_rng(seed))
    return observation_of(pixels, Header({"BUNIT": "DN", "EXPTIME": exposure_s, **cards}))


@pytest.mark.parametrize("gain", [0.1, 1.0, 6.0])
@pytest.mark.parametrize("cards", [{}, {"BUNIT": "DN/s", "exposure_s": 4.0}])
def test_the_measured_figures_are_those_of_the_camera(gain: float, cards: dict[str, Any]) -> None:
    camera = Noise(gain, 5.0)
    found = measured_noise(image_of(camera, **cards))
    assert found.source == "measured" and found.sigma is not None
    assert found.photon_gain_dn == pytest.approx(gain, abs=4 * found.sigma[0])
    assert found.sigma[0] < 0.1 * gain
    assert found.variance(BRIGHTNESS, 1.0) == pytest.approx(camera.variance(BRIGHTNESS, 1.0), rel=0.15)
    assert found.as_json()["sigma"] == found.sigma


def test_which_pixels_of_an_image_are_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    image = image_of(Noise(1.0, 5.0))
    pixels = image.pixels.copy()
    pixels[::7, ::5] = np.nan
    holed = observation_of(pixels, image.header)
    assert measured_noise(holed).photon_gain_dn == pytest.approx(1.0, rel=0.1)
    flat = observation_of(np.full((64, 64), 7.0), Header({"BUNIT": "DN"}))
    with pytest.raises(DataError, match="no-noise-figures"):
        measured_noise(flat)
    found = measured_noise(image, np.sqrt(2.0 * np.maximum(image.pixels, 0) + 9.0))
    assert found.source == "uncertainty"
    assert found.variance(BRIGHTNESS, 1.0) == pytest.approx(2.0 * BRIGHTNESS + 9.0, rel=0.05)
    whole = measured_noise(image)
    monkeypatch.setattr("psfcore.deconvolve.camera_noise._MOST_PIXELS", image.pixels.size // 2)
    part = measured_noise(image)
    assert part.photon_gain_dn != whole.photon_gain_dn
    assert part.photon_gain_dn == pytest.approx(whole.photon_gain_dn, rel=0.05)


def test_given_figures_come_before_published_ones_and_these_before_measured_ones() -> None:
    image = image_of(Noise(1.0, 5.0), **AIA)
    given = camera_noise(image, Noise(3.0, 4.0), binning=1)
    assert (given.photon_gain_dn, given.read_noise_dn, given.source) == (3.0, 4.0, "given")
    published = camera_noise(image, None, binning=1)
    assert (published.photon_gain_dn, published.read_noise_dn) == (1.122, 1.15)
    assert published.source == "published" and "aia_V3_error_table" in published.basis
    binned = camera_noise(image, None, binning=4)
    assert binned.variance(image.pixels, 1.0) == pytest.approx(published.variance(image.pixels, 1.0) / 16)
    for cards in ({}, {**AIA, "WAVELNTH": 1600}, {**AIA, "BUNIT": "W m-2 sr-1"}):
        assert camera_noise(image_of(Noise(1.0, 5.0), **cards), None, binning=1).source == "measured"


def test_figures_of_an_instrument_file_need_photon_gain_and_read_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    modes = """
[detector.gain_modes.combined]
photon_gain_dn = 6.0
read_noise_dn = 2.0
basis = "measured"
[detector.gain_modes.high-only]
saturation_dn = 300.0
basis = "assumed"
"""

    def small(name: str) -> Instrument:
        return parse_instrument(SMALL_INSTRUMENT + modes, name)

    monkeypatch.setattr("psfcore.deconvolve.camera_noise.load_instrument", small)
    known = {"DETECTOR": "HRI_EUV"}
    combined = camera_noise(image_of(Noise(1.0, 5.0), **known, GAINCOMB="combined"), None, binning=1)
    assert (combined.photon_gain_dn, combined.read_noise_dn) == (6.0, 2.0) and "measured" in combined.basis
    for cards in ({"GAINCOMB": "high-only"}, {}):
        assert camera_noise(image_of(Noise(1.0, 5.0), **known, **cards), None, binning=1).source == "measured"


def test_the_figures_of_a_real_camera_are_found_in_its_image(real: Callable[[str], Path]) -> None:
    """AIA at 1600 angstrom, whose photons free one electron each: 0.12 DN per photon and 1.15 DN are published."""
    path = real("occultation/AIA1600_venus_20120606_040731_UTC.0041.fits")
    found = measured_noise(read_observation(path, LIMITS))
    assert found.photon_gain_dn == pytest.approx(0.12, rel=0.25)
    assert found.read_noise_dn == pytest.approx(1.15, rel=0.3)
