"""``DELETE /v1/bulk/{id}``: what stays, and what no longer counts in the quota. The jobs of a run
cannot be stopped one by one.
Products of bulk runs in the archive's own layout."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.conftest import write_image
from tests.service.api.bulk.conftest import FEW, failures, results, started
from tests.service.conftest import refusal, upload, work_through_bulks
from tests.service.keyed import Keyed
from workers.bulk.runs import keep_turns
from workers.catalogue.access import Scope
from workers.catalogue.tables import ProductRow
from workers.contract.jobs import Phase
from workers.settings import Settings


@pytest.fixture
def ann(service: Keyed) -> TestClient:
    return service.client("ann")


@pytest.fixture
def work(settings: Settings, service: Keyed) -> Callable[[], None]:
    """Runs turns until no bulk run is at work, and deletes the turns that have ended."""

    def run() -> None:
        work_through_bulks(settings)
        keep_turns(service.catalogue, settings)

    return run


@pytest.fixture
def image(ann: TestClient, image_file: Path) -> str:
    return upload(ann, image_file)


@pytest.fixture
def psf(ann: TestClient, psf_file: Path) -> str:
    return upload(ann, psf_file, "/v1/psfs")


def begun(client: TestClient, images: list[str], psf: str, **more: object) -> str:
    answer = client.post("/v1/bulk", json={"images": images, "psf_id": psf, "parameters": FEW, **more})
    assert answer.status_code == 202, answer.text
    return f"/v1/bulk/{answer.json()['id']}"


def used(service: Keyed, owner: str = "ann") -> int:
    return service.catalogue.quotas.usage(owner, 0).used_bytes


def test_the_run_goes_and_its_products_and_files_stay(
    service: Keyed, ann: TestClient, image: str, psf: str, work: Callable[[], None], out: Path
) -> None:
    before = used(service)
    run = begun(ann, [image], psf, output={"folder": str(out)})
    work()
    assert ann.get(run).json()["phase"] == "COMPLETED"
    (product,) = ann.get("/v1/products").json()["items"]
    (file,) = out.iterdir()
    answer = ann.delete(run)
    assert (answer.status_code, answer.content) == (204, b"")
    row = service.catalogue.get(ProductRow, product["id"], "ann")
    assert row is not None and used(service) == before + row.bytes
    for part in ("file", "preview", "thumbnail"):
        assert ann.get(product[part]).status_code == 200
    assert file.read_bytes() == ann.get(product["file"]).content
    assert ann.get("/v1/bulk").json()["items"] == []
    for address in ("", "/results", "/failures", "/events"):
        assert ann.get(f"{run}{address}").json()["type"] == "urn:heliopsf:no-such-bulk"
    assert ann.delete(run).status_code == 404, "it is deleted once"
    again = begun(ann, [image], psf)
    work()
    assert again != run and ann.get(again).json()["images"]["reused"] == 1, "the product is still known"


def test_turns_are_jobs_that_only_their_run_can_stop(
    service: Keyed, ann: TestClient, settings: Settings, image: str, psf: str
) -> None:
    before = used(service)
    run = begun(ann, [image], psf)
    for _ in range(2):
        keep_turns(service.catalogue, settings)
        (turn,) = ann.get("/v1/jobs").json()["items"]
    assert (turn["kind"], turn["queue"]) == ("bulk", "bulk") and turn["parameters"]["bulk_id"] in run
    submitter, here = service.client("ann", Scope.READ, Scope.SUBMIT), f"/uws/jobs/{turn['id']}"
    assert ann.get(here).status_code == ann.get("/uws/jobs").status_code == 200
    assert run in refusal(submitter.delete(f"/v1/jobs/{turn['id']}"), 409, "job-of-bulk")
    for address, form in (
        (here, {"ACTION": "DELETE"}),
        (f"{here}/phase", {"PHASE": "ABORT"}),
        (f"{here}/executionduration", {"EXECUTIONDURATION": "1"}),
        (f"{here}/destruction", {"DESTRUCTION": "2001-01-01T00:00:00"}),
    ):
        answer = submitter.post(address, data=form, follow_redirects=False)
        assert answer.status_code == 409 and run in answer.text, address
    assert submitter.delete(here, follow_redirects=False).status_code == 409
    row = service.catalogue.jobs.get(turn["id"])
    assert row is not None and not row.cancel_requested and row.phase == Phase.QUEUED
    refusal(ann.delete(run), 409, "wrong-phase")
    assert ann.post(f"{run}/pause").status_code == 200 and ann.delete(run).status_code == 204
    row = service.catalogue.jobs.get(turn["id"])
    assert row is not None and row.phase == Phase.ABORTED
    keep_turns(service.catalogue, settings)
    assert ann.get("/v1/jobs").json()["items"] == [] and used(service) == before


# --- products in the archive's own layout ----------------------------------------------------------------


Work = Callable[[], None]
LAYOUT = "{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits"


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Files of equal names in the folders of two years; the third has no date."""
    root = tmp_path / "archive"
    for number, year in enumerate((2020, 2021, 2022)):
        (root / str(year)).mkdir(parents=True)
        date = {} if year == 2022 else {"DATE-BEG": f"{year}-03-01T12:00:00"}
        write_image(root / str(year) / "one.fits", seed=number, **date)
    return root


