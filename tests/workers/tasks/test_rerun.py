"""Lineages and reruns of products and PSFs."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.deconvolve import run
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.images import read_plane
from tests.conftest import SMALL_INSTRUMENT, write_image
from tests.in_process import InProcess
from tests.workers.databases import add
from tests.workers.psf_examples import OWNER, identity, product, psf, refused
from workers import lineage
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ProductRow, PsfRow, ReportRow
from workers.contract import identities
from workers.lineage import Ancestor, made_by

ON_TRANSIT = {"transit_id": "1" * 64, "seed": 5}
LIMITS = FitsLimits(max_pixels=2**24)
MASKED = (
    SMALL_INSTRUMENT + '\n[mount]\nbasis = "drawing"\nmask_image = { file = "mask.png", width_mm = 4.0 }\n'
)


@pytest.fixture
def made(local: InProcess, psf_file: Path, tmp_path: Path) -> dict[str, Any]:
    """A product of an uploaded PSF."""
    psf_id, noise = local.upload_psf(psf_file)["id"], {"noise": (6.0, 2.0), "error_draws": 4}
    write_image(tmp_path / "image.fits", shape=(64, 64))
    return local.deconvolve(tmp_path / "image.fits", tmp_path / "first.fits", psf_id=psf_id, steps=3, **noise)


def again(local: InProcess, of: str, identity: str, output: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The description of a rerun's report and its JSON."""
    row = local.get(local.wait(local.submit("rerun", of=of, id=identity))["result"])
    local.download(row["file"], output)
    return row, json.loads(output.read_text())


def test_a_product_made_again_is_the_same(local: InProcess, made: dict[str, Any], tmp_path: Path) -> None:
    before = local.get(f"/v1/products/{made['id']}")
    row, report = again(local, "product", made["id"], tmp_path / "r.json")
    assert (row["kind"], row["about_id"], row["transit_id"]) == ("rerun", made["id"], None)
    assert row["details"]["same"] is True and row["details"]["largest_relative_difference"] == 0.0
    assert set(report["arrays"]) == {"IMAGE", "QUALITY", "ERROR"}
    for array in report["arrays"].values():
        assert array["same"] and array["sha256"][0] == array["sha256"][1]
    assert report["again"]["id"] == made["id"] and report["parameters"]["method"]["steps"] == 3
    assert report["first"]["job_id"] != report["again"]["job_id"]
    local.download(row["output"], tmp_path / "again.fits")
    np.testing.assert_array_equal(
        read_plane(tmp_path / "first.fits", LIMITS), read_plane(tmp_path / "again.fits", LIMITS)
    )
    assert local.get(f"/v1/products/{made['id']}") == before
    assert len(local.catalogue.page(ProductRow, owner=OWNER, limit=10)) == 1
    second, _ = again(local, "product", made["id"], tmp_path / "2.json")
    reports = local.catalogue.page(ReportRow, owner=OWNER, limit=10, about_id=made["id"])
    assert [one.id for one in reports] == [second["id"], row["id"]], "every rerun is a job of its own"


def test_a_product_of_an_earlier_version(local: InProcess, made: dict[str, Any], tmp_path: Path) -> None:
    """The earlier version gave the product another id. Deconvolving the image again makes the new product."""
    old_id = "f" * 64
    row = local.catalogue.get(ProductRow, made["id"], OWNER)
    assert row is not None
    columns = {column.name: getattr(row, column.name) for column in ProductRow.__table__.columns}
    add(local.catalogue, ProductRow(**(columns | {"id": old_id})))
    _, report = again(local, "product", old_id, tmp_path / "r.json")
    assert report["same"] and (report["id"], report["again"]["id"]) == (old_id, made["id"])


