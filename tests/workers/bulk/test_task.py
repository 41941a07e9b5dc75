"""Turns of bulk runs: reading, computing and writing overlap; images of lost workers are processed alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from psfcore.errors import DataError
from service.app import create_app
from tests.conftest import write_image
from tests.s3 import s3_bucket, shared_server
from tests.service.conftest import upload
from tests.workers.databases import rows
from tests.workers.jobs import claimed
from workers.bulk import image as bulk_image
from workers.bulk import task
from workers.bulk.runs import keep_turns
from workers.catalogue.bulk_tables import BulkItemRow
from workers.catalogue.catalogue import Catalogue
from workers.files.opened import open_store
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings

WAIT_S = 30.0
FEW = {"method": {"name": "richardson-lucy", "steps": 1}}


class Run:
    """A bulk run of uploaded images, and its turns in this process."""

    def __init__(self, api: TestClient, settings: Settings, images: list[str], psf_id: str) -> None:
        self.catalogue, self.settings = Catalogue(settings.catalogue_url), settings
        self._api, self._store = api, Store(settings.data_dir)
        self._body = {"images": images, "psf_id": psf_id}
        self.id = self.requested()

    def requested(self, **parameters: object) -> str:
        """The id of the run of a request for these images."""
        body = self._body | {"parameters": FEW | parameters}
        return str(self._api.post("/v1/bulk", json=body).json()["id"])

    def turn(self) -> None:
        keep_turns(self.catalogue, self.settings)
        job = self.catalogue.jobs.of_kind("bulk")[0]
        Runner(self.settings, self.catalogue, self._store).run(job.id)

    def rows(self) -> list[BulkItemRow]:
        return rows(self.catalogue, select(BulkItemRow).order_by(BulkItemRow.position))


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", broker_url="filesystem://", allowed_hosts="testserver")


@pytest.fixture
def run(settings: Settings, tmp_path: Path, psf_file: Path) -> Iterator[Run]:
    """Four images; each has another height, so that a test can tell them apart."""
    with TestClient(create_app(settings)) as api:
        images = []
        for number in range(4):
            path = tmp_path / f"{number}.fits"
            write_image(path, shape=(96 + number, 128), seed=number)
            images.append(upload(api, path))
        run = Run(api, settings, images, upload(api, psf_file, "/v1/psfs"))
        yield run
        run.catalogue.close()


def test_an_identical_request_finds_the_open_run(run: Run) -> None:
    assert run.requested() == run.requested(other_channel=False, again=False) == run.id
    others = [run.requested(**{name: True}) for name in ("other_channel", "again")]
    assert len({run.id, *others}) == 3


def number_of(ready: Any) -> int:
    return int(ready.image.pixels.shape[0]) - 96


def test_the_next_image_is_read_and_the_last_product_written_while_an_image_is_computed(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, written = ([threading.Event() for _ in range(5)] for _ in range(2))
    computing = threading.Event()
    read_one, compute_one, write_one = task.read_one, task.compute_one, task.write_one
    threads: set[int] = set()

    def reading(context: Any, bulk: Any, taken: Any) -> Any:
        ready = read_one(context, bulk, taken)
        read[taken.position].set()
        return ready

    def compute(context: Any, ready: Any) -> Any:
        number = number_of(ready)
        computing.set()
        threads.add(threading.get_ident())
        assert number == 3 or read[number + 1].wait(WAIT_S), f"image {number + 1} was not read meanwhile"
        assert number == 0 or written[number - 1].wait(WAIT_S), (
            f"image {number - 1} was not written meanwhile"
        )
        made = compute_one(context, ready)
        computing.clear()
        return made

    def write(context: Any, ready: Any, made: Any) -> Any:
        number = number_of(ready)
        assert number == 3 or computing.wait(WAIT_S), f"image {number} was written before the next one began"
        outcome = write_one(context, ready, made)
        written[number].set()
        return outcome

    for name, function in {"read_one": reading, "compute_one": compute, "write_one": write}.items():
        monkeypatch.setattr(task, name, function)
    run.turn()
    assert [(row.state, row.attempts) for row in run.rows()] == [("done", 1)] * 4
    assert threads == {threading.get_ident()}, "only the thread of the job computes"


def test_an_image_in_its_second_attempt_has_no_neighbours(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    lease = run.catalogue.jobs.claim(_turn_of(run), worker="lost")
    assert lease is not None and run.catalogue.bulks.take(run.id, lease, 3) is not None
    assert run.catalogue.jobs.hand_back(lease)
    at_work: list[list[int]] = []
    compute_one = task.compute_one

    def compute(context: Any, ready: Any) -> Any:
        at_work.append([row.position for row in run.rows() if row.state == "taken"])
        return compute_one(context, ready)

    monkeypatch.setattr(task, "compute_one", compute)
    run.turn()
    assert at_work[0] == [0] and [row.attempts for row in run.rows()] == [2, 1, 1, 1]
    assert [row.state for row in run.rows()] == ["done"] * 4


def test_an_image_that_was_read_ahead_is_given_back(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = threading.Event()
    read_one = task.read_one

    def reading(context: Any, bulk: Any, taken: Any) -> Any:
        if taken.position == 1:
            begun.set()
        return read_one(context, bulk, taken)

    def compute(context: Any, ready: Any) -> Any:
        assert begun.wait(WAIT_S)
        run.catalogue.bulks.pause(run.id)
        raise DataError("no-signal", "expected light; got none")

    monkeypatch.setattr(task, "read_one", reading)
    monkeypatch.setattr(task, "compute_one", compute)
    run.turn()
    states = [(row.state, row.attempts) for row in run.rows()]
    assert states == [("failed", 1), ("waiting", 0), ("waiting", 0), ("waiting", 0)]


def test_an_error_of_writing_belongs_to_its_image(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    write_one = task.write_one

    def write(context: Any, ready: Any, made: Any) -> Any:
        if number_of(ready) in (1, 3):
            raise DataError("output-not-written", "expected a folder; got a file")
        return write_one(context, ready, made)

    monkeypatch.setattr(task, "write_one", write)
    run.turn()
    assert [row.state for row in run.rows()] == ["done", "failed", "done", "failed"]
    assert [row.error["code"] for row in run.rows() if row.error] == ["output-not-written"] * 2


def test_files_of_equal_content_are_computed_once(
    settings: Settings, tmp_path: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = tmp_path / "archive"
    archive.mkdir()
    write_image(archive / "a.fits")
    for name in ("b", "c"):
        (archive / f"{name}.fits").write_bytes((archive / "a.fits").read_bytes())
    computed: list[Any] = []
    compute_one = task.compute_one
    monkeypatch.setattr(task, "compute_one", lambda *told: computed.append(told) or compute_one(*told))  # type: ignore[func-returns-value]
    allowed = settings.model_copy(update={"bulk_roots": str(archive)})
    with TestClient(create_app(allowed)) as api:
        body = {"files": [{"glob": f"{archive}/*"}], "psf_id": upload(api, psf_file, "/v1/psfs")}
        bulk = api.post("/v1/bulk", json=body | {"parameters": FEW}).json()
        catalogue = Catalogue(allowed.catalogue_url)
        keep_turns(catalogue, allowed)
        (turn,) = catalogue.jobs.of_kind("bulk")
        Runner(allowed, catalogue, Store(allowed.data_dir)).run(turn.id)
        catalogue.close()
        images = api.get(f"/v1/bulk/{bulk['id']}").json()["images"]
    assert (images["done"], images["reused"], len(computed)) == (3, 2, 1)


def _turn_of(run: Run) -> str:
    keep_turns(run.catalogue, run.settings)
    return run.catalogue.jobs.of_kind("bulk")[0].id


def test_a_local_copy_removed_during_a_wait_is_downloaded_again(
    tmp_path: Path, image_file: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with s3_bucket(monkeypatch, shared_server()) as (url, _):
        data = {"data_dir": tmp_path / "data", "store_url": url}
        settings = Settings.model_validate(
            data | {"broker_url": "filesystem://", "allowed_hosts": "testserver"}
        )
        with TestClient(create_app(settings)) as api:
            image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
            few = {"method": {"name": "richardson-lucy", "steps": 1}}
            body = {"kind": "deconvolve", "parameters": {"image_id": image_id, "psf_id": psf_id, **few}}
            job = api.post("/v1/jobs", json=body).json()
            request = {"images": [image_id], "psf_id": psf_id, "parameters": few}
            bulk = api.post("/v1/bulk", json=request).json()
        catalogue = Catalogue(settings.catalogue_url)
        lease = claimed(catalogue, job["id"], "another")
        (copy,) = (path for path in tmp_path.rglob(image_id) if path.is_file())

        def rest(_seconds: float) -> None:
            copy.unlink()
            assert catalogue.jobs.requeue(lease)

        clock = SimpleNamespace(time=time.time, monotonic=time.monotonic, sleep=rest)
        monkeypatch.setattr(bulk_image, "time", clock)
        keep_turns(catalogue, settings)
        (turn,) = catalogue.jobs.of_kind("bulk")
        Runner(settings, catalogue, open_store(settings)).run(turn.id)
        row = catalogue.bulks.get(bulk["id"])
        assert row is not None and (row.done, row.failed) == (1, 0)
        assert copy.is_file()
        catalogue.close()
