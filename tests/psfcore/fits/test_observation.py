"""Files as archives and people have them: each kind of card, unit, frame and pixel is understood in one place."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

import heliopsf
from psfcore.deconvolve.assess.quality import QualityBit
from psfcore.deconvolve.doubts import pixel_warnings
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.frame import UNIT, frame_of
from psfcore.fits.header import instant, observed_at, read_summary
from psfcore.fits.observation import check_exposure_of_sun, observation_of, read_observation
from psfcore.fits.units import parse_unit
from psfcore.image import MaskBit
from psfcore.psf import Psf
from psfcore.psf_sampling import frame_warnings, psf_for_image, with_scale

LIMITS = FitsLimits(max_pixels=10**6)
AIA = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171, "WAVEUNIT": "angstrom"}
AIA |= {"EXPTIME": 2.0, "BUNIT": "DN", "LVL_NUM": 1.0}
SCALE = {"CDELT1": 0.599489, "CDELT2": 0.599489, "CUNIT1": "arcsec", "CUNIT2": "arcsec"}


def scene(size: int = 64) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Light without two equal values, far from saturation."""
    y, x = np.indices((size, size))
    return 200 + 100 * np.sin(x / 5) * np.cos(y / 7) + 0.001 * (x + size * y)


def header(**cards: Any) -> fits.Header:
    return fits.Header({key: value for key, value in (AIA | SCALE | cards).items() if value is not None})


def gaussian(offset_px: float = 0.0, size: int = 33, **fields: Any) -> Psf:
    y, x = np.indices((size, size)) - size // 2
    kernel = np.exp(-((x - offset_px) ** 2 + y**2) / 2) + 1e-3 * (x == 3) * (y == 7)
    known: dict[str, Any] = {"name": "p", "version": "1", "instrument": "aia_171", "status": "user"}
    return Psf(kernel=kernel / kernel.sum(), **known | {"plate_scale_arcsec": 0.599489} | fields)


def test_a_level_in_dn_masks_the_same_pixels_in_every_unit() -> None:
    pixels = scene()
    pixels[:2, :9] = 15000.0 + np.arange(18).reshape(2, 9)
    rates = ["DN/s", "DN / (pix s)", "DN s-1", "dn/sec", "DN pix-1 s-1", "counts/second", "ct/s", "adu / s"]
    in_units = dict.fromkeys([*rates, "DN/s/pixel"], 2.0) | {
        "DN/ms": 2000.0,
        "counts / pixel": 1.0,
        "ADU": 1.0,
    }
    for unit, in_unit in in_units.items():
        image = observation_of(pixels / in_unit, header(BUNIT=unit), saturation_dn=15000.0)
        assert np.count_nonzero(image.mask) == 18, unit
    of_aia = observation_of(pixels, header(BUNIT=None, PIXLUNIT="DN"), saturation_dn=15000.0)
    assert of_aia.unit == "DN" and np.count_nonzero(of_aia.mask) == 18
    xrt = {"TELESCOP": "HINODE", "INSTRUME": "XRT", "BUNIT": None}
    assert observation_of(pixels, header(**xrt)).unit == "DN"
    assert observation_of(pixels, header(**xrt, HISTORY="XRT_RENORMALIZE v2 run")).unit == "DN/s"


def test_units_that_are_no_counts() -> None:
    for text in ("W m-2 sr-1", "photon", "electron/s", "log(DN)", "DN s^", "10**99999 DN", "?"):
        assert parse_unit(text).kind == "other", text
    for unit in ("photon", "erg"):
        with pytest.raises(DataError) as caught:
            observation_of(scene(), header(BUNIT=unit), saturation_dn=100.0)
        assert caught.value.code == "saturation-unit" and unit in caught.value.message
    with pytest.raises(DataError, match="no-exposure"):
        observation_of(scene(), header(BUNIT="DN/s", EXPTIME=None), saturation_dn=100.0)


