"""An image without a known PSF: the error says what can be done, for people and for programs."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names
from service.local import LocalService
from tests.conftest import write_image, write_psf

AIA = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171, "CDELT1": 0.6, "CDELT2": 0.6}


def upload(local: LocalService, path: Path, size: int, **cards: object) -> str:
    """A PSF of its own size, so that each has an id of its own."""
    write_psf(path, size=size)
    fits.writeto(path, fits.getdata(path), fits.Header(cards), overwrite=True)
    return str(local.upload_psf(path, name=path.stem)["id"])


def refused(local: LocalService, tmp_path: Path, **cards: object) -> DataError:
    write_image(tmp_path / "i.fits", **cards)
    with pytest.raises(DataError) as caught:
        local.deconvolve(tmp_path / "i.fits")
    assert caught.value.code == "no-psf-for-instrument"
    return caught.value


def test_the_error_names_instruments_psfs_and_ways(local: LocalService, tmp_path: Path) -> None:
    of_telescope = upload(local, tmp_path / "aia.fits", 32, INSTRUME="AIA_3", WAVELNTH=171)
    of_scale = upload(local, tmp_path / "scale.fits", 34, CDELT1=0.602)
    upload(local, tmp_path / "channel.fits", 36, INSTRUME="AIA_2", WAVELNTH=193, CDELT1=0.6)
    upload(local, tmp_path / "far.fits", 38, INSTRUME="XRT", CDELT1=1.03)
    error = refused(local, tmp_path, **AIA)
    assert [psf["id"] for psf in error.fields["psfs"]] == [of_scale, of_telescope], "newest first"
    assert [psf["same"] for psf in error.fields["psfs"]] == [["plate_scale"], ["telescope", "channel"]]
    instruments = {one["name"]: one for one in error.fields["instruments"]}
    assert set(instruments) == set(instrument_names())
    assert instruments["aia_171"]["same"] == ["telescope", "channel", "plate_scale"]
    assert instruments["hri_euv"]["same"] == []
    assert [way["way"] for way in error.fields["ways"]] == ["name", "upload", "fit"]
    for named in (of_telescope, "aia_171", "SDO/AIA AIA_3", "171 angstrom"):
        assert named in error.message
    assert "hri_euv" not in error.message


def test_an_image_without_any_name_gets_the_ways_too(local: LocalService, tmp_path: Path) -> None:
    error = refused(local, tmp_path, TELESCOP="")
    assert error.fields["psfs"] == [] and len(error.fields["ways"]) == 3
    assert "an unnamed instrument" in error.message


def test_the_fields_survive_the_way_between_processes(local: LocalService, tmp_path: Path) -> None:
    error = refused(local, tmp_path, **AIA)
    again = pickle.loads(pickle.dumps(error))
    assert (again.code, again.message, again.fields) == (error.code, error.message, error.fields)
