"""The saturation level: from request, header and instrument file, and from the pixels, without false alarms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray
from scipy.stats import poisson

from psfcore.fits import observation
from psfcore.fits.observation import read_observation
from psfcore.fits.saturation import largest_value, with_saturation
from psfcore.image import Image, MaskBit
from psfcore.instruments.model import Instrument, parse_instrument
from tests.conftest import SMALL_INSTRUMENT, write_image
from tests.psfcore.conftest import LIMITS

Find = Callable[[str], Path]
FLARE = "aia/limbflare_20120719/aia.lev1_euv_12s.2012-07-19T073037Z.171.image.fits"
# Unsaturated real images of AIA, FSI, SWAP, TRACE and XRT: integers, floats in DN, and floats in DN/s.
UNSATURATED = (
    "aia/aia_171_cutout_20130310.fits",
    "aia/aia.lev1_euv_12s.2022-04-02T132423Z.304.image.fits",
    "aia/AIA20110319_105400_0171.fits.gz",
    "aia/derived_aia193_coronalhole_20161123_map.fits.gz",
    "eui/solo_L2_eui-fsi174-image_20240109T200055237_V01.fits",
    "occultation/AIA1600_venus_20120606_040731_UTC.0041.fits",
    "occultation/L1_XRT20120605_215839.9.fits",
    "other/swap_lv1_20110607_063329.fits.gz",
    "other/trace_19980519_222143_171.fits.gz",
)


def image_of(
    pixels: NDArray[np.float64], unit: str | None = "DN", exposure_s: float | None = 2.0, **cards: object
) -> Image:
    return Image(pixels, np.zeros(pixels.shape, np.uint8), fits.Header(cards), unit, exposure_s)


def saturated(image: Image) -> NDArray[np.bool_]:
    return (image.mask & MaskBit.SATURATED) != 0


def exposure(seed: int, *, clip_dn: float | None = None, gain: float = 1.0) -> NDArray[np.float64]:
    """An image in whole DN with bright structure on a faint background, with photon noise, clipped at clip_dn."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((128, 128))
    scene = 30 + 6000 * np.exp(-((x - 70) ** 2 + (y - 50) ** 2) / 60.0)
    seen = np.round(gain * rng.poisson(scene / gain) + rng.normal(0, 2, scene.shape))
    return seen if clip_dn is None else np.minimum(seen, clip_dn)


def test_aia_marks_what_its_header_counts_or_its_pixels_show(real: Find) -> None:
    image = read_observation(real(FLARE), LIMITS)
    assert int(image.header["NSATPIX"]) == np.count_nonzero(saturated(image)) == 351
    assert image.saturation is not None
    assert (image.saturation.level, image.saturation.found, image.saturation.warning) == (
        15000.0,
        "NSATPIX",
        None,
    )
    del image.header["NSATPIX"]
    for unit, exposure_s, scale in (("DN", 2.0, 1.0), ("DN/s", 2.000096, 2.000096)):
        seen = with_saturation(
            Image(image.pixels / scale, np.zeros_like(image.mask), image.header, unit, exposure_s)
        )
        assert seen.saturation is not None and seen.saturation.found == "pixels"
        assert seen.saturation.level == pytest.approx(16383 / scale, rel=1e-12)
        np.testing.assert_array_equal(saturated(seen), image.pixels == 16383)
        assert seen.saturation.warning is None


def test_no_false_alarm_on_unsaturated_real_images(real: Find) -> None:
    for name in UNSATURATED:
        image = read_observation(real(name), LIMITS)
        assert image.saturation is not None and image.saturation.warning is None, name
        assert not saturated(image).any() and image.saturation.found in (None, "NSATPIX"), name


def test_no_false_alarm_on_simulated_images_and_clipped_ones_found() -> None:
    """Coarse gains give many pixels of equal values, also near the largest one."""
    for gain in (1.0, 17.0, 250.0):
        for seed in range(15):
            image = with_saturation(image_of(exposure(seed, gain=gain)))
            assert image.saturation is not None and image.saturation.found is None
            assert not saturated(image).any()
    for clip_dn in (5500.0, 4095.0, 1000.0):
        pixels = exposure(1, clip_dn=clip_dn)
        for scale in (1.0, 1.4, 0.3333):
            image = with_saturation(image_of(pixels / scale))
            assert image.saturation is not None and image.saturation.found == "pixels"
            np.testing.assert_array_equal(saturated(image), pixels == clip_dn)


