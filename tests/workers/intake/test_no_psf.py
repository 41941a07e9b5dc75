"""An image without a known PSF: the error says what can be done, for people and for programs."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names
from tests.conftest import write_image, write_psf
from tests.in_process import InProcess

# TELESCOP differs from that of the archive, so the image is not recognised as one of aia_171.
AIA = {"TELESCOP": "SDO", "INSTRUME": "AIA_3", "WAVELNTH": 171, "CDELT1": 0.6, "CDELT2": 0.6}


def upload(local: InProcess, path: Path, size: int, **cards: object) -> str:
    """A PSF of its own size, so that each has an id of its own."""
    write_psf(path, size=size)
    fits.writeto(path, fits.getdata(path), fits.Header(cards), overwrite=True)
    return str(local.upload_psf(path, name=path.stem)["id"])


def refused(local: InProcess, tmp_path: Path, **cards: object) -> DataError:
    tmp_path.mkdir(exist_ok=True)
    write_image(tmp_path / "i.fits", **cards)
    with pytest.raises(DataError) as caught:
        local.deconvolve(tmp_path / "i.fits")
    assert caught.value.code == "no-psf-for-instrument"
    return caught.value


def test_the_error_names_instruments_psfs_and_ways(local: InProcess, tmp_path: Path) -> None:
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
    for named in (of_telescope, "aia_171", "SDO AIA_3", "171 angstrom"):
        assert named in error.message
    assert "hri_euv" not in error.message


def test_what_does_not_agree_is_told_too(local: InProcess, tmp_path: Path) -> None:
    upload(local, tmp_path / "aia.fits", 32, INSTRUME="AIA_3", CDELT1=0.6)
    error = refused(local, tmp_path, **{**AIA, "WAVELNTH": 1600, "CDELT1": 2.4, "CDELT2": 2.4})
    instruments = {one["name"]: one["told"] for one in error.fields["instruments"]}
    other_scale = "another pixel scale (0.599489, not 2.4 arcsec)"
    assert instruments["aia_171"] == (
        f"same telescope, but another channel (171, not 1600 Å) and {other_scale}"
    )
    assert [psf["told"] for psf in error.fields["psfs"]] == [
        "same telescope, but another pixel scale (0.6, not 2.4 arcsec)"
    ]
    error = refused(local, tmp_path / "again", **{**AIA, "WAVELNTH": 1600})
    instruments = {one["name"]: one["told"] for one in error.fields["instruments"]}
    assert instruments["aia_171"] == "same telescope and pixel scale, but another channel (171, not 1600 Å)"
    assert error.fields["image"] == "SDO AIA_3"


def test_an_image_without_any_name_gets_the_ways_too(local: InProcess, tmp_path: Path) -> None:
    error = refused(local, tmp_path, TELESCOP="")
    assert error.fields["psfs"] == [] and len(error.fields["ways"]) == 3
    assert "an unnamed instrument" in error.message


def test_instruments_that_agree_most_come_first_also_in_another_process(
    local: InProcess, tmp_path: Path
) -> None:
    error = refused(local, tmp_path, **AIA)
    names = [one["name"] for one in error.fields["instruments"]]
    assert names[:4] == ["aia_171", "aia_94", "aia_131", "aia_193"]
    again = pickle.loads(pickle.dumps(error))
    assert (again.code, again.message, again.fields) == (error.code, error.message, error.fields)


PUBLISHED: tuple[tuple[dict[str, object], str, str], ...] = (
    ({"TELESCOP": "HINODE", "INSTRUME": "XRT"}, "upload", "SolarSoft"),
    ({"TELESCOP": "TRACE", "INSTRUME": "TRACE", "WAVE_LEN": "171"}, "fit", "Venus of 2004"),
    ({"OBSRVTRY": "STEREO_B", "INSTRUME": "SECCHI", "DETECTOR": "EUVI", "WAVELNTH": 171}, "fit", "2007"),
    ({"TELESCOP": "PROBA2", "INSTRUME": "SWAP", "WAVELNTH": 174}, "fit", "covers a part of the Sun"),
)


def test_the_ways_name_what_is_published_for_the_telescope(local: InProcess, tmp_path: Path) -> None:
    for number, (cards, way, published) in enumerate(PUBLISHED):
        error = refused(local, tmp_path / str(number), **cards)
        texts = {one["way"]: one["text"] for one in error.fields["ways"]}
        assert [name for name, text in texts.items() if published in text] == [way]
