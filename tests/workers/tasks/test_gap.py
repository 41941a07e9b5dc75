"""The job gap-diagnose: from an archive of a transit to a report, page, picture and a corrected PSF."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.gap.verdict.calibration import COVERAGE, shipped_calibration
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from service.client.http import ServiceError
from tests.gap_files import EDGE_GLOW, REACH_PX, answer_at_once, small_reach, write_gap
from tests.html_page import check_stands_alone
from tests.in_process import InProcess
from tests.psfcore.gap import small_gaps
from workers.catalogue.tables import DEFAULT_OWNER, PsfRow, ReportRow
from workers.contract.identities import corrected_psf_identity
from workers.contract.requests import GapDiagnose
from workers.settings import Settings
from workers.tasks import gap as gap_task


@pytest.fixture(scope="module", autouse=True)
def _small_reach() -> Iterator[None]:
    with small_reach():
        yield


def service_in(folder: Path, gap_effects: str = "") -> InProcess:
    settings = {"data_dir": folder, "database_url": None, "broker_url": "filesystem://"}
    return InProcess(Settings(**settings, gap_effects=gap_effects))


@pytest.fixture(scope="module")
def transit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gap(tmp_path_factory.mktemp("simulated") / "transit", offset_dn=small_gaps.OFFSET_DN)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[InProcess]:
    local = service_in(tmp_path_factory.mktemp("service") / "data")
    yield local
    local.close()


def ids(service: InProcess, table: type[PsfRow] | type[ReportRow]) -> list[str]:
    return [row.id for row in service.catalogue.page(table, owner=DEFAULT_OWNER, limit=200)]


@pytest.fixture(scope="module")
def made(service: InProcess, transit: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The job round a diagnosis that was made before, and all of its files; `heliopsf gap`'s tests do it for real."""
    out = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(gap_task, "diagnose", lambda transit, **how: small_gaps.found())
        row = service.diagnose_gap(
            transit, out / "r.json", page=out / "r.html", preview=out / "r.png", seed=3
        )
    return {"row": row, "json": json.loads((out / "r.json").read_text()), "folder": out}


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The arguments of each diagnosis, whose result is replaced by a prepared one."""
    monkeypatch.setattr("psfcore.gap.report.plot.gap_png", lambda found, report: b"\x89PNG")
    return answer_at_once(monkeypatch, small_gaps.found())


def test_the_report_names_the_effect_its_size_and_the_inputs(made: dict[str, Any]) -> None:
    row, report = made["row"], made["json"]
    assert row["kind"] == "gap" and row["html"] == f"/v1/reports/{row['id']}/page"
    assert report["schema"] == "gap/3" and report["verdict"] == "attributed"
    assert report["answer"] == row["details"]["answer"] == ["dark_offset"]
    offset = report["effects"][0]["parameters"]["offset"]
    assert offset["value"] == pytest.approx(small_gaps.OFFSET_DN, abs=4 * offset["sigma"])
    assert row["details"]["sentence"] == report["sentence"]
    assert row["details"]["strongest_axis"] == report["where"][0]["axis"]
    provenance = report["provenance"]
    assert provenance["seed"] == provenance["parameters"]["seed"] == 3
    assert provenance["parameters"]["coverage"] == COVERAGE <= report["level"]
    assert row["details"]["lines"] == report["lines"]
    assert provenance["started_from_psf"] is None and provenance["added_effects"] == {}
    assert {"numpy", "scipy", "numba", "astropy"} <= set(provenance["libraries"])
    assert report["inputs_sha256"] == small_gaps.with_offset().sha256
    html = (made["folder"] / "r.html").read_text("utf-8")
    check_stands_alone(html)
    assert "A light leak" not in html and "The dark level subtracted from every readout is wrong." in html
    assert (made["folder"] / "r.png").read_bytes().startswith(b"\x89PNG")


def test_the_corrected_psf_is_a_draft_that_names_its_parents(
    service: InProcess, made: dict[str, Any]
) -> None:
    row, report = made["row"], made["json"]
    psf = service.get(f"/v1/psfs/{row['details']['corrected_psf_id']}")
    assert psf["id"] == corrected_psf_identity(row["id"]) == report["provenance"]["corrected_psf_id"]
    assert psf["status"] == "draft" and psf["origin"] == "fitted"
    assert psf["name"] == "hri_euv-gap-corrected" and psf["version"].startswith("0.1.0+")
    details = psf["details"]
    assert details["parents"] == {"transit": row["transit_id"], "report": row["id"]}
    made_by = details["provenance"]
    assert made_by["parents"] == details["parents"] and made_by["effects"] == ["dark_offset"]
    assert made_by["effect_parameters"]["offset"] == report["effects"][0]["parameters"]["offset"]
    assert made_by["gap_before_pct"] == report["gap"]["rms_pct"]
    assert made_by["gap_after_pct"] == report["gap"]["after_pct"]
    assert made_by["inputs_sha256"] == report["inputs_sha256"]
    # The rest of the light lies beyond the small reach of these tests.
    assert details["shape"] == [REACH_PX, REACH_PX] and 0.9 < details["sum"] < 1
    # Questions about it can be answered at once.
    assert service.ask(psf["id"], "encircled", radius=10.0)


def test_an_identical_request_gets_the_existing_report_and_a_rerun_adds_no_second_psf(
    service: InProcess, made: dict[str, Any], transit: Path, asked: list[dict[str, Any]]
) -> None:
    again = service.diagnose_gap(transit, seed=3)
    assert asked == [] and again["id"] == made["row"]["id"]
    assert again["created_at"] == made["row"]["created_at"]
    psf_id = again["details"]["corrected_psf_id"]
    psfs, reports = ids(service, PsfRow), ids(service, ReportRow)
    assert psfs.count(psf_id) == reports.count(again["id"]) == 1
    report = service.get(service.wait(service.submit("rerun", of="psf", id=psf_id))["result"])
    assert [how["seed"] for how in asked] == [3]
    assert report["kind"] == "rerun" and report["about_id"] == psf_id
    assert ids(service, PsfRow) == psfs and len(ids(service, ReportRow)) == len(reports) + 1


def test_a_job_whose_worker_was_lost_after_the_psf_was_saved_gives_one_result(
    service: InProcess, transit: Path, asked: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    report_result, calls = gap_task.report_result, []

    def once_lost(*given: Any, **how: Any) -> Any:
        calls.append(1)
        if len(calls) == 1:
            raise ConnectionError("the database is away")
        return report_result(*given, **how)

    monkeypatch.setattr(gap_task, "report_result", once_lost)
    row = service.diagnose_gap(transit, seed=4)
    assert len(calls) == len(asked) == 2
    assert ids(service, PsfRow).count(row["details"]["corrected_psf_id"]) == 1


def test_a_given_psf_is_the_start_of_the_fit_and_a_parent_of_the_corrected_psf(
    service: InProcess, made: dict[str, Any], transit: Path, asked: list[dict[str, Any]], tmp_path: Path
) -> None:
    parent = made["row"]["details"]["corrected_psf_id"]
    row = service.diagnose_gap(transit, tmp_path / "r.json", psf_id=parent)
    (how,) = asked
    assert how["shape"] is SOFTENED_POWER_LAW and how["seed"] == 1
    values = SOFTENED_POWER_LAW.values(np.array(how["start"]))
    fitted = made["json"]["psf"]["with_answer"]
    assert values["b_px"] == pytest.approx(fitted["b_px"]["value"], rel=1e-6)
    psf = service.get(f"/v1/psfs/{row['details']['corrected_psf_id']}")
    assert psf["details"]["parents"]["psf"] == parent == row["details"]["psf_id"]
    started = json.loads((tmp_path / "r.json").read_text())["provenance"]["started_from_psf"]
    assert started == {"name": "hri_euv-gap-corrected", "version": f"0.1.0+{parent[:8]}", "id": parent}


def test_a_request_chooses_coverage(service: InProcess, transit: Path, asked: list[dict[str, Any]]) -> None:
    before = ids(service, PsfRow)
    row = service.diagnose_gap(transit, coverage=0.5, correct=False)
    service.diagnose_gap(transit, seed=11, correct=False)
    assert [how["coverage"] for how in asked] == [0.5, COVERAGE]
    assert row["details"]["corrected_psf_id"] is None and ids(service, PsfRow) == before
    for coverage in (0.5, 0.95):
        assert coverage <= shipped_calibration().level(coverage) <= 1, (
            "the shipped calibration has enough cases"
        )
    for coverage in (0.49, 0.96):
        with pytest.raises(ValueError, match="coverage"):
            GapDiagnose(transit_id="a" * 64, coverage=coverage)


def test_a_psf_that_was_not_fitted(service: InProcess, transit: Path, asked: list[dict[str, Any]]) -> None:
    unfitted = service.upload_psf(transit / "diffraction.fits")["id"]
    with pytest.raises(ServiceError) as caught:
        service.diagnose_gap(transit, psf_id=unfitted)
    assert caught.value.code == "psf-not-fitted" and asked == []


def test_a_worker_runs_no_named_effects(transit: Path, asked: list[dict[str, Any]], tmp_path: Path) -> None:
    """A job was submitted with added effects that the worker does not have."""
    (tmp_path / "mine.py").write_text("raise SystemExit('code that a job named was run')")
    taken = service_in(tmp_path / "data", str(tmp_path / "mine.py"))
    job = taken.submit("gap-diagnose", transit_id=taken.upload_transit(transit)["id"])
    taken.close()
    worker = service_in(tmp_path / "data")
    with pytest.raises(ServiceError, match="submit the job again") as caught:
        worker.wait(job)
    assert caught.value.code == "effects-changed" and asked == []
    worker.close()


def test_changed_files_of_effects(transit: Path, asked: list[dict[str, Any]], tmp_path: Path) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(EDGE_GLOW)
    local = service_in(tmp_path / "data", str(mine))
    first = local.diagnose_gap(transit, tmp_path / "r.json", correct=False)
    assert asked[0]["library"][-1].name == "edge_glow" and len(asked[0]["library"]) > 10
    provenance = json.loads((tmp_path / "r.json").read_text())["provenance"]
    assert list(provenance["added_effects"]) == [str(mine)] == provenance["parameters"]["added_effects"]
    assert local.diagnose_gap(transit, correct=False)["id"] == first["id"] and len(asked) == 1
    mine.write_text(EDGE_GLOW.replace("5.0", "6.0"))
    assert local.diagnose_gap(transit, correct=False)["id"] != first["id"] and len(asked) == 2
    waiting = local.submit("gap-diagnose", transit_id=local.upload_transit(transit)["id"])
    mine.write_text(EDGE_GLOW.replace("5.0", "7.0"))
    with pytest.raises(ServiceError, match="submit the job again") as caught:
        local.wait(waiting)
    assert caught.value.code == "effects-changed" and len(asked) == 2
    mine.unlink()
    with pytest.raises(DataError) as gone:
        local.submit("gap-diagnose", transit_id=local.upload_transit(transit)["id"])
    assert gone.value.code == "bad-effects"
    local.close()


def test_a_diagnosis_is_valid_without_its_corrected_psf(
    service: InProcess,
    transit: Path,
    asked: list[dict[str, Any]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def cannot(*_: object, **__: object) -> None:
        raise DataError("bad-effects", "effects of mine: no image of a point")

    monkeypatch.setattr("workers.tasks.gap.corrected_psf", cannot)
    found = service.diagnose_gap(transit, tmp_path / "r.json", page=tmp_path / "r.html", seed=12)
    assert found["details"]["corrected_psf_id"] is None
    told = json.loads((tmp_path / "r.json").read_text())["cautions"]
    assert told[-1].endswith("could not be made: effects of mine: no image of a point")
    assert "no image of a point" in (tmp_path / "r.html").read_text()