def test_a_rerun_finds_software_that_gives_other_values(
    local: InProcess, made: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = run.write_image
    first = read_plane(tmp_path / "first.fits", LIMITS)

    def off(path: Path, image: Any, **how: Any) -> None:
        how["pixels"] = how["pixels"].copy()
        how["pixels"][5, 7] += 0.25 * np.nanmax(first)
        real(path, image, **how)

    monkeypatch.setattr(run, "write_image", off)
    row, report = again(local, "product", made["id"], tmp_path / "r.json")
    assert row["details"]["same"] is False and row["details"]["same_file"] is False
    assert report["arrays"]["IMAGE"]["largest_relative"] == pytest.approx(0.25, rel=1e-5)
    assert report["arrays"]["IMAGE"]["values_that_differ"] == 1 and report["arrays"]["ERROR"]["same"]
    assert "by at most 0.25 of the largest value, in IMAGE" in report["sentence"]
    assert report["first"]["file_sha256"] != report["again"]["file_sha256"]
    local.download(f"/v1/products/{made['id']}/file", tmp_path / "kept.fits")
    assert (tmp_path / "kept.fits").read_bytes() == (tmp_path / "first.fits").read_bytes()
    local.download(row["output"], tmp_path / "again.fits")
    assert read_plane(tmp_path / "again.fits", LIMITS)[5, 7] != first[5, 7]


def test_uploaded_and_unknown_psfs_cannot_be_rerun(local: InProcess, psf_file: Path) -> None:
    psf_id = local.upload_psf(psf_file)["id"]
    for of, named, code in (
        ("psf", psf_id, "not-made-here"),
        ("psf", "0" * 64, "no-such-psf"),
        ("product", "0" * 64, "no-such-product"),
    ):
        refused(code, partial(local.submit, "rerun", of=of, id=named))


def test_a_psf_built_with_a_mask_is_rerun_and_has_a_lineage(local: InProcess, tmp_path: Path) -> None:
    file, mask = tmp_path / "small.toml", tmp_path / "mask.fits"
    file.write_text(MASKED)
    y, x = np.indices((64, 64)) - 31.5
    fits.PrimaryHDU(((np.hypot(x, y) < 30) & (np.hypot(x, y) > 12)).astype("f4")).writeto(mask)
    built = local.build_psf(file, size=64, mask=mask)
    _, report = again(local, "psf", built["id"], tmp_path / "r.json")
    assert report["same"] and {"PSF", "AIRY"} <= set(report["arrays"]), report["arrays"].keys()
    assert report["again"]["id"] == built["id"]
    row = local.catalogue.get(PsfRow, built["id"], OWNER)
    assert row is not None and row.details["job_id"] != report["again"]["job_id"]
    told = lineage.lineage(local.catalogue, row)
    provenance = built["details"]["provenance"]
    assert told.made is not None and told.made.parameters == provenance["parameters"]
    assert told.made.libraries is not None and "numpy" in told.made.libraries
    assert types(told) == [
        ("instrument-file", provenance["instrument_file_sha256"], False),
        ("image", provenance["parameters"]["mask_id"], True),
    ]


def test_a_rerun_uses_the_instrument_file_of_the_first_run(
    local: InProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its text is in the PSF's file; that of today is not asked."""
    file = tmp_path / "aia_171.toml"
    file.write_text(SMALL_INSTRUMENT.replace('"small"', '"aia_171"'))
    monkeypatch.setattr(identities, "instrument_path", lambda name: file)
    built = local.build_psf("aia_171", size=64, component="airy")
    file.write_text(file.read_text() + "\n# changed\n")
    _, report = again(local, "psf", built["id"], tmp_path / "r.json")
    assert report["same"] and report["again"]["id"] == built["id"]


# Lineage of rows alone ------------------------------------------------------------------------------


def types(told: Ancestor) -> list[tuple[str, str, bool]]:
    return [(parent.type, parent.id, parent.there) for parent in told.parents]


def test_a_product_s_lineage_goes_back_to_what_was_uploaded(catalogue: Catalogue) -> None:
    fitted = {
        "transit_id": "1" * 64,
        "diffraction_psf_id": identity("diffraction"),
        "provenance": {"job_id": "j1"},
    }
    corrected = {
        "transit_id": "1" * 64,
        "parents": {"transit": "1" * 64, "report": "2" * 64, "psf": identity("fitted")},
        "diffraction_psf_id": identity("diffraction"),
        "provenance": {"software_version": "0.1.0", "algorithm_version": 1, "parameters": {"seed": 1}},
    }
    catalogue.add(
        psf("diffraction", kind="diffraction", details={"provenance": {"instrument_file_sha256": "3" * 64}})
    )
    catalogue.add(psf("fitted", origin="fitted", details=fitted))
    catalogue.add(psf("corrected", origin="fitted", details=corrected))
    row, _ = catalogue.add(product("x", "corrected", details={"job_id": "j3", "parameters": {"steps": 3}}))
    told = lineage.lineage(catalogue, row)
    assert types(told) == [("image", row.image_id, False), ("psf", identity("corrected"), True)]
    assert told.made is not None and (told.made.job_id, told.made.parameters) == ("j3", {"steps": 3})
    (_, top) = told.parents
    assert types(top) == [
        ("transit", "1" * 64, False),
        ("report", "2" * 64, False),
        ("psf", identity("fitted"), True),
        ("psf", identity("diffraction"), True),
    ]
    assert top.made is not None and (top.made.software_version, top.made.algorithm_version) == ("0.1.0", 1)
    first = top.parents[2]
    assert first.made is not None and first.made.job_id == "j1"
    assert [parent.type for parent in first.parents] == ["transit", "psf"]
    assert types(first.parents[1]) == [("instrument-file", "3" * 64, False)]
    assert top.parents[3].cut and top.parents[3].parents == [], "told above"


def test_a_circular_lineage_is_cut(catalogue: Catalogue) -> None:
    """Rows that name each other as parents cannot come to be; if they did, telling of them would end."""
    for name, other in (("egg", "hen"), ("hen", "egg")):
        catalogue.add(psf(name, origin="fitted", details={"parents": {"psf": identity(other)}}))
    for n in range(lineage.MOST_DEEP + 5):
        catalogue.add(psf(str(n), origin="fitted", details={"parents": {"psf": identity(str(n + 1))}}))

    def depth(name: str) -> tuple[int, bool]:
        row = catalogue.get(PsfRow, identity(name), OWNER)
        assert row is not None
        told, deep = lineage.lineage(catalogue, row), 0
        while told.parents:
            (told,) = told.parents
            deep += 1
        return deep, told.cut

    assert depth("egg") == (2, True)
    assert depth("0") == (lineage.MOST_DEEP, True)


def test_an_owner_s_lineage_shows_nothing_of_another_s(catalogue: Catalogue) -> None:
    catalogue.add(psf("secret", owner="somebody"))
    row, _ = catalogue.add(product("x", "secret"))
    assert types(lineage.lineage(catalogue, row))[1] == ("psf", identity("secret"), False)


MADE_BY: tuple[tuple[str, dict[str, Any]], ...] = (
    ("psf-build", {"origin": "built", "details": {"provenance": {"parameters": {"size": 64}}}}),
    ("psf-fit", {"origin": "fitted", "details": {"provenance": {"parameters": ON_TRANSIT}}}),
    (
        "gap-diagnose",
        {"origin": "fitted", "details": {"parents": {}, "provenance": {"parameters": ON_TRANSIT}}},
    ),
)


def test_the_job_that_made_a_psf(catalogue: Catalogue) -> None:
    for kind, values in MADE_BY:
        row, _ = catalogue.add(psf(kind, **values))
        job = made_by(catalogue, row)
        assert (job.of, job.id, job.kind) == ("psf", row.id, kind)
        said = values["details"]["provenance"]["parameters"]
        assert {name: job.parameters[name] for name in said} == said
        filled_in = kind == "psf-build" or job.parameters["diffraction_recipe"] is None
        assert filled_in, "what was not said is filled in"


def test_parameters_that_are_not_valid_or_not_recorded_are_refused(catalogue: Catalogue) -> None:
    row, _ = catalogue.add(product("x", "p", details={"parameters": {"image_id": "no id"}}))
    assert "image_id" in refused("parameters-outdated", partial(made_by, catalogue, row))
    row, _ = catalogue.add(product("y", "p"))
    refused("parameters-unknown", lambda: made_by(catalogue, row))