def test_the_plate_scale_is_that_of_the_world_coordinates() -> None:
    """For every way to write a matrix, beside astropy."""
    angle = math.radians(20)
    cosine, sine = math.cos(angle), math.sin(angle)
    pc = {"PC1_1": cosine, "PC1_2": -sine, "PC2_1": sine, "PC2_2": cosine}
    in_degrees = {"CUNIT1": "deg", "CUNIT2": "deg", "CDELT1": 1.0, "CDELT2": 1.0}
    none = {"CDELT1": None, "CDELT2": None}
    cd = {key.replace("PC", "CD"): 0.6 * value for key, value in pc.items()}
    for cards in (
        {},
        {"CROTA2": 30.0, "CDELT2": 0.7},
        {"CDELT2": -0.6},
        pc,
        in_degrees | {key: value * 1.665e-4 for key, value in pc.items()},
        none | cd,
        {"PC1_2": 0.1},
    ):
        given = header(**cards, CTYPE1="HPLN-TAN", CTYPE2="HPLT-TAN", CRVAL1=0.0, CRVAL2=0.0)
        matrix = WCS(given).pixel_scale_matrix * 3600
        assert frame_of(given).scale_arcsec == pytest.approx(np.hypot(*matrix)), cards
    assert frame_of(header(CUNIT1="m", CUNIT2="m")).scale_arcsec == (None, None)


def test_turns_and_flips_against_the_detector() -> None:
    half = {"CROTA2": 180.0}
    for cards, turn_deg, flipped, exact in (
        ({"CROTA2": 0.02}, 0.02, False, True),
        (half, 180.0, False, True),
        # The spacecraft was rolled, not the image.
        (half | {"SAT_ROT": 179.9, "INST_ROT": 0.1}, 0.0, False, True),
        ({"SAT_ROT": 90.0, "INST_ROT": 0.0}, -90.0, False, True),  # turned to north by a quarter turn
        ({"CROTA2": 30.0}, 30.0, False, False),
        ({"CDELT2": -0.599489}, 0.0, True, True),
        ({"TELESCOP": "SOLO/EUI/HRI_EUV", "CROTA": 33.0, "CROTA2": 33.0}, 0.0, False, True),
        # A rolled STEREO, and the same image after it was turned to north.
        ({"TELESCOP": "STEREO", "DETECTOR": "EUVI", "SC_ROLL": 3.7, "CROTA2": 3.7}, 0.0, False, True),
        ({"TELESCOP": "STEREO", "DETECTOR": "EUVI", "SC_ROLL": 3.7, "CROTA2": 0.0}, -3.7, False, False),
    ):
        frame = frame_of(header(**cards))
        assert frame.turn_deg == pytest.approx(turn_deg, abs=1e-6) and frame.flipped is flipped, cards
        assert (frame.quarter_turns is not None) is exact, cards
        assert (frame.quarter_turns == UNIT) is (exact and abs(turn_deg) < 1 and not flipped), cards


