"""Simulated files have the keywords of the instrument that they imitate."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.fits.header import FitsLimits
from psfcore.instruments.model import load_instrument
from psfcore.simulate.headers import HRI_EUV, imitated
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.transit import simulate
from psfcore.simulate.transit_files import write
from psfcore.transit.folder import read_transit
from tests.conftest import SMALL_INSTRUMENT

DIFFRACTION = np.zeros((32, 32))
DIFFRACTION[16, 16] = 1.0
LIMITS = FitsLimits(max_pixels=2**24)
# What level 1 files of AIA's 171 A channel say, as 2013-03-10T12:00:11.
REAL_AIA_171 = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171, "WAVEUNIT": "angstrom"}


def written(folder: Path, instrument: str) -> fits.Header:
    """The header of the first image of a transit that imitates an instrument."""
    of_instrument = imitated(load_instrument(instrument))
    plan = default_plan(3, 64, oversampling=1)
    write(simulate(plan, ScatterTruth(6.0, 2.5, 0.4), DIFFRACTION, 1, imitated=of_instrument), folder)
    return fits.getheader(folder / "000.fits")


def test_aia_171_has_the_keywords_of_aia(tmp_path: Path) -> None:
    header = written(tmp_path, "aia_171")
    assert {key: header[key] for key in REAL_AIA_171} == REAL_AIA_171
    assert header["CDELT1"] == header["CDELT2"] == pytest.approx(0.599489, abs=1e-6)
    assert header["EXPTIME"] == 5.0 and "T" in header["DATE-OBS"]
    assert not {"DETECTOR", "GAINCOMB", "XPOSURE", "DATE-BEG"} & set(header)
    assert "HRI" not in repr(header) and "SIMULATED" in header["ORIGIN"]
    assert fits.getheader(tmp_path / "diffraction.fits")["INSTRUME"] == "AIA_3"
    assert fits.getheader(tmp_path / "scenes/fov1.fits")["INSTRUME"] == "AIA_3"
    assert json.loads((tmp_path / "transit.json").read_text())["instrument"] == "aia_171"
    transit = read_transit(tmp_path, LIMITS)
    assert transit.instrument == "aia_171"
    assert [frame.exposure_s for frame in transit.frames] == [5.0, 1.8, 5.0]
    assert transit.plate_scale_arcsec == pytest.approx(0.599489, abs=1e-6)


def test_real_aia_files_have_these_keywords(shared: Path) -> None:
    header = fits.getheader(shared / "data/real/aia/aia_171_cutout_20130310.fits", 1)
    assert {key: header[key] for key in REAL_AIA_171} == REAL_AIA_171
    assert "DETECTOR" not in header and "GAINCOMB" not in header
    assert header["CDELT1"] == pytest.approx(
        imitated(load_instrument("aia_171")).plate_scale_arcsec, abs=1e-5
    )


def test_hri_euv_has_the_keywords_of_eui(tmp_path: Path) -> None:
    assert imitated(load_instrument("hri_euv")) == HRI_EUV
    header = written(tmp_path, "hri_euv")
    assert (header["TELESCOP"], header["INSTRUME"]) == ("SOLO/EUI/HRI_EUV", "EUI")
    assert (header["DETECTOR"], header["WAVELNTH"], header["CDELT1"]) == ("HRI_EUV", 174, 0.492)
    assert header["GAINCOMB"] == "combined" and header["XPOSURE"] == 5.0
    assert load_instrument("hri_euv").detector.plate_scale_arcsec == HRI_EUV.plate_scale_arcsec


def test_another_instrument_has_the_keywords_that_its_file_matches(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(SMALL_INSTRUMENT)
    instrument = load_instrument(path)
    header = written(tmp_path / "t", str(path))
    assert {key: header[key] for key in instrument.match} == instrument.match
    assert header["WAVELNTH"] == round(instrument.wavelength_angstrom)
    assert "HRI_EUV" not in repr(header)
