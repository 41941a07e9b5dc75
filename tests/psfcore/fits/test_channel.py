"""An image takes a PSF of its own telescope, channel and filter, unless told otherwise."""

from __future__ import annotations

from pathlib import Path

import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.channel import channel_differences, check_channel
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.psf import Psf
from tests.psfcore.conftest import LIMITS, gaussian, make_psf

AIA = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171, "WAVEUNIT": "angstrom"}
HRI = {"TELESCOP": "SOLO/EUI/HRI_EUV", "INSTRUME": "EUI", "DETECTOR": "HRI_EUV", "WAVELNTH": 174}


def psf_with(**changes: object) -> Psf:
    return make_psf(gaussian(32, 1.0), **changes)


AIA_171 = psf_with(name="aia_171", instrument="aia_171", wavelength_angstrom=171.07)
EUVI = {"TELESCOP": "STEREO", "INSTRUME": "SECCHI", "DETECTOR": "EUVI", "WAVELNTH": 171}
XRT = {"TELESCOP": "HINODE", "INSTRUME": "XRT", "WAVELNTH": 171}
HRI_EUV = psf_with(name="hri_euv", instrument="hri_euv", wavelength_angstrom=174.0)


def test_a_psf_of_the_images_channel_is_taken_in_silence() -> None:
    for psf, cards in (
        (AIA_171, AIA),
        (AIA_171, {**AIA, "WAVELNTH": 17.1, "WAVEUNIT": "nm"}),
        (HRI_EUV, HRI),
        (HRI_EUV, {"DETECTOR": "HRI_EUV"}),
        (psf_with(wavelength_angstrom=171.0, cards={"TELESCOP": "SDO"}), AIA),
        (psf_with(wavelength_angstrom=171.0, cards={"INSTRUME": "AIA", "FILTER": "THIN"}), AIA),
    ):
        assert check_channel(psf, fits.Header(cards)) is None, (psf.name, cards)
    # The closest pair of channels in use, 193 (AIA) and 195 (EIT), is 1.03 % apart.
    eit = psf_with(wavelength_angstrom=195.0)
    assert channel_differences(eit, fits.Header({"WAVELNTH": 193}))
    assert not channel_differences(eit, fits.Header({"WAVELNTH": 195.12}))
    assert not channel_differences(psf_with(wavelength_angstrom=303.78), fits.Header({"WAVELNTH": 304}))
    for psf, cards, silent in (
        (psf_with(), AIA, "PSF without"),
        (AIA_171, {"TELESCOP": "SDO/AIA"}, "image without"),
        (psf_with(), {}, "PSF and image without"),
        (AIA_171, {"WAVELNTH": 171, "WAVEUNIT": "furlong"}, "image without"),
    ):
        warning = check_channel(psf, fits.Header(cards))
        assert warning is not None and silent in warning


OTHER_CHANNELS = [
    (AIA_171, {**AIA, "WAVELNTH": 193}, "193 angstrom"),
    (AIA_171, HRI, "hri_euv"),
    (HRI_EUV, AIA, "aia_171"),
    (HRI_EUV, {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3"}, "SDO/AIA AIA_3"),
    (AIA_171, {**AIA, "TELESCOP": "TRACE"}, "trace_171"),
    (HRI_EUV, {**HRI, "DETECTOR": "FSI"}, "FSI"),
    (psf_with(wavelength_angstrom=171.0, cards={"TELESCOP": "TRACE"}), AIA, "TRACE"),
    (psf_with(wavelength_angstrom=171.0, cards={"INSTRUME": "AIA_2"}), AIA, "AIA_2"),
    (
        psf_with(wavelength_angstrom=174.0, cards={"FILTER": "Al_174_1"}),
        {**HRI, "FILTER": "Al_174_2"},
        "FILTER",
    ),
    (psf_with(cards={"OBSRVTRY": "STEREO_A"}), {**EUVI, "OBSRVTRY": "STEREO_B"}, "STEREO_B"),
    (psf_with(cards={"EC_FW1_": "Be_thin"}), {**XRT, "EC_FW1_": "Al_poly"}, "EC_FW1_"),
]


def test_another_channel_is_refused_unless_told(subtests: pytest.Subtests) -> None:
    for psf, cards, named in OTHER_CHANNELS:
        with subtests.test(named), pytest.raises(DataError, match=f"^channel-mismatch: .*{named}"):
            check_channel(psf, fits.Header(cards))
        warning = check_channel(psf, fits.Header(cards), other_channel=True)
        assert warning is not None and named in warning and "another channel" in warning


def test_a_psf_file_says_what_it_is_for(tmp_path: Path) -> None:
    header = fits.Header({**AIA, "FILTER": "thin"})
    fits.PrimaryHDU(gaussian(32, 1.0).astype("f4"), header).writeto(tmp_path / "other.fits")
    other = read_psf(tmp_path / "other.fits", LIMITS)
    assert other.cards == {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "FILTER": "thin"}
    assert other.wavelength_angstrom == 171.0
    write_psf(tmp_path / "own.fits", AIA_171)
    own = read_psf(tmp_path / "own.fits", LIMITS)
    assert own.cards == {} and own.instrument == "aia_171", "INSTRUME is the name of the instrument file here"
    assert check_channel(own, fits.Header(AIA)) is None
