"""Turns of bulk runs: reading, computing, writing and listing overlap; interruptions, errors, images of lost
workers."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
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
from tests.workers.jobs import claimed, run_job
from workers.bulk import image as bulk_image
from workers.bulk import listing, task
from workers.bulk.listing import SearchPosition
from workers.bulk.runs import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import BulkItemRow
from workers.files import archive as archive_files
from workers.files.store import open_store
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks.catalogue_workspace import CatalogueWorkspace

WAIT_S = 30.0
FEW = {"method": {"name": "richardson-lucy", "steps": 1}}
FOLDERS, IN_FOLDER = 3, 2
ALL = FOLDERS * IN_FOLDER


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Three folders of two images; each image has another height, so that a test can tell them apart."""
    root = tmp_path / "archive"
    for number in range(ALL):
        path = root / f"{number // IN_FOLDER}" / f"{number}.fits"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, shape=(64 + number, 64), seed=number)
    return root


@pytest.fixture
def settings(tmp_path: Path, archive: Path) -> Settings:
    return Settings(
        data_dir=tmp_path / "data",
        broker_url="filesystem://",
        allowed_hosts="testserver",
        bulk_roots=str(archive),
    )


class Run:
    """A bulk run of the files of an archive, or of its first four files as uploads, and its turns in this process."""

    def __init__(self, api: TestClient, settings: Settings, archive: Path, psf_id: str) -> None:
        self.api, self.settings, self.archive = api, settings, archive
        self.catalogue, self.store = Catalogue(settings.catalogue_url), open_store(settings)
        self._psf_id = psf_id

    def start(self, *globs: str) -> None:
        self.id = self.requested(
            files=[{"glob": f"{self.archive}/{glob}"} for glob in globs or ("**/*.fits",)]
        )

    def start_uploaded(self) -> None:
        self.images = [upload(self.api, path) for path in sorted(self.archive.glob("*/*"))[:4]]
        self.id = self.requested(images=self.images)

    def requested(self, *, parameters: dict[str, Any] | None = None, **body: Any) -> str:
        """The id of the run of a request."""
        body |= {"psf_id": self._psf_id, "parameters": FEW | (parameters or {})}
        return str(self.api.post("/v1/bulk", json=body).json()["id"])

    def turn(self) -> None:
        keep_turns(self.catalogue, self.settings)
        for job in self.catalogue.jobs.of_kind("bulk"):
            run_job(Runner(self.settings, self.catalogue, self.store), self.catalogue, job.id)

    def turns(self) -> int:
        """Run turns until the run stops; returns their number."""
        number = 0
        while self.catalogue.bulks.at_work():
            self.turn()
            number += 1
            assert number < 50, self.now()
        return number

    def lease(self) -> Lease:
        """The lease of a worker that claims the only turn."""
        keep_turns(self.catalogue, self.settings)
        (job,) = self.catalogue.jobs.of_kind("bulk")
        return claimed(self.catalogue, job.id)

    def rows(self) -> list[BulkItemRow]:
        query = select(BulkItemRow).where(BulkItemRow.bulk_id == self.id)
        return rows(self.catalogue, query.order_by(BulkItemRow.position))

    def now(self) -> dict[str, Any]:
        return dict(self.api.get(f"/v1/bulk/{self.id}").json())

    def change(self, name: str) -> None:
        assert self.api.post(f"/v1/bulk/{self.id}/{name}").status_code == 200

    def check_listed_once(self) -> list[BulkItemRow]:
        """Every file is one image; returns the rows."""
        items = self.rows()
        names = [Path(row.source).name for row in items]
        assert Counter(names) == Counter(f"{number}.fits" for number in range(ALL))
        assert [row.position for row in items] == list(range(ALL))
        return items

    def check_all_done_once(self) -> None:
        """Every file is one image, which was computed once; the counts agree with the rows."""
        now, items = self.now(), self.check_listed_once()
        assert [(row.state, row.attempts, row.reused) for row in items] == [("done", 1, False)] * ALL
        images = now["images"]
        assert (now["phase"], now["listed"]) == ("COMPLETED", True)
        assert (images["total"], images["done"], images["waiting"], images["failed"]) == (ALL, ALL, 0, 0)
        lines = self.api.get(f"/v1/bulk/{self.id}/results").text.splitlines()
        assert len(lines) == ALL