def test_a_turned_image_gets_the_psf_turned_with_it() -> None:
    """A point that an image shows after a turn or a flip is the point of the detector, turned or flipped."""
    for size in (32, 33):
        psf = gaussian(size=size)
        point = np.zeros((size, size))
        point[size // 2, size // 2] = 1
        for cards, move in (
            ({"CROTA2": 180.0}, lambda plane: plane[::-1, ::-1]),
            ({"CDELT1": -0.599489}, lambda plane: plane[:, ::-1]),
            ({"CDELT2": -0.599489}, lambda plane: plane[::-1]),
            ({"CROTA2": -90.0}, lambda plane: np.rot90(plane, -1)),
            ({"CROTA2": 90.0}, lambda plane: np.rot90(plane, 1)),
        ):
            turned = psf_for_image(psf, header(**cards))
            whole = np.pad(psf.kernel, (0, 1 - size % 2))  # odd, so that numpy turns about the centre
            assert np.array_equal(turned.kernel, move(whole)[:size, :size]), (size, cards)
            assert turned.kernel[size // 2, size // 2] == psf.kernel[size // 2, size // 2]
            assert "turned" in turned.version
    user = gaussian(instrument=None)
    assert psf_for_image(user, header(CROTA2=180.0)) is user


def test_warnings_about_frames_and_scales() -> None:
    for psf, cards, codes in (
        (gaussian(), {}, []),
        (gaussian(), {"CROTA2": 180.0}, ["frame"]),
        (gaussian(), {"CROTA2": 30.0}, ["frame"]),
        (gaussian(instrument=None), {"CROTA2": 180.0}, ["frame"]),
        (gaussian(), {"LVL_NUM": 1.5}, ["interpolated"]),
        (gaussian(), {"CTYPE1": "CRLN-CEA", "CTYPE2": "CRLT-CEA"}, ["interpolated"]),
        (
            gaussian(),
            {"TELESCOP": "PROBA2", "INSTRUME": "SWAP", "LEVEL": 1, "P2_ROLL": 180.0},
            ["frame", "interpolated"],
        ),
        (gaussian(plate_scale_arcsec=None), {}, ["plate-scale"]),
        (gaussian(), {"CDELT1": None, "CDELT2": None}, ["plate-scale"]),
    ):
        assert list(frame_warnings(psf, header(**cards))) == codes, cards
    assert "level 1 image" in frame_warnings(gaussian(), header(LVL_NUM=1.5))["interpolated"]
    built = replace(gaussian(), turn_deg=30.0)
    assert "built at this angle" in frame_warnings(built, header(CROTA2=30.0))["frame"]
    for angle in (0.0, 31.0, 90.0):
        assert "another PSF" in frame_warnings(built, header(CROTA2=angle))["frame"], angle
        assert psf_for_image(built, header(CROTA2=angle)) is built
    binned = header(CDELT1=1.198978, CDELT2=1.198978)
    stated = with_scale(gaussian(plate_scale_arcsec=None), 0.599489)
    assert psf_for_image(stated, binned).plate_scale_arcsec == pytest.approx(1.198978)
    with pytest.raises(DataError, match="plate-scale-known"):
        with_scale(gaussian(), 1.0)


def test_a_psf_beside_its_pixel_is_refused() -> None:
    for offset_px in (0.0, 0.04, -0.04):
        gaussian(offset_px)
    for offset_px in (0.06, -0.1, 0.4, 0.5):
        with pytest.raises(DataError) as caught:
            gaussian(offset_px)
        assert caught.value.code == "psf-off-centre" and f"{offset_px:+.2f}" in caught.value.message


def test_every_use_of_a_psf_with_an_assumed_mesh_is_warned_about() -> None:
    """Also if the PSF comes from a file without provenance; not if it only is for images of such a telescope."""
    image = observation_of(scene(), header(TELESCOP="TRACE", INSTRUME="TRACE", WAVELNTH=171))
    for fields, warned in (
        ({"name": "trace_171", "instrument": "trace_171"}, True),
        ({"name": "published", "instrument": "trace_171"}, False),
        ({"name": "mine", "instrument": None, "provenance": {"mesh_basis": "assumed"}}, True),
    ):
        warnings = heliopsf.deconvolve(image, gaussian(**fields), steps=1, full=True).warnings
        assert ("assumed-mesh" in warnings) is warned, fields


def write(path: Path, *hdus: Any) -> Path:
    fits.HDUList(list(hdus)).writeto(path)
    return path


def test_which_image_of_a_file_is_read(tmp_path: Path) -> None:
    cube = write(tmp_path / "cube.fits", fits.PrimaryHDU(np.ones((3, 20, 20))), fits.ImageHDU(scene()))
    with pytest.raises(DataError) as caught:
        read_summary(cube, LIMITS)
    assert caught.value.code == "three-axes" and "hdus[0]" in caught.value.message
    assert read_observation(cube, LIMITS, hdu=1).pixels.shape == (64, 64)
    images = fits.ImageHDU(scene(), name="A"), fits.ImageHDU(2 * scene(), name="B")
    two = write(tmp_path / "two.fits", fits.PrimaryHDU(), *images)
    first, second = read_observation(two, LIMITS), read_observation(two, LIMITS, hdu=2)
    assert "HDU 1" in first.warnings["several-images"] and "2 (B)" in first.warnings["several-images"]
    assert np.array_equal(second.pixels, 2 * first.pixels) and second.warnings == {}
    for number in (0, 7):
        with pytest.raises(DataError):
            read_observation(two, LIMITS, hdu=number)


def test_the_mask_of_a_ccddata_file_is_used(tmp_path: Path) -> None:
    from astropy.nddata import CCDData, StdDevUncertainty

    mask = np.zeros((64, 64), bool)
    mask[5, 6:9] = True
    sigma = StdDevUncertainty(np.ones((64, 64)))
    data = CCDData(scene(), unit="adu", mask=mask, uncertainty=sigma, meta={"EXPTIME": 2.0})
    data.write(tmp_path / "ccd.fits")
    image = read_observation(tmp_path / "ccd.fits", LIMITS)
    assert np.array_equal(image.mask != 0, mask) and "several-images" not in image.warnings


def test_lost_blocks_are_masked_and_dark_pixels_are_not() -> None:
    for fill, cards in ((-32768, {"NMISSING": 9}), (-999, {}), (-7, {"BLANK": -7})):
        pixels = scene()
        pixels[20:23, 30:33] = fill
        image = observation_of(pixels, header(**cards))
        lost = (image.mask & MaskBit.LOST) != 0
        assert np.count_nonzero(lost) == 9 and lost[21, 31] and "9 pixels" in image.warnings["lost"], fill
        assert np.isnan(image.pixels[lost]).all()
    difference = np.random.default_rng(1).normal(0, 400, (64, 64))
    difference[3, 3] = -999
    assert "lost" not in observation_of(difference, header()).warnings
    pixels[9, 9] = 16000.5
    result = heliopsf.deconvolve(observation_of(pixels, header(NSATPIX=1, BLANK=-7)), gaussian(), full=True)
    assert [np.count_nonzero(result.quality & bit) for bit in (QualityBit.LOST, QualityBit.SATURATED)] == [
        9,
        1,
    ]


def test_rows_that_were_not_received_and_counts_that_wrapped() -> None:
    """Rows of zeros beside a faint corona, whose own zeros stay; and a peak that passes through all negative numbers of
    16 bits."""
    rng = np.random.default_rng(5)
    y, x = np.indices((256, 256))
    faint = rng.poisson(np.where(np.hypot(y - 128, x - 128) < 90, 300.0, 1.5)).astype(float)
    assert "zeros" not in observation_of(faint, header()).warnings
    cut = faint.copy()
    cut[200:] = 0
    image = observation_of(cut, header())
    np.testing.assert_array_equal(~image.finite, y >= 200)
    assert f"{56 * 256} pixels" in image.warnings["zeros"]
    for height in (45_000, 62_000, 64_000):
        peak = np.rint(
            800 + height * np.exp(-((x - 100) ** 2 + (y - 90) ** 2) / 60) + rng.normal(0, 3, x.shape)
        )
        stored = (peak + 32768) % 65536 - 32768
        image = observation_of(stored, header(), bits=16)
        np.testing.assert_array_equal(~image.finite, stored < 0)
        assert "wrapped" in image.warnings
    for quiet in (rng.normal(0, 400, (64, 64)).round(), rng.normal(20_000, 9_000, (64, 64)).round()):
        assert "wrapped" not in observation_of(quiet, header(), bits=16).warnings


def test_counts_of_saturated_pixels_that_make_no_sense() -> None:
    """A negative count, one that is larger than the image, and one of a whole exposure beside a quiet cut-out."""
    for count in (-1, -9999, 10**6):
        for cards in ({}, {"BUNIT": "DN/s", "EXPTIME": None}):
            image = observation_of(scene(), header(NSATPIX=count, **cards))
            assert image.valid.all(), (count, cards)
    quiet = np.random.default_rng(6).poisson(200, (128, 128)).astype(float)
    image = observation_of(quiet, header(BUNIT="DN/s", EXPTIME=None, NSATPIX=100))
    assert (
        image.valid.all()
        and image.saturation is not None
        and "exposure time" in str(image.saturation.warning)
    )


def test_planes_belong_to_the_first_image_and_all_are_told(tmp_path: Path) -> None:
    bad = np.zeros((64, 64), np.uint8)
    bad[3, 4] = 1
    errors = np.ones((64, 64))
    errors[5, 6] = np.inf
    hdus = [fits.PrimaryHDU(scene()), fits.ImageHDU(bad, name="DQF"), fits.ImageHDU(errors, name="ERR")]
    more = fits.ImageHDU(scene(), name="SECOND"), fits.ImageHDU(0 * bad, name="DQF")
    image = read_observation(write(tmp_path / "planes.fits", *hdus, *more), LIMITS)
    assert np.argwhere(image.mask).tolist() == [[3, 4], [5, 6]]
    assert all(name in image.warnings["quality-plane"] for name in ("DQF", "ERR"))


def test_what_is_no_exposure_is_refused() -> None:
    for cards, code in (
        ({"IMG_TYPE": "DARK"}, "not-an-exposure"),
        ({"IMGTYPE": "LED image"}, "not-an-exposure"),
        ({"ACS_ECLP": "YES"}, "not-an-exposure"),
        ({"ACS_SUNP": "NO"}, "not-an-exposure"),
        ({"ECLIPSE": 1}, "not-an-exposure"),
        ({"BUNIT": "log(DN)"}, "bad-unit"),
        ({"BUNIT": "sqrt(DN/s)"}, "bad-unit"),
        ({"HISTORY": "XRT_DECONVOLVE v2017: Deconvolved with XRT.PSF560.fits"}, "already-deconvolved"),
        ({"PRODID": "a"}, "already-deconvolved"),
        ({"PSFSUM": 1.0}, "psf-as-image"),
    ):
        with pytest.raises(DataError, match=code):
            check_exposure_of_sun(header(**cards))
    check_exposure_of_sun(header(IMG_TYPE="LIGHT", IMGTYPE="solar image", HISTORY="not deconvolved"))
    check_exposure_of_sun(header(ACS_ECLP="NO", ACS_SUNP="YES", ECLIPSE=0))


def test_times() -> None:
    for cards, text in (
        ({"DATE-OBS": "2013-03-10T06:00:00.34"}, "2013-03-10T06:00:00.34"),
        ({"DATE-OBS": "2013-03-10", "TIME-OBS": "06:00:01.2"}, "2013-03-10T06:00:01.2"),
        ({"DATE-OBS": "2016-12-31T23:59:60.5"}, "2017-01-01T00:00:00.500000"),
        ({"DATE-OBS": "2013-03-10T06:00:36", "TIMESYS": "TAI"}, "2013-03-10T06:00:01.000"),
        ({"DATE_OBS": "19/05/98", "TIME-OBS": "22:21:43"}, "1998-05-19T22:21:43"),
        ({"DATE-OBS": "2013-03-10T06:00:00", "TIMESYS": "UTC (TBR)"}, "2013-03-10T06:00:00"),
        ({}, None),
    ):
        assert observed_at(fits.Header(cards)) == text, cards
        assert text is None or instant(text) is not None
    assert instant("yesterday") is None and instant("9999-12-31T23:59:60") is None


def test_doubts_about_pixels() -> None:
    kernel = gaussian().kernel
    rng = np.random.default_rng(2)
    y, x = np.indices((128, 128))
    quiet = rng.normal(300 + 200 * np.sin(x / 9), 3)
    stars = quiet + 9000 * sum(np.exp(-((x - 8 - 16 * k) ** 2 + (y - 40) ** 2) / 2) for k in range(8))
    spikes = quiet.copy()
    spikes[40, 8::16] += 9000
    for pixels, cards, codes in (
        (quiet, {}, []),
        (stars, {}, []),
        (spikes, {}, ["spikes"]),
        (rng.normal(850, 20, (128, 128)), {}, ["bias"]),
        (rng.normal(850, 20, (128, 128)), {"BUNIT": "DN/s"}, []),
        (np.clip(np.rint(rng.normal(120, 60, (128, 128))), 0, 255), {}, ["picture"]),
        (np.log10(rng.uniform(30, 3000, (128, 128))), {}, ["scaled"]),
    ):
        assert list(pixel_warnings(observation_of(pixels, header(**cards)), kernel)) == codes


def test_a_difference_is_deconvolved_by_the_linear_method_and_its_light_is_kept() -> None:
    rng = np.random.default_rng(3)
    difference = rng.normal(0, 1, (64, 64))
    difference -= difference.mean() + 0.1
    psf = gaussian()
    result = heliopsf.deconvolve(
        observation_of(difference, header()), psf, method="linear", edges="symmetric"
    )
    assert result.flux_in == pytest.approx(difference.sum()) and result.flux_in < 0
    assert result.changes["ranges"] is not None and "negative-pixels" not in result.warnings
    faint = rng.normal(0.3, 1, (64, 64))
    with pytest.warns(UserWarning, match="linear"):
        clipped = heliopsf.deconvolve(observation_of(faint, header()), psf, iterations=2)
    assert clipped.flux_in == pytest.approx(faint.sum()) and clipped.flux_change_pct > 20
