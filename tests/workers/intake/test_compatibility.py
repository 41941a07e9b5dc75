"""A request is refused for what the headers of its image and its PSF say, with the error that the job would have."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import read_summary
from tests.conftest import write_image, write_psf
from workers.catalogue.tables import ImageRow, PsfRow
from workers.contract.requests import PsfBuild, ResolvedDeconvolve, RichardsonLucy
from workers.intake.compatibility import check, suits
from workers.intake.uploads import image_row, uploaded_psf_row

AIA = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171, "CDELT1": 0.6, "CDELT2": 0.6}
XRT = {"TELESCOP": "HINODE", "INSTRUME": "XRT", "CDELT1": 1.03, "CDELT2": 1.03}
LIMITS = FitsLimits(max_pixels=512 * 512)


def summary_of(tmp_path: Path, **cards: Any) -> dict[str, Any]:
    (tmp_path / "i.fits").unlink(missing_ok=True)
    write_image(tmp_path / "i.fits", **cards)
    row: ImageRow = image_row("a", "0" * 64, 1, "i.fits", read_summary(tmp_path / "i.fits", LIMITS))
    return dict(row.summary)


def psf_of(
    tmp_path: Path, *, instrument: str | None = None, channel: str | None = None, **cards: Any
) -> PsfRow:
    (tmp_path / "p.fits").unlink(missing_ok=True)
    write_psf(tmp_path / "p.fits")
    for key, value in cards.items():
        fits.setval(tmp_path / "p.fits", key, value=value)
    summary = read_summary(tmp_path / "p.fits", LIMITS)
    return uploaded_psf_row("a", "1" * 64, 1, "p.fits", summary, instrument=instrument, channel=channel)


def request(**more: Any) -> ResolvedDeconvolve:
    return ResolvedDeconvolve(image_id="0" * 64, psf_id="1" * 64, method=RichardsonLucy(), **more)


def refusal(wanted: ResolvedDeconvolve, psf: PsfRow | None, header: dict[str, Any]) -> DataError:
    with pytest.raises(DataError) as caught:
        check(wanted, psf, header)
    return caught.value


def test_another_channel_is_refused_unless_the_request_allows_it(tmp_path: Path) -> None:
    header, psf = summary_of(tmp_path, **{**AIA, "WAVELNTH": 193}), psf_of(tmp_path, **AIA)
    error = refusal(request(), psf, header)
    assert error.code == "channel-mismatch"
    assert error.fields["differences"] == [
        "the image is of aia_193, the PSF of aia_171",
        "the image is of 193 angstrom, the PSF of 171 angstrom",
    ]
    check(request(other_channel=True), psf, header)
    named = psf_of(tmp_path, instrument="aia_171", channel="171")
    assert refusal(request(), named, header).code == "channel-mismatch", "that an upload was given"


def test_a_psf_suits_an_image_if_its_deconvolution_is_not_refused(tmp_path: Path) -> None:
    header = summary_of(tmp_path, **AIA)
    for psf, fits_it in (
        (psf_of(tmp_path, **AIA), True),
        (psf_of(tmp_path, **{**AIA, "WAVELNTH": 193}), False),
        (psf_of(tmp_path, **{**AIA, "CDELT1": 0.25, "CDELT2": 0.25}), False),
        ("aia_171", True),
        ("aia_193", False),
    ):
        assert suits(psf, header) is fits_it


def test_another_filter_is_refused_and_the_units_of_the_cards_count(tmp_path: Path) -> None:
    header, psf = summary_of(tmp_path, **AIA, FILTER="thin"), psf_of(tmp_path, **AIA, FILTER="thick")
    assert "FILTER" in refusal(request(), psf, header).message
    in_nm = {**AIA, "WAVELNTH": 17.1, "WAVEUNIT": "nm"}
    in_arcmin = {"CDELT1": 0.01, "CDELT2": 0.01, "CUNIT1": "arcmin", "CUNIT2": "arcmin"}
    check(request(), psf_of(tmp_path, **AIA), summary_of(tmp_path, **(in_nm | in_arcmin)))


def test_a_psf_that_is_not_built_yet_is_compared_by_its_instrument_file(tmp_path: Path) -> None:
    wanted = request(psf_recipe=PsfBuild(instrument="hri_euv"))
    error = refusal(wanted, None, summary_of(tmp_path, **XRT))
    assert error.fields["differences"] == ["the image is of HINODE XRT, the PSF of hri_euv"]


def test_pixels_of_another_size_are_refused_with_the_factor_that_helps(tmp_path: Path) -> None:
    # The PSF names its instrument, and the image does not, so a whole multiple may be a coincidence.
    psf = psf_of(tmp_path, **AIA, PSFNAME="aia")
    header = summary_of(tmp_path, **{**AIA, "CDELT1": 2.4, "CDELT2": 2.4})
    error = refusal(request(other_channel=True), psf, header)
    assert (error.code, error.fields["factor"]) == ("plate-scale-mismatch", 4)
    assert "heliopsf psf rebin PSF --factor 4" in error.message
    matrix = {"CD1_1": 1.92, "CD1_2": -1.44, "CD2_1": 1.44, "CD2_2": 1.92}
    named = {key: AIA[key] for key in ("TELESCOP", "INSTRUME", "WAVELNTH")}
    error = refusal(request(other_channel=True), psf, summary_of(tmp_path, **named, **matrix))
    assert (error.code, error.fields["factor"]) == ("plate-scale-mismatch", 4)
    odd = {**header, "cards": {**header["cards"], "CDELT1": 1.5, "CDELT2": 1.5}}
    assert refusal(request(other_channel=True), psf, odd).fields["factor"] is None


def test_the_summary_of_a_file_that_was_not_uploaded_is_checked_too(tmp_path: Path) -> None:
    write_image(tmp_path / "i.fits", **{**AIA, "WAVELNTH": 193})
    header = dataclasses.asdict(read_summary(tmp_path / "i.fits", LIMITS))
    assert refusal(request(), psf_of(tmp_path, **AIA), header).code == "channel-mismatch"