@pytest.fixture
def run(settings: Settings, archive: Path, psf_file: Path) -> Iterator[Run]:
    with TestClient(create_app(settings)) as api:
        run = Run(api, settings, archive, upload(api, psf_file, "/v1/psfs"))
        yield run
        run.catalogue.close()


def at_folder(
    monkeypatch: pytest.MonkeyPatch, archive: Path, name: str, act: Callable[[], None]
) -> list[str]:
    """Call ``act`` when the listing first reads this folder of the archive; returns the folders that it reads."""
    looked: list[str] = []
    real = os.scandir

    def scandir(folder: Any) -> Any:
        if isinstance(folder, Path) and folder.is_relative_to(archive):
            looked.append(folder.name)
            if looked.count(name) == 1 and looked[-1] == name:
                act()
        return real(folder)

    monkeypatch.setattr(archive_files.os, "scandir", scandir)
    return looked


def after_the_first_image(monkeypatch: pytest.MonkeyPatch, act: Callable[[], None]) -> threading.Event:
    """Call ``act`` when the product of an image is written, for the first image; returns an event that is then set."""
    acted, write_one = threading.Event(), task.write_one

    def write(*given: Any) -> Any:
        outcome = write_one(*given)
        if not acted.is_set():
            act()
        acted.set()
        return outcome

    monkeypatch.setattr(task, "write_one", write)
    return acted


@pytest.mark.parametrize(("setting", "value"), [("LIST_AT_ONCE", 1), ("ADD_EVERY_S", 0.0)])
def test_images_are_processed_while_further_files_are_listed(
    run: Run, monkeypatch: pytest.MonkeyPatch, setting: str, value: float
) -> None:
    """Files are added when there are enough of them, or after a moment."""
    seen: list[dict[str, Any]] = []
    run.start()
    written = after_the_first_image(monkeypatch, lambda: seen.append(run.now()))
    monkeypatch.setattr(listing, setting, value)
    looked = at_folder(monkeypatch, run.archive, "1", lambda: _must_be_set(written))
    assert run.turns() == 1
    (during,) = seen
    assert (during["phase"], during["listed"], during["time_left_s"]) == ("LISTING", False, None)
    assert during["images"]["total"] == IN_FOLDER, "as many as are listed"
    assert looked == ["archive", "0", "1", "2"]
    run.check_all_done_once()


def test_a_search_that_was_stopped_at_every_step_finds_each_file_once(run: Run) -> None:
    """The paths that several patterns match are known again after an interruption."""
    run.start("0/*.fits", "**/*.fits", "*/*.fits")
    bulks, lease, steps = run.catalogue.bulks, run.lease(), 0
    while (begun := bulks.begin_listing(run.id, lease)) is not None:
        listing.list_files(_workspace(run, lease), begun, lambda: None, lambda: True)
        steps += 1
        assert steps < 100
    run.catalogue.jobs.hand_back(lease)
    assert steps > ALL and run.now()["listed"]
    run.check_listed_once()


