"""``DELETE /v1/bulk/{id}``: who may delete which run, what stays, and what no longer counts in the quota."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from tests.conftest import write_image
from tests.service.conftest import upload
from tests.service.keyed import Keyed, keyed
from workers.bulk.turns import keep_turns
from workers.catalogue.access.keys import Scope
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.owners import counted_bytes
from workers.catalogue.tables import ProductRow
from workers.contract.phases import Phase
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings

FEW = {"method": {"name": "richardson-lucy", "steps": 2}}


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    return settings.model_copy(update={"bulk_output_roots": str(tmp_path / "out")})


@pytest.fixture
def service(settings: Settings) -> Iterator[Keyed]:
    with keyed(settings) as service:
        yield service


@pytest.fixture
def ann(service: Keyed) -> TestClient:
    return service.client("ann")


@pytest.fixture
def work(settings: Settings, service: Keyed) -> Callable[[], None]:
    """Runs turns until no bulk run is at work, and deletes the turns that have ended."""
    runner = Runner(settings, service.catalogue, Store(settings.data_dir))

    def run() -> None:
        while service.catalogue.bulks.at_work():
            keep_turns(service.catalogue, settings)
            for turn in service.catalogue.jobs.of_kind("bulk"):
                runner.run(turn.id)
        keep_turns(service.catalogue, settings)

    return run


def started(client: TestClient, images: list[str], psf: str, **more: object) -> str:
    asked = {"images": images, "psf_id": psf, "parameters": FEW, **more}
    answer = client.post("/v1/bulk", json=asked)
    assert answer.status_code == 202, answer.text
    return f"/v1/bulk/{answer.json()['id']}"


def used(service: Keyed, owner: str = "ann") -> int:
    assert service.catalogue.owners.recount() == []
    return service.catalogue.owners.usage(owner, 0).used_bytes


def test_the_run_goes_and_its_products_and_files_stay(
    service: Keyed,
    ann: TestClient,
    image_file: Path,
    psf_file: Path,
    work: Callable[[], None],
    tmp_path: Path,
) -> None:
    image, psf = upload(ann, image_file), upload(ann, psf_file, "/v1/psfs")
    before = used(service)
    run = started(ann, [image], psf, output={"folder": str(tmp_path / "out")})
    work()
    assert ann.get(run).json()["phase"] == "COMPLETED"
    (product,) = ann.get("/v1/products").json()["items"]
    (file,) = (tmp_path / "out").iterdir()
    answer = ann.delete(run)
    assert (answer.status_code, answer.content) == (204, b"")
    row = service.catalogue.get(ProductRow, product["id"], "ann")
    assert row is not None and used(service) == before + counted_bytes(row)
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


def test_a_run_at_work_is_cancelled_first(ann: TestClient, image_file: Path, psf_file: Path) -> None:
    run = started(ann, [upload(ann, image_file)], upload(ann, psf_file, "/v1/psfs"))
    refused = ann.delete(run)
    assert (refused.status_code, refused.json()["type"]) == (409, "urn:heliopsf:wrong-phase")
    assert refused.json()["detail"] == (
        "expected a bulk run in phase PAUSED, ERROR, COMPLETED or CANCELLED; this bulk run is in phase RUNNING: "
        "cancel it first"
    )
    assert ann.get(run).json()["phase"] == "RUNNING"
    assert ann.post(f"{run}/cancel").status_code == 200
    assert ann.delete(run[: len("/v1/bulk/") + 12]).status_code == 204, (
        "the first digits of the id are enough"
    )
    assert ann.get(run).status_code == 404


def test_the_turns_of_a_deleted_run_stop(
    service: Keyed, ann: TestClient, settings: Settings, image_file: Path, psf_file: Path
) -> None:
    image, psf = upload(ann, image_file), upload(ann, psf_file, "/v1/psfs")
    before = used(service)
    run = started(ann, [image], psf)
    keep_turns(service.catalogue, settings)
    assert ann.post(f"{run}/pause").status_code == 200 and ann.delete(run).status_code == 204
    (turn,) = service.catalogue.jobs.of_kind("bulk")
    assert turn.phase == Phase.ABORTED
    keep_turns(service.catalogue, settings)
    assert service.catalogue.jobs.of_kind("bulk") == [] and used(service) == before


def test_a_run_deleted_while_its_image_is_at_work_leaves_nothing_open(
    service: Keyed,
    ann: TestClient,
    psf_file: Path,
    work: Callable[[], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for number in range(4):
        write_image(tmp_path / f"{number}.fits", seed=number)
    images = [upload(ann, tmp_path / f"{number}.fits") for number in range(4)]
    psf = upload(ann, psf_file, "/v1/psfs")
    run = started(ann, images, psf)
    real = service.catalogue.bulks.finish
    deleted: list[bool] = []

    def finish(*told: object, **values: object) -> bool:
        if not deleted:
            deleted.append(True)
            assert ann.post(f"{run}/pause").status_code == 200 and ann.delete(run).status_code == 204
        return real(*told, **values)  # type: ignore[arg-type]

    monkeypatch.setattr(service.catalogue.bulks, "finish", finish)
    work()
    assert service.catalogue.jobs.of_kind("bulk") == []
    assert len(ann.get("/v1/products").json()["items"]) in (1, 2), "the images that were at work"
    assert service.catalogue.owners.recount() == []


def test_nobody_else_deletes_a_run(service: Keyed, ann: TestClient, image_file: Path, psf_file: Path) -> None:
    run = started(ann, [upload(ann, image_file)], upload(ann, psf_file, "/v1/psfs"))
    bob, submitter = service.client("bob"), service.client("ann", Scope.READ, Scope.SUBMIT)
    for change in ("running", "cancelled"):
        theirs, unknown = bob.delete(run), bob.delete(f"/v1/bulk/{'0' * 32}")
        assert theirs.status_code == unknown.status_code == 404
        told = theirs.text.replace(run.rpartition("/")[2], "0" * 32)
        assert told == unknown.text, f"a {change} run of somebody else is as one that does not exist"
        refused = submitter.delete(run)
        assert (refused.status_code, refused.json()["type"]) == (403, "urn:heliopsf:scope-missing")
        assert service.api.delete(run).status_code == 401
        ann.post(f"{run}/cancel")
    assert len(service.catalogue.page(BulkRow, owner="ann", limit=9)) == 1