def done(api: TestClient, work: Work, **request: Any) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """The results of a run, and the codes of its failures by file."""
    bulk = started(api, **request)
    work()
    return results(api, bulk), {one["source"]: one["error"]["code"] for one in failures(api, bulk)}


@pytest.mark.parametrize("only", [False, True])
def test_products_have_the_names_of_the_layout(
    api: TestClient, work: Work, archive: Path, out: Path, psf_id: str, only: bool
) -> None:
    output = {"folder": str(out), "layout": LAYOUT, "only": only}
    request = {"files": [{"glob": f"{archive}/*/*"}], "psf_id": psf_id, "output": output}
    lines, failed = done(api, work, **request)
    wanted = [out / f"TEST/{year}/03/01/one_deconvolved.fits" for year in (2020, 2021)]
    assert [line["output"] for line in lines] == list(map(str, wanted))
    assert failed == {f"{archive}/2022/one.fits": "no-output-name"}
    assert [hashlib.sha256(path.read_bytes()).hexdigest() for path in wanted] == [
        line["sha256"] for line in lines
    ]
    assert sorted(path for path in out.rglob("*") if path.is_file()) == wanted, "nothing else is left"
    again, _ = done(api, work, **request)
    assert [line["reused"] for line in again] == [True, True]
    assert [line["output"] for line in again] == list(map(str, wanted))


def test_the_second_image_with_a_name_fails_and_replaces_nothing(
    api: TestClient, work: Work, archive: Path, out: Path, psf_id: str
) -> None:
    output = {"folder": str(out), "layout": "{stem}.fits", "only": True}
    request = {"files": [{"glob": f"{archive}/*/*"}], "psf_id": psf_id, "output": output}
    told = api.post("/v1/bulk/estimate", json={"parameters": FEW, **request}).json()
    assert [one["error"]["code"] for one in told["refused"]] == ["output-name-taken"] * 2
    (line,), failed = done(api, work, **request)
    assert set(failed.values()) == {"output-name-taken"} and len(failed) == 2
    assert hashlib.sha256((out / "one.fits").read_bytes()).hexdigest() == line["sha256"]
    assert [path.name for path in out.iterdir()] == ["one.fits"]


def test_a_file_of_somebody_else_is_not_replaced(
    api: TestClient, work: Work, archive: Path, out: Path, psf_id: str
) -> None:
    out.mkdir()
    (out / "one.fits").write_text("a letter")
    output = {"folder": str(out), "layout": "{stem}.fits"}
    lines, failed = done(api, work, files=[{"glob": f"{archive}/2020/*"}], psf_id=psf_id, output=output)
    assert lines == [] and list(failed.values()) == ["output-name-taken"]
    assert (out / "one.fits").read_text() == "a letter"
