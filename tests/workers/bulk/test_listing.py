"""Files are listed while images are processed: the first product, interruptions, errors, several patterns."""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service.app import create_app
from tests.conftest import write_image
from tests.service.conftest import upload
from tests.workers.databases import rows
from tests.workers.jobs import claimed
from workers.bulk import listing, task
from workers.bulk.matching import Place
from workers.bulk.turns import keep_turns
from workers.catalogue.bulk_tables import BulkItemRow, BulkRow
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.files import archive as archive_files
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks.context import Context

WAIT_S = 30.0
FEW = {"method": {"name": "richardson-lucy", "steps": 1}}
FOLDERS, IN_FOLDER = 3, 2
ALL = FOLDERS * IN_FOLDER


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Three folders of two images; each image has another content."""
    root = tmp_path / "archive"
    for number in range(ALL):
        path = root / f"{number // IN_FOLDER}" / f"{number}.fits"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, shape=(64, 64), seed=number)
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
    """A bulk run of the files of an archive, and its turns in this process."""

    def __init__(self, api: TestClient, settings: Settings, archive: Path, psf_id: str) -> None:
        self.api, self.settings, self.archive = api, settings, archive
        self.catalogue, self._store = Catalogue(settings.catalogue_url), Store(settings.data_dir)
        self._psf_id = psf_id

    def start(self, *globs: str) -> None:
        files = [{"glob": f"{self.archive}/{glob}"} for glob in globs or ("**/*.fits",)]
        body = {"files": files, "psf_id": self._psf_id, "parameters": FEW}
        self.id = self.api.post("/v1/bulk", json=body).json()["id"]

    def turn(self) -> None:
        keep_turns(self.catalogue, self.settings)
        for job in self.catalogue.jobs.of_kind("bulk"):
            Runner(self.settings, self.catalogue, self._store).run(job.id)

    def turns(self) -> int:
        """Run turns until the run stops; returns their number."""
        number = 0
        while self.catalogue.bulks.at_work():
            self.turn()
            number += 1
            assert number < 50, self.now()
        return number

    def now(self) -> dict[str, Any]:
        return dict(self.api.get(f"/v1/bulk/{self.id}").json())

    def change(self, name: str) -> None:
        assert self.api.post(f"/v1/bulk/{self.id}/{name}").status_code == 200

    def check_listed_once(self) -> list[BulkItemRow]:
        """Every file is one image; returns the rows."""
        query = select(BulkItemRow).where(BulkItemRow.bulk_id == self.id)
        items = rows(self.catalogue, query.order_by(BulkItemRow.position))
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


def test_images_are_processed_while_further_files_are_listed(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[dict[str, Any]] = []
    run.start()
    written = after_the_first_image(monkeypatch, lambda: seen.append(run.now()))
    monkeypatch.setattr(listing, "LIST_AT_ONCE", 1)
    looked = at_folder(monkeypatch, run.archive, "1", lambda: _must_be_set(written))
    assert run.turns() == 1
    (during,) = seen
    assert (during["phase"], during["listed"], during["time_left_s"]) == ("LISTING", False, None)
    assert during["images"]["total"] == IN_FOLDER, "as many as are listed"
    assert looked == ["archive", "0", "1", "2"]
    run.check_all_done_once()


def test_first_images_are_added_after_a_moment_even_if_they_are_few(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.start()
    written = after_the_first_image(monkeypatch, lambda: None)
    monkeypatch.setattr(listing, "ADD_EVERY_S", 0.0)
    at_folder(monkeypatch, run.archive, "1", lambda: _must_be_set(written))
    run.turns()
    run.check_all_done_once()


def test_a_search_that_was_stopped_at_every_step_finds_each_file_once(run: Run) -> None:
    """The paths that several patterns match are known again after an interruption."""
    run.start("0/*.fits", "**/*.fits", "*/*.fits")
    bulks, lease, steps = run.catalogue.bulks, _lease(run), 0
    while (begun := bulks.begin_listing(run.id, lease)) is not None:
        listing.list_files(_context(run), begun, lease, lambda: None, lambda: True)
        steps += 1
        assert steps < 100
    run.catalogue.jobs.hand_back(lease)
    assert steps > ALL and run.now()["listed"]
    run.check_listed_once()


def test_a_worker_that_is_lost_while_it_lists_is_followed_by_another(run: Run) -> None:
    run.start()
    lost = _lease(run)
    begun = _list_first_folder(run, lost)
    partly = run.now()
    assert (partly["phase"], partly["listed"]) == ("LISTING", False) and 0 < partly["images"]["total"] < ALL
    run.catalogue.jobs.give_up_silent(-1.0, 99)
    run.turns()
    listing.list_files(_context(run), begun, lost, lambda: None, lambda: False)  # it comes back too late
    run.check_all_done_once()


def test_a_run_that_was_paused_while_it_lists_continues_where_it_was(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.start()
    monkeypatch.setattr(listing, "LIST_AT_ONCE", 1)
    paused = after_the_first_image(monkeypatch, lambda: run.change("pause"))
    looked = at_folder(monkeypatch, run.archive, "2", lambda: _must_be_set(paused))
    run.turn()
    stopped = run.now()
    assert (stopped["phase"], stopped["listed"], stopped["images"]["total"]) == (
        "PAUSED",
        False,
        2 * IN_FOLDER,
    )
    assert 1 <= stopped["images"]["done"] <= 2 * IN_FOLDER and stopped["images"]["at_work"] == 0
    run.turn()
    assert run.now() == stopped, "a paused run does nothing"
    before = len(looked)
    run.change("resume")
    run.turns()
    assert looked[before:] == ["archive", "1", "2"], "a folder that was listed is not read again"
    run.check_all_done_once()


def test_a_listing_that_fails_midway_keeps_what_is_done_and_continues_when_resumed(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    at_folder(monkeypatch, run.archive, "1", unreadable)
    run.turn()
    failed = run.now()
    assert (failed["phase"], failed["listed"]) == ("ERROR", False)
    assert failed["error"]["code"] == "unreadable-folder"
    assert failed["images"]["total"] == IN_FOLDER, "what was found before the error is listed"
    assert "at least 2" in run.api.get(f"/bulk/{run.id}", headers={"Accept": "text/html"}).text
    run.change("resume")
    run.turns()
    run.check_all_done_once()


def test_a_listing_that_finds_nothing_lets_other_jobs_go_first(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
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
            if step.place.names[0] == "1":
                threading.Event().wait(0.2)

    monkeypatch.setattr(listing, "found_files", slow)
    run.turn()
    assert handed_back == [1]
    now = run.now()
    assert (now["phase"], now["images"]["total"]) == ("LISTING", 0)


def test_as_many_turns_as_workers_process_images_while_one_lists(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.start()
    monkeypatch.setattr(type(run.catalogue.census), "workers", lambda *_: [object()] * 3)
    lease = _lease(run)
    _list_first_folder(run, lease)
    keep_turns(run.catalogue, run.settings)
    others = [job for job in run.catalogue.jobs.of_kind("bulk") if job.id != lease.job_id]
    assert len(others) == IN_FOLDER - 1
    Runner(run.settings, run.catalogue, Store(run.settings.data_dir)).run(others[0].id)
    now = run.now()
    assert (now["phase"], now["images"]["done"], now["images"]["waiting"]) == ("LISTING", IN_FOLDER, 0)


def test_a_place_keeps_every_name(tmp_path: Path) -> None:
    names = ("ä/ö".replace("/", "%"), os.fsdecode(b"\xff%41\n"), "", "plus+space ", "\udcff" * 3)
    stored = Place(3, names).stored()
    assert all(name.isascii() for name in stored["names"])
    assert Place.of(stored) == Place(3, names)


def _must_be_set(event: threading.Event) -> None:
    assert event.wait(WAIT_S), "no image was processed while files are listed"


def _lease(run: Run) -> Lease:
    keep_turns(run.catalogue, run.settings)
    (job,) = run.catalogue.jobs.of_kind("bulk")
    lease = claimed(run.catalogue, job.id)
    return lease


def _list_first_folder(run: Run, lease: Lease) -> BulkRow:
    """The run as it was before the top, its folders, a folder and its files were listed."""
    begun = run.catalogue.bulks.begin_listing(run.id, lease)
    assert begun is not None
    steps = iter([False] * (1 + FOLDERS + IN_FOLDER) + [True])
    listing.list_files(_context(run), begun, lease, lambda: None, lambda: next(steps))
    return begun


def _context(run: Run) -> Context:
    return Context(
        catalogue=run.catalogue, store=Store(run.settings.data_dir), settings=run.settings, owner="local",
        job_id="j", report=lambda *_: None,
    )  # fmt: skip
