"""``DELETE /v1/bulk/{id}``: what stays, and what no longer counts in the quota. The jobs of a run
cannot be stopped one by one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from tests.conftest import write_image
from tests.service.api.bulk.conftest import FEW
from tests.service.conftest import refusal, upload, work_through_bulks
from tests.service.keyed import Keyed
from workers.bulk.runs import keep_turns
from workers.catalogue.access import Scope
from workers.catalogue.bulks import Bulks
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


def started(client: TestClient, images: list[str], psf: str, **more: object) -> str:
    answer = client.post("/v1/bulk", json={"images": images, "psf_id": psf, "parameters": FEW, **more})
    assert answer.status_code == 202, answer.text
    return f"/v1/bulk/{answer.json()['id']}"


def used(service: Keyed, owner: str = "ann") -> int:
    return service.catalogue.owners.usage(owner, 0).used_bytes


def test_the_run_goes_and_its_products_and_files_stay(
    service: Keyed, ann: TestClient, image: str, psf: str, work: Callable[[], None], out: Path
) -> None:
    before = used(service)
    run = started(ann, [image], psf, output={"folder": str(out)})
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
    again = started(ann, [image], psf)
    work()
    assert again != run and ann.get(again).json()["images"]["reused"] == 1, "the product is still known"


def test_a_run_at_work_is_cancelled_first(ann: TestClient, image: str, psf: str) -> None:
    run = started(ann, [image], psf)
    detail = refusal(ann.delete(run), 409, "wrong-phase")
    assert "RUNNING" in detail and "cancel it first" in detail
    assert ann.get(run).json()["phase"] == "RUNNING"
    assert ann.post(f"{run}/cancel").status_code == 200
    assert ann.delete(run[: len("/v1/bulk/") + 12]).status_code == 204, "the first digits are enough"
    assert ann.get(run).status_code == 404


def test_turns_are_jobs_that_only_their_run_can_stop(
    service: Keyed, ann: TestClient, settings: Settings, image: str, psf: str
) -> None:
    before = used(service)
    run = started(ann, [image], psf)
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
    assert ann.post(f"{run}/pause").status_code == 200 and ann.delete(run).status_code == 204
    row = service.catalogue.jobs.get(turn["id"])
    assert row is not None and row.phase == Phase.ABORTED
    keep_turns(service.catalogue, settings)
    assert ann.get("/v1/jobs").json()["items"] == [] and used(service) == before


def test_a_run_deleted_while_its_image_is_at_work_leaves_nothing_open(
    service: Keyed,
    ann: TestClient,
    psf: str,
    work: Callable[[], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for number in range(4):
        write_image(tmp_path / f"{number}.fits", seed=number)
    run = started(ann, [upload(ann, tmp_path / f"{number}.fits") for number in range(4)], psf)
    real = Bulks.finish
    deleted: list[bool] = []

    def finish(*told: object, **values: object) -> bool:
        if not deleted:
            deleted.append(True)
            assert ann.post(f"{run}/pause").status_code == 200 and ann.delete(run).status_code == 204
        return real(*told, **values)  # type: ignore[arg-type]

    monkeypatch.setattr(Bulks, "finish", finish)
    work()
    assert service.catalogue.jobs.of_kind("bulk") == []
    assert len(ann.get("/v1/products").json()["items"]) in (1, 2), "the images that were at work"