def test_what_is_doubtful_is_told() -> None:
    """Few equal pixels; clipping below the known level; and saturated pixels that the header counts and the image
    lacks.

    The request has the last word.
    """
    few = np.arange(128 * 128, dtype=float).reshape(128, 128)
    few[10, 10:16] = few.max()
    clipped = exposure(3, clip_dn=1000.0)
    # Many equal values below the level of a card are no saturation if brighter pixels reach the level.
    confirmed = np.where(exposure(3) > 2000, 4000.0, clipped)
    for image, options, marked, words in (
        (image_of(confirmed, SATURATE=4000.0), {}, 4000.0, ("may be saturated",)),
        (image_of(few), {}, np.inf, ("7 pixels", "--saturation")),
        (image_of(clipped, SATURATE=4000.0), {}, 1000.0, ("SATURATE",)),
        (image_of(exposure(4), TELESCOP="SDO/AIA", NSATPIX=12), {}, np.inf, ("NSATPIX counts 12 saturated",)),
        (image_of(clipped), {"requested_dn": 1e6}, np.inf, ()),
    ):
        seen = with_saturation(image, **options)
        np.testing.assert_array_equal(saturated(seen), image.pixels >= marked)
        assert seen.saturation is not None and (seen.saturation.found == "pixels") == (marked == 1000.0)
        assert (seen.saturation.warning is None) == (words == ())
        assert all(word in (seen.saturation.warning or "") for word in words)


def test_the_chance_is_the_poisson_probability() -> None:
    """Nine pixels have the largest value; below it, two pixels have each value. The image has several blocks of
    rows."""
    pixels = np.concatenate([np.repeat(np.arange(0.0, 2400.0), 2), np.full(9, 5000.0), np.full(791, -1.0)])
    pixels = np.random.default_rng(1).permutation(pixels).reshape(700, 8)
    valid = np.ones(pixels.shape, bool)
    top, count, chance = largest_value(pixels, valid)
    assert (top, count) == (5000.0, 9)
    assert chance == pytest.approx(sum(poisson.pmf(n, 2.0) for n in range(9, 60)), rel=1e-9)
    assert largest_value(pixels, pixels < 5000)[:2] == (2399.0, 2)
    pixels.ravel()[np.flatnonzero(pixels == 5000)[1:]] = -1.0
    assert largest_value(pixels, valid) == (5000.0, 1, pytest.approx(1 - poisson.pmf(0, 2.0), rel=1e-12))
    assert largest_value(np.full((20, 20), 3.0), np.ones((20, 20), bool)) == (3.0, 400, 1.0)


LEVELS = [
    ({"SATURATE": 4000.0}, "DN", {}, 4000.0, "SATURATE"),
    ({"DSATVAL": 3000.0, "SATURATE": 4000.0, "DATASAT": 200}, "DN", {}, 3000.0, "DSATVAL"),
    ({"SAT_THR": 3000.0}, "DN/s", {}, 3000.0, "SAT_THR"),
    ({}, "DN/s", {"instrument_dn": 4000.0}, 2000.0, "instrument file"),
    ({}, "DN / s", {"requested_dn": 4000.0, "instrument_dn": 100.0}, 2000.0, "request"),
    ({"SATURATE": 3000.0}, "DN / s", {"requested_dn": 4000.0}, 2000.0, "request"),
    ({"TELESCOP": "SDO/AIA", "NSATPIX": 0}, None, {}, 15000.0, "NSATPIX"),
    ({"TELESCOP": "OTHER", "NSATPIX": 0}, None, {}, None, None),
    ({}, "DN", {}, None, None),
]


def test_the_level_and_its_source() -> None:
    pixels = exposure(2)
    for cards, unit, given, level, source in LEVELS:
        image = with_saturation(image_of(pixels, unit, **cards), **given)
        assert image.saturation is not None
        assert (image.saturation.level, image.saturation.found) == (level, source), (cards, given)
        np.testing.assert_array_equal(saturated(image), pixels >= (np.inf if level is None else level))


# --- the level of the gain mode ---

MODES = """
[detector.gain_modes.combined]
saturation_dn = 400.0
basis = "assumed"
[detector.gain_modes.high-only]
saturation_dn = 300.0
basis = "assumed"
"""


def instrument(name: str = "small") -> Instrument:
    return parse_instrument(SMALL_INSTRUMENT + MODES, name)


MODE_LEVELS = [
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": "combined"}, None, 200.0, "instrument file"),
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": " High-only "}, None, 150.0, "instrument file"),
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": "low-only"}, None, None, None),
    ({"DETECTOR": "HRI_EUV"}, None, None, None),
    ({"DETECTOR": "HRI_EUV", "GAINCOMB": "combined"}, 500.0, 250.0, "request"),
]


def test_the_level_is_that_of_the_gain_mode_in_the_header(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image is in DN/s, from an exposure of 2 s."""
    monkeypatch.setattr(observation, "load_instrument", instrument)
    for number, (cards, saturation_dn, level, source) in enumerate(MODE_LEVELS):
        path = tmp_path / f"{number}.fits"
        write_image(path, **cards)
        image = observation.read_observation(path, LIMITS, saturation_dn=saturation_dn)
        assert image.saturation is not None
        assert (image.saturation.level, image.saturation.found) == (level, source), cards
        assert image.valid.all() == (level is None)