def test_a_listing_that_failed_continues_when_resumed(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise ZeroDivisionError

    def unreadable() -> None:
        raise PermissionError(13, "Permission denied")

    run.start()
    with monkeypatch.context() as patched:
        at_folder(patched, run.archive, "1", broken)
        run.turn()
    keep_turns(run.catalogue, run.settings)
    assert (run.now()["phase"], run.now()["error"]["code"]) == ("ERROR", "internal-error")
    run.change("resume")
    looked = at_folder(monkeypatch, run.archive, "1", unreadable)
    run.turn()
    failed = run.now()
    assert (failed["phase"], failed["listed"]) == ("ERROR", False)
    assert failed["error"]["code"] == "unreadable-folder"
    assert failed["images"]["total"] == IN_FOLDER, "what was found before the error is listed"
    assert "at least 2" in run.api.get(f"/bulk/{run.id}", headers={"Accept": "text/html"}).text
    run.change("resume")
    run.turns()
    assert looked == ["archive", "0", "1", "archive", "1", "2"], "a listed folder is not read again"
    run.check_all_done_once()


def test_a_run_cancelled_while_it_finds_nothing_stops(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workers.run.attempt.REPORT_EVERY_S", 0.0)
    monkeypatch.setattr(listing, "ADD_EVERY_S", 0.0)
    run.start("**/*.none")
    looked = at_folder(monkeypatch, run.archive, "1", lambda: run.change("cancel"))
    run.turn()
    assert looked == ["archive", "0", "1"] and run.now()["phase"] == "CANCELLED"
    assert {job.phase for job in run.catalogue.jobs.of_kind("bulk")} <= {"ABORTED", "COMPLETED"}


def test_a_listing_lets_other_jobs_go_first(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search of a large archive must not keep a worker from the jobs of people."""
    run.start("**/*.none")
    handed_back, submit = [], lambda: run.catalogue.jobs.submit("psf-build", {}, "k", "somebody") and None
    hand_back = run.catalogue.jobs.hand_back
    monkeypatch.setattr(
        run.catalogue.jobs, "hand_back", lambda lease: handed_back.append(1) or hand_back(lease)
    )
    at_folder(monkeypatch, run.archive, "1", submit)
    monkeypatch.setattr(listing, "ADD_EVERY_S", 0.0)
    real = listing.found_files

    def slow(*given: Any, **named: Any) -> Iterator[Any]:
        for step in real(*given, **named):
            yield step
            if step[0].names[0] == "1":
                threading.Event().wait(0.2)

    monkeypatch.setattr(listing, "found_files", slow)
    run.turn()
    assert handed_back == [1]
    now = run.now()
    assert (now["phase"], now["images"]["total"]) == ("LISTING", 0)


def test_other_turns_process_images_while_one_lists(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run.start()
    monkeypatch.setattr(type(run.catalogue.census), "workers", lambda *_: [object()] * 3)
    lease = run.lease()
    _list_first_folder(run, lease)
    keep_turns(run.catalogue, run.settings)
    others = [job for job in run.catalogue.jobs.of_kind("bulk") if job.id != lease.job_id]
    assert len(others) == IN_FOLDER - 1
    run_job(Runner(run.settings, run.catalogue, run.store), run.catalogue, others[0].id)
    now = run.now()
    assert (now["phase"], now["images"]["done"], now["images"]["waiting"]) == ("LISTING", IN_FOLDER, 0)


def test_a_place_keeps_every_name(tmp_path: Path) -> None:
    names = ("ä/ö".replace("/", "%"), os.fsdecode(b"\xff%41\n"), "", "plus+space ", "\udcff" * 3)
    stored = SearchPosition(3, names).stored()
    assert all(name.isascii() for name in stored["names"])
    assert SearchPosition.of(stored) == SearchPosition(3, names)


def test_an_identical_request_finds_the_open_run(run: Run) -> None:
    run.start_uploaded()
    defaults = {"other_channel": False, "again": False}
    assert run.requested(images=run.images) == run.requested(images=run.images, parameters=defaults) == run.id
    others = [run.requested(images=run.images, parameters={name: True}) for name in defaults]
    assert len({run.id, *others}) == 3


def number_of(ready: Any) -> int:
    return int(ready.image.pixels.shape[0]) - 64


def test_reading_computing_and_writing_overlap(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run.start_uploaded()
    read, written = ([threading.Event() for _ in range(5)] for _ in range(2))
    computing = threading.Event()
    read_one, compute_one, write_one = task.read_one, task.compute_one, task.write_one
    threads: set[int] = set()

    def reading(workspace: Any, bulk: Any, taken: Any) -> Any:
        ready = read_one(workspace, bulk, taken)
        read[taken.position].set()
        return ready

    def compute(workspace: Any, ready: Any) -> Any:
        number = number_of(ready)
        computing.set()
        threads.add(threading.get_ident())
        assert number == 3 or read[number + 1].wait(WAIT_S), f"image {number + 1} was not read meanwhile"
        assert number == 0 or written[number - 1].wait(WAIT_S), (
            f"image {number - 1} was not written meanwhile"
        )
        made = compute_one(workspace, ready)
        computing.clear()
        return made

    def write(workspace: Any, ready: Any, made: Any) -> Any:
        number = number_of(ready)
        assert number == 3 or computing.wait(WAIT_S), f"image {number} was written before the next one began"
        outcome = write_one(workspace, ready, made)
        written[number].set()
        return outcome

    for name, function in {"read_one": reading, "compute_one": compute, "write_one": write}.items():
        monkeypatch.setattr(task, name, function)
    run.turn()
    assert [(row.state, row.attempts) for row in run.rows()] == [("done", 1)] * 4
    assert threads == {threading.get_ident()}, "only the thread of the job computes"


def test_an_image_in_its_second_attempt_has_no_neighbours(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run.start_uploaded()
    lease = run.lease()
    assert run.catalogue.bulks.take(run.id, lease, 3) is not None
    assert run.catalogue.jobs.hand_back(lease)
    at_work: list[list[int]] = []
    compute_one = task.compute_one

    def compute(workspace: Any, ready: Any) -> Any:
        at_work.append([row.position for row in run.rows() if row.state == "taken"])
        return compute_one(workspace, ready)

    monkeypatch.setattr(task, "compute_one", compute)
    run.turn()
    assert at_work[0] == [0] and [row.attempts for row in run.rows()] == [2, 1, 1, 1]
    assert [row.state for row in run.rows()] == ["done"] * 4


def test_an_image_that_was_read_ahead_is_given_back(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run.start_uploaded()
    begun = threading.Event()
    read_one = task.read_one

    def reading(workspace: Any, bulk: Any, taken: Any) -> Any:
        if taken.position == 1:
            begun.set()
        return read_one(workspace, bulk, taken)

    def compute(workspace: Any, ready: Any) -> Any:
        assert begun.wait(WAIT_S)
        run.catalogue.bulks.pause(run.id)
        raise DataError("no-signal", "expected light; got none")

    monkeypatch.setattr(task, "read_one", reading)
    monkeypatch.setattr(task, "compute_one", compute)
    run.turn()
    states = [(row.state, row.attempts) for row in run.rows()]
    assert states == [("failed", 1), ("waiting", 0), ("waiting", 0), ("waiting", 0)]


def test_an_error_of_writing_belongs_to_its_image(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run.start_uploaded()
    write_one = task.write_one

    def write(workspace: Any, ready: Any, made: Any) -> Any:
        if number_of(ready) in (1, 3):
            raise DataError("output-not-written", "expected a folder; got a file")
        return write_one(workspace, ready, made)

    monkeypatch.setattr(task, "write_one", write)
    run.turn()
    assert [row.state for row in run.rows()] == ["done", "failed", "done", "failed"]
    assert [row.error["code"] for row in run.rows() if row.error] == ["output-not-written"] * 2


def test_files_of_equal_content_are_computed_once(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("b", "c"):
        (run.archive / "0" / f"{name}.fits").write_bytes((run.archive / "0" / "0.fits").read_bytes())
    computed: list[Any] = []
    compute_one = task.compute_one
    monkeypatch.setattr(task, "compute_one", lambda *told: computed.append(told) or compute_one(*told))  # type: ignore[func-returns-value]
    run.start("0/[0bc].fits")
    run.turns()
    images = run.now()["images"]
    assert (images["done"], images["reused"], len(computed)) == (3, 2, 1)


def test_a_local_copy_removed_during_a_wait_is_downloaded_again(
    settings: Settings, archive: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with s3_bucket(monkeypatch, shared_server()) as (url, _):
        settings = settings.model_copy(update={"store_url": url})
        with TestClient(create_app(settings)) as api:
            psf_id = upload(api, psf_file, "/v1/psfs")
            run = Run(api, settings, archive, psf_id)
            run.start_uploaded()
            parameters = {"image_id": run.images[0], "psf_id": psf_id, **FEW}
            job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters}).json()
            lease = claimed(run.catalogue, job["id"], "another")
            (copy,) = (path for path in settings.data_dir.rglob(run.images[0]) if path.is_file())

            def rest(_seconds: float) -> None:
                copy.unlink()
                assert run.catalogue.jobs.requeue(lease)

            clock = SimpleNamespace(time=time.time, monotonic=time.monotonic, sleep=rest)
            monkeypatch.setattr(bulk_image, "time", clock)
            run.turn()
            assert run.rows()[0].state == "done" and copy.is_file()
            run.catalogue.close()


def _must_be_set(event: threading.Event) -> None:
    assert event.wait(WAIT_S), "no image was processed while files are listed"


def _list_first_folder(run: Run, lease: Lease) -> None:
    """List the top, its folders, a folder and its files."""
    begun = run.catalogue.bulks.begin_listing(run.id, lease)
    assert begun is not None
    steps = iter([False] * (1 + FOLDERS + IN_FOLDER) + [True])
    listing.list_files(_workspace(run, lease), begun, lambda: None, lambda: next(steps))


def _workspace(run: Run, lease: Lease) -> CatalogueWorkspace:
    return CatalogueWorkspace(
        catalogue=run.catalogue, store=run.store, settings=run.settings, owner="local",
        job_id="j", report=lambda *_: None, lease=lease,
    )  # fmt: skip
