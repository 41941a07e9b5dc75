"""Deprecated PSFs: never chosen by the service itself, and named in a warning wherever they are used."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from pydantic import TypeAdapter

from psfcore.errors import DataError
from tests.conftest import write_image
from tests.in_process import InProcess
from tests.workers.psf_examples import OWNER, identity, psf
from workers.bulk.image import statistics_of
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.contexts import Pin
from workers.catalogue.psfs import StatusAsked
from workers.catalogue.tables import ProductRow, PsfRow, TransitRow
from workers.contract.identities import psf_identity
from workers.contract.kinds import JobRequest
from workers.contract.requests import PsfBuild, PsfFit
from workers.intake import requests
from workers.intake.compatibility import details_now
from workers.settings import Settings
from workers.versions import PsfStatus

HRI = {"TELESCOP": "SOLO/EUI/HRI_EUV", "INSTRUME": "EUI", "DETECTOR": "HRI_EUV", "WAVELNTH": 174}
AT = {"DATE-BEG": "2024-03-01T12:00:00"}
BUILT = psf_identity(PsfBuild(instrument="hri_euv"))
FEW = {"steps": 1}


def change(catalogue: Catalogue, status: PsfStatus, reason: str = "", **more: Any) -> None:
    catalogue.psfs.change(BUILT, OWNER, StatusAsked(status, reason, **more), "tester")


@pytest.fixture
def catalogue(local: InProcess, settings: Settings, psf_file: Path, tmp_path: Path) -> Iterator[Catalogue]:
    """The catalogue holds the PSF that is built for HRI_EUV, with other pixels, as a certified PSF."""
    write_image(tmp_path / "i.fits", **HRI, **AT)
    found = Catalogue(settings.catalogue_url)
    uploaded = found.get(PsfRow, local.upload_psf(psf_file)["id"], OWNER)
    assert uploaded is not None
    row = psf("built", file_sha256=uploaded.file_sha256, bytes=uploaded.bytes, details=uploaded.details)
    row.id = BUILT
    found.add(row)
    change(found, PsfStatus.CERTIFIED, version="1.0.0")
    yield found
    found.close()


def test_the_service_does_not_choose_a_psf_that_was_deprecated(
    local: InProcess, catalogue: Catalogue, tmp_path: Path
) -> None:
    assert local.deconvolve(tmp_path / "i.fits", **FEW)["psf_id"] == BUILT
    change(catalogue, PsfStatus.DEPRECATED, "wrong mesh")
    with pytest.raises(DataError) as caught:
        local.deconvolve(tmp_path / "i.fits", **FEW)
    assert caught.value.code == "psf-deprecated"
    for told in ("builds for hri_euv was deprecated", "reason: wrong mesh", f"--psf {BUILT[:12]}"):
        assert told in caught.value.message


def test_the_error_names_the_successor(local: InProcess, catalogue: Catalogue, tmp_path: Path) -> None:
    catalogue.add(psf("better"))
    asked = StatusAsked(PsfStatus.CERTIFIED, "", version="2.0.0", supersedes=(BUILT,))
    catalogue.psfs.change(identity("better"), OWNER, asked, "tester")
    changed = StatusAsked(PsfStatus.DEPRECATED, "also wrong")
    catalogue.psfs.change(identity("better"), OWNER, changed, "tester")
    with pytest.raises(DataError) as caught:
        local.deconvolve(tmp_path / "i.fits", **FEW)
    assert f"no reason was given) (its successor is {identity('better')[:12]})" in caught.value.message


def test_a_named_deprecated_psf_is_used_with_a_warning_also_for_a_product_made_before(
    local: InProcess, catalogue: Catalogue, tmp_path: Path
) -> None:
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


def test_a_context_of_an_earlier_moment_still_chooses_it(
    local: InProcess, catalogue: Catalogue, tmp_path: Path
) -> None:
    catalogue.contexts.create("old", OWNER, "tester", pins=[Pin(BUILT)])
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
        catalogue.psfs.change(row.id, OWNER, StatusAsked(status, "blurred", version=version), "tester")
    with pytest.raises(DataError) as caught:
        requests.resolve(asked, catalogue, OWNER)
    assert caught.value.code == "psf-deprecated" and "known_psf" in caught.value.message
