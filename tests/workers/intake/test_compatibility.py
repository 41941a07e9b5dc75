"""A request is refused for the ids in it and for what the headers of its image and its PSF say; deprecated PSFs."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from pydantic import TypeAdapter

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import read_summary
from tests.conftest import write_image, write_psf
from tests.in_process import InProcess
from tests.workers.psf_examples import OWNER, certify, deprecate, identity, psf, refused
from workers.bulk.image import statistics_of
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow, TransitRow
from workers.contract.identities import psf_identity
from workers.contract.kinds import JobRequest, Kind, ResultType
from workers.contract.psf_status import Pin, StatusChange
from workers.contract.requests import Parameters, PsfBuild, PsfFit, ResolvedDeconvolve
from workers.intake import requests
from workers.intake.compatibility import check, details_now, suits
from workers.intake.requests import Submission, resolve_by_ids
from workers.intake.uploads import Upload, image_row, uploaded_psf_row
from workers.versions import PsfStatus

AIA = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171, "CDELT1": 0.6, "CDELT2": 0.6}
XRT = {"TELESCOP": "HINODE", "INSTRUME": "XRT", "CDELT1": 1.03, "CDELT2": 1.03}
LIMITS = FitsLimits(max_pixels=512 * 512)
HRI = {"TELESCOP": "SOLO/EUI/HRI_EUV", "INSTRUME": "EUI", "DETECTOR": "HRI_EUV", "WAVELNTH": 174}
AT = {"DATE-BEG": "2024-03-01T12:00:00"}
BUILT = psf_identity(PsfBuild(instrument="hri_euv"))
FEW = {"steps": 1}


def summary_of(tmp_path: Path, **cards: Any) -> dict[str, Any]:
    (tmp_path / "i.fits").unlink(missing_ok=True)
    write_image(tmp_path / "i.fits", **cards)
    row: ImageRow = image_row(Upload("a", "0" * 64, 1, "i.fits"), read_summary(tmp_path / "i.fits", LIMITS))
    return dict(row.summary)


def psf_of(
    tmp_path: Path, *, instrument: str | None = None, channel: str | None = None, **cards: Any
) -> PsfRow:
    (tmp_path / "p.fits").unlink(missing_ok=True)
    write_psf(tmp_path / "p.fits")
    for key, value in cards.items():
        fits.setval(tmp_path / "p.fits", key, value=value)
    summary = read_summary(tmp_path / "p.fits", LIMITS)
    return uploaded_psf_row(
        Upload("a", "1" * 64, 1, "p.fits"), summary, instrument=instrument, channel=channel
    )


def request(**more: Any) -> ResolvedDeconvolve:
    return ResolvedDeconvolve(image_id="0" * 64, psf_id="1" * 64, **more)


def refusal(wanted: ResolvedDeconvolve, psf: PsfRow | None, header: dict[str, Any]) -> DataError:
    with pytest.raises(DataError) as caught:
        check(wanted, psf, header)
    return caught.value


COARSE = {"CDELT1": 2.4, "CDELT2": 2.4}
IN_OTHER_UNITS = {
    "WAVELNTH": 17.1, "WAVEUNIT": "nm", "CDELT1": 0.01, "CDELT2": 0.01, "CUNIT1": "arcmin", "CUNIT2": "arcmin",
}  # fmt: skip
# What the cards of an image and of a PSF say besides AIA, and the error of their deconvolution.
PAIRS: tuple[tuple[dict[str, Any], dict[str, Any], str], ...] = (
    ({}, {}, ""),
    (IN_OTHER_UNITS, {}, ""),
    ({"WAVELNTH": 193}, {}, "channel-mismatch"),
    ({"FILTER": "thin"}, {"FILTER": "thick"}, "channel-mismatch"),
    (COARSE, {"PSFNAME": "aia"}, "plate-scale-mismatch"),
)


def test_a_psf_suits_an_image_if_its_deconvolution_is_not_refused(tmp_path: Path) -> None:
    for of_image, of_psf, code in PAIRS:
        header, psf = summary_of(tmp_path, **(AIA | of_image)), psf_of(tmp_path, **(AIA | of_psf))
        assert suits(psf, header) is (code == ""), (of_image, of_psf)
        if code:
            assert refusal(request(), psf, header).code == code
        else:
            check(request(), psf, header)
    header = summary_of(tmp_path, **AIA)
    assert suits("aia_171", header) and not suits("aia_193", header)


def test_the_differences_of_the_channels_are_told_and_may_be_allowed(tmp_path: Path) -> None:
    header, psf = summary_of(tmp_path, **{**AIA, "WAVELNTH": 193}), psf_of(tmp_path, **AIA)
    assert refusal(request(), psf, header).fields["differences"] == [
        "the image is of aia_193, the PSF of aia_171",
        "the image is of 193 angstrom, the PSF of 171 angstrom",
    ]
    check(request(other_channel=True), psf, header)
    named = psf_of(tmp_path, instrument="aia_171", channel="171")
    assert refusal(request(), named, header).code == "channel-mismatch", "that an upload was given"
    whole = dataclasses.asdict(read_summary(tmp_path / "i.fits", LIMITS))
    assert refusal(request(), psf, whole).code == "channel-mismatch", "of a file that was not uploaded"


def test_a_psf_that_is_not_built_yet_is_compared_by_its_instrument_file(tmp_path: Path) -> None:
    wanted = request(psf_recipe=PsfBuild(instrument="hri_euv"))
    error = refusal(wanted, None, summary_of(tmp_path, **XRT))
    assert error.fields["differences"] == ["the image is of HINODE XRT, the PSF of hri_euv"]


def test_pixels_of_another_size_are_refused_with_the_factor_that_helps(tmp_path: Path) -> None:
    # The PSF names its instrument, and the image does not, so a whole multiple may be a coincidence.
    psf = psf_of(tmp_path, **AIA, PSFNAME="aia")
    matrix = {"CD1_1": 1.92, "CD1_2": -1.44, "CD2_1": 1.44, "CD2_2": 1.92}
    named = {key: AIA[key] for key in ("TELESCOP", "INSTRUME", "WAVELNTH")}
    odd = {"CDELT1": 1.5, "CDELT2": 1.5}
    for scale, factor in ((COARSE, 4), (matrix, 4), (odd, None)):
        error = refusal(request(other_channel=True), psf, summary_of(tmp_path, **(named | scale)))
        assert (error.code, error.fields["factor"]) == ("plate-scale-mismatch", factor), scale
        assert ("heliopsf psf rebin PSF --factor 4" in error.message) is (factor == 4)


def change(catalogue: Catalogue, status: PsfStatus, reason: str = "", **more: Any) -> None:
    catalogue.psfs.change(BUILT, OWNER, StatusChange(status=status, reason=reason, **more), "tester")


@pytest.fixture
def catalogue(local: InProcess, psf_file: Path, tmp_path: Path) -> Catalogue:
    """The catalogue of the local service holds the PSF that is built for HRI_EUV, with other pixels, as a certified
    PSF."""
    write_image(tmp_path / "i.fits", **HRI, **AT)
    found = local.catalogue
    uploaded = found.get(PsfRow, local.upload_psf(psf_file)["id"], OWNER)
    assert uploaded is not None
    row = psf("built", file_sha256=uploaded.file_sha256, bytes=uploaded.bytes, details=uploaded.details)
    row.id = BUILT
    found.add(row)
    change(found, PsfStatus.CERTIFIED, version="1.0.0")
    return found


def test_a_deprecated_psf_is_not_chosen(local: InProcess, catalogue: Catalogue, tmp_path: Path) -> None:
    deconvolve = partial(local.deconvolve, tmp_path / "i.fits", **FEW)
    assert deconvolve()["psf_id"] == BUILT
    change(catalogue, PsfStatus.DEPRECATED, "wrong mesh")
    message = refused("psf-deprecated", deconvolve)
    assert "hri_euv" in message and "reason: wrong mesh" in message and f"--psf {BUILT[:12]}" in message
    catalogue.add(psf("better"))
    certify(catalogue, "better", "2.0.0")
    change(catalogue, PsfStatus.DEPRECATED, successor=identity("better"))
    deprecate(catalogue, "better")
    assert f"its successor is {identity('better')[:12]}" in refused("psf-deprecated", deconvolve)


def test_a_named_deprecated_psf_is_warned_of(local: InProcess, catalogue: Catalogue, tmp_path: Path) -> None:
    before = local.deconvolve(tmp_path / "i.fits", psf_id=BUILT, **FEW)
    assert "psf-deprecated" not in str(before["details"]["warnings"])
    change(catalogue, PsfStatus.DEPRECATED, "wrong mesh")
    again = local.deconvolve(tmp_path / "i.fits", psf_id=BUILT, **FEW)
    assert again["id"] == before["id"]
    assert [one["code"] for one in again["details"]["warnings"]].count("psf-deprecated") == 1
    row = catalogue.get(ProductRow, again["id"], OWNER)
    assert row is not None
    assert "psf-deprecated" in statistics_of(details_now(catalogue, row))["warnings"], "of a bulk run"
    product = local.deconvolve(tmp_path / "i.fits", tmp_path / "o.fits", psf_id=BUILT, steps=2)
    (warning,) = (one for one in product["details"]["warnings"] if one["code"] == "psf-deprecated")
    assert BUILT[:12] in warning["message"] and "wrong mesh" in warning["message"]
    history = "".join(str(line) for line in fits.getheader(tmp_path / "o.fits")["HISTORY"])
    assert "WARNING (psf-deprecated)" in history


def test_an_earlier_context_still_chooses_it(local: InProcess, catalogue: Catalogue, tmp_path: Path) -> None:
    catalogue.contexts.create("old", OWNER, "tester", pins=[Pin(psf_id=BUILT)])
    change(catalogue, PsfStatus.DEPRECATED)
    product = local.deconvolve(tmp_path / "i.fits", context="old", **FEW)
    assert product["psf_id"] == BUILT
    assert "psf-deprecated" in [one["code"] for one in product["details"]["warnings"]]


def test_a_fit_does_not_choose_a_diffraction_psf_that_was_deprecated(catalogue: Catalogue) -> None:
    build = PsfBuild(instrument="hri_euv", component="diffraction")
    row = psf("diffraction", kind="diffraction")
    row.id = psf_identity(build)
    catalogue.add(row)
    summary = {"instrument": "hri_euv", "known_psf": None, "noise": {"photon_gain_dn": 5, "read_noise_dn": 2}}
    transit_id = identity("transit")
    catalogue.add(
        TransitRow(owner=OWNER, id=transit_id, created_at=0, bytes=1, filename="t", summary=summary)
    )
    asked = TypeAdapter[JobRequest](JobRequest).validate_python(
        {"kind": "psf-fit", "parameters": PsfFit(transit_id=transit_id).model_dump()}
    )
    assert requests.resolve(asked, catalogue, OWNER)[0]["diffraction_recipe"] is not None
    for status, version in ((PsfStatus.CERTIFIED, "1.0.0"), (PsfStatus.DEPRECATED, None)):
        catalogue.psfs.change(
            row.id, OWNER, StatusChange(status=status, reason="blurred", version=version), "tester"
        )
    assert "known_psf" in refused("psf-deprecated", lambda: requests.resolve(asked, catalogue, OWNER))


# Ids in the parameters of any kind ------------------------------------------------------------------


UNKNOWN = "f" * 64


class Two(Parameters):
    """Parameters with two PSFs, and ids that may be missing."""

    psf_id: str
    other_psf_id: str | None = None
    reference_transit_id: str | None = None
    no_id: str = UNKNOWN


def resolved(catalogue: Catalogue, **parameters: str) -> Parameters:
    kind = Kind("two", task="", result=ResultType.REPORT, parameters=Two, resolved=Two)
    return resolve_by_ids(Submission(kind, Two(**parameters), catalogue, OWNER, ()))


def test_every_id_is_checked(catalogue: Catalogue) -> None:
    known = catalogue.add(psf("one"))[0].id
    assert resolved(catalogue, psf_id=known, other_psf_id=known) == Two(psf_id=known, other_psf_id=known)
    for name, code in (("other_psf_id", "no-such-psf"), ("reference_transit_id", "no-such-transit")):
        with pytest.raises(DataError, match=UNKNOWN) as caught:
            resolved(catalogue, **({"psf_id": known} | {name: UNKNOWN}))
        assert caught.value.code == code
