"""Bulk runs and their images as rows: taken, lost, done, paused, retried; consistent counts; fifty thousand images."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, select, update

from psfcore.errors import DataError
from tests.conftest import write_image
from tests.whole.many_rows import plan, statements
from workers.bulk import listing, matching
from workers.catalogue import bulk_progress
from workers.catalogue import bulks as bulk_rows
from workers.catalogue.bulk_tables import BulkItemRow, BulkRow
from workers.catalogue.bulks import Listed, Taken, new_id
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.owners import ROW_BYTES, counted_bytes
from workers.catalogue.tables import ImageRow, JobRow, ProductRow
from workers.contract.bulk import DELETABLE, BulkPhase, ItemState
from workers.contract.phases import Fault, JobError
from workers.files.store import Store
from workers.settings import Settings
from workers.tasks.context import Context

B, C = ({"pattern": 0, "names": [name]} for name in "bc")  # places up to which files are listed
BAD = JobError(fault=Fault.USER, code="bad", message="a bad image")
DONE: dict[str, Any] = {
    "image_sha256": "a" * 64, "psf_id": "b" * 64, "product_id": "c" * 64, "kept": True, "output": None,
    "sha256": "d" * 64, "bytes": 5, "score": 0.5, "statistics": {},
}  # fmt: skip


def made(catalogue: Catalogue, images: int, *, key: str = "k", listed: bool = True) -> str:
    """A bulk with uploads as its images."""
    row = BulkRow(
        id=new_id(), owner="o", name="", phase=BulkPhase.RUNNING if listed else BulkPhase.LISTING, request={},
        request_key=key, psf_id="p" * 64, created_at=time.time(), running_since=time.time(), listed=listed,
    )  # fmt: skip
    return catalogue.bulks.create(row, [f"{n:064x}" for n in range(images)])[0].id


def turn(catalogue: Catalogue) -> Lease:
    """A worker's lease of a turn."""
    job, _ = catalogue.jobs.submit("bulk", {}, new_id(), "o")
    lease = catalogue.jobs.claim(job.id, "w")
    assert lease is not None
    return lease


def row(catalogue: Catalogue, bulk_id: str) -> BulkRow:
    found = catalogue.bulks.get(bulk_id)
    assert found is not None
    return found


def done(catalogue: Catalogue, taken: Taken, *, reused: bool = False, **values: Any) -> bool:
    return catalogue.bulks.finish(taken, reused=reused, **{**DONE, **values})


def all_taken(catalogue: Catalogue, bulk_id: str, lease: Lease) -> Iterator[Taken]:
    while (taken := catalogue.bulks.take(bulk_id, lease, 3)) is not None:
        yield taken


def check_counts(catalogue: Catalogue, bulk_id: str) -> None:
    """The counts of the run equal those of its images."""
    query = select(BulkItemRow.state, func.count()).where(BulkItemRow.bulk_id == bulk_id)
    with catalogue._engine.connect() as connection:
        states = dict(connection.execute(query.group_by(BulkItemRow.state)).all())  # type: ignore[arg-type]
    bulk = row(catalogue, bulk_id)
    assert bulk.total == sum(states.values())
    assert (bulk.done, bulk.failed) == (states.get("done", 0), states.get("failed", 0))


def test_images_are_taken_in_order_and_the_last_one_ends_the_bulk(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 3), turn(catalogue)
    taken = list(all_taken(catalogue, bulk_id, lease))
    assert [one.position for one in taken] == [0, 1, 2]
    assert catalogue.bulks.progress.pace(row(catalogue, bulk_id)).taken == 3
    assert done(catalogue, taken[0]) and done(catalogue, taken[1], reused=True)
    assert row(catalogue, bulk_id).phase == BulkPhase.RUNNING
    assert catalogue.bulks.fail(taken[2], BAD)
    ended = row(catalogue, bulk_id)
    assert ended.phase == BulkPhase.COMPLETED and ended.ended_at is not None
    assert (ended.total, ended.done, ended.reused, ended.failed) == (3, 2, 1, 1)
    check_counts(catalogue, bulk_id)


def test_an_image_done_twice_counts_once(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 2), turn(catalogue)
    taken = catalogue.bulks.take(bulk_id, lease, 3)
    assert taken is not None
    assert [done(catalogue, taken), done(catalogue, taken), catalogue.bulks.fail(taken, BAD)] == [
        True,
        False,
        False,
    ]
    assert row(catalogue, bulk_id).done == 1
    check_counts(catalogue, bulk_id)


def test_many_workers_take_each_image_once(catalogue: Catalogue) -> None:
    bulk_id = made(catalogue, 60)
    leases = [turn(catalogue) for _ in range(6)]

    def work(lease: Lease) -> list[int]:
        found = []
        for taken in all_taken(catalogue, bulk_id, lease):
            found.append(taken.position)
            assert done(catalogue, taken)
        return found

    with ThreadPoolExecutor(6) as pool:
        found = [position for positions in pool.map(work, leases) for position in positions]
    assert sorted(found) == list(range(60))
    assert row(catalogue, bulk_id).phase == BulkPhase.COMPLETED
    check_counts(catalogue, bulk_id)


def test_an_image_of_a_lost_worker_is_taken_by_another_and_its_result_counts(catalogue: Catalogue) -> None:
    bulk_id, lost = made(catalogue, 1), turn(catalogue)
    first = catalogue.bulks.take(bulk_id, lost, 3)
    other = turn(catalogue)
    assert first is not None
    assert catalogue.bulks.take(bulk_id, other, 3) is None, "it is held"
    catalogue.jobs.give_up_silent(-1.0, 99)  # every worker was silent for longer than that
    other = turn(catalogue)
    second = catalogue.bulks.take(bulk_id, other, 3)
    assert second is not None and second.position == 0
    assert not done(catalogue, first, score=9.0), "the lost one comes back too late"
    assert catalogue.bulks.take(bulk_id, lost, 3) is None, "and gets nothing more"
    assert done(catalogue, second)
    (item,) = catalogue.bulks.progress.items(bulk_id, ItemState.DONE)
    assert (item.attempts, item.score) == (2, 0.5)


def test_an_image_whose_workers_are_lost_fails(catalogue: Catalogue) -> None:
    bulk_id = made(catalogue, 2)
    for _ in range(3):
        taken = catalogue.bulks.take(bulk_id, turn(catalogue), 3)
        assert taken is not None and taken.position == 0
        catalogue.jobs.give_up_silent(-1.0, 99)
    taken = catalogue.bulks.take(bulk_id, turn(catalogue), 3)
    assert taken is not None and taken.position == 1, "the others go on"
    (item,) = catalogue.bulks.progress.items(bulk_id, ItemState.FAILED)
    assert item.error is not None and item.error["code"] == "worker-lost" and item.attempts == 3
    assert done(catalogue, taken)
    assert row(catalogue, bulk_id).phase == BulkPhase.COMPLETED
    check_counts(catalogue, bulk_id)


def test_a_released_image_is_as_if_it_had_not_been_taken(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 1), turn(catalogue)
    for _ in range(5):
        taken = catalogue.bulks.take(bulk_id, lease, 3)
        assert taken is not None and catalogue.bulks.release(taken)
    assert not catalogue.bulks.release(taken)


def test_paused_resumed_cancelled(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 2), turn(catalogue)
    taken = catalogue.bulks.take(bulk_id, lease, 3)
    assert taken is not None and catalogue.bulks.pause(bulk_id)
    assert not catalogue.bulks.pause(bulk_id) and catalogue.bulks.at_work() == []
    assert catalogue.bulks.take(bulk_id, lease, 3) is None
    assert done(catalogue, taken), "what is at work is let end"
    assert catalogue.bulks.resume(bulk_id) and not catalogue.bulks.resume(bulk_id)
    taken = catalogue.bulks.take(bulk_id, lease, 3)
    assert taken is not None and catalogue.bulks.cancel(bulk_id)
    assert not catalogue.bulks.cancel(bulk_id) and not catalogue.bulks.resume(bulk_id)
    assert catalogue.bulks.take(bulk_id, lease, 3) is None
    assert catalogue.bulks.retry(bulk_id) is None
    assert row(catalogue, bulk_id).phase == BulkPhase.CANCELLED


def test_the_last_image_ends_a_bulk_that_is_paused(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 1), turn(catalogue)
    taken = catalogue.bulks.take(bulk_id, lease, 3)
    assert taken is not None and catalogue.bulks.pause(bulk_id) and done(catalogue, taken)
    assert row(catalogue, bulk_id).phase == BulkPhase.COMPLETED


def test_retry_queues_only_failed_images(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 3), turn(catalogue)
    first, second, third = all_taken(catalogue, bulk_id, lease)
    done(catalogue, first), catalogue.bulks.fail(second, BAD), catalogue.bulks.fail(third, BAD)
    assert catalogue.bulks.retry(bulk_id) == 2
    again = row(catalogue, bulk_id)
    assert (again.phase, again.done, again.failed, again.ended_at) == (BulkPhase.RUNNING, 1, 0, None)
    assert [one.position for one in all_taken(catalogue, bulk_id, lease)] == [1, 2]
    assert catalogue.bulks.retry(bulk_id) == 0
    check_counts(catalogue, bulk_id)


def test_an_identical_request_finds_only_an_open_run(catalogue: Catalogue) -> None:
    first = made(catalogue, 2)
    assert made(catalogue, 2) == first and made(catalogue, 2, key="other") != first
    assert row(catalogue, first).total == 2
    catalogue.bulks.cancel(first)
    assert made(catalogue, 2) != first


def used(catalogue: Catalogue) -> int:
    """What the owner's files and rows count now; a recount agrees."""
    assert catalogue.owners.recount() == []
    return catalogue.owners.usage("o", 0).used_bytes


def turn_bytes(catalogue: Catalogue, lease: Lease) -> int:
    """What the job of a turn counts."""
    job = catalogue.jobs.get(lease.job_id)
    assert job is not None
    return counted_bytes(job)


def images_of(catalogue: Catalogue, bulk_id: str) -> int:
    query = select(func.count()).select_from(BulkItemRow).where(BulkItemRow.bulk_id == bulk_id)
    with catalogue._engine.connect() as connection:
        return connection.scalar(query) or 0


def in_phase(catalogue: Catalogue, bulk_id: str, phase: BulkPhase) -> None:
    """Bring a run of three images into a phase; one image is done, one failed."""
    first, second, third = all_taken(catalogue, bulk_id, turn(catalogue))
    done(catalogue, first, reused=True), catalogue.bulks.fail(second, BAD)
    match phase:
        case BulkPhase.PAUSED:
            catalogue.bulks.pause(bulk_id)
        case BulkPhase.ERROR:
            catalogue.bulks.stop_with(bulk_id, BAD)
        case BulkPhase.CANCELLED:
            catalogue.bulks.cancel(bulk_id)
        case BulkPhase.COMPLETED:
            done(catalogue, third)
    assert row(catalogue, bulk_id).phase == phase


@pytest.mark.parametrize("phase", sorted(DELETABLE))
def test_a_deleted_run_gives_all_its_bytes_back_and_leaves_other_runs(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, phase: BulkPhase
) -> None:
    monkeypatch.setattr(bulk_rows, "BATCH", 2)
    other = made(catalogue, 3, key="other")
    before = used(catalogue)
    bulk_id = made(catalogue, 3)
    in_phase(catalogue, bulk_id, phase)
    for job in catalogue.jobs.of_kind("bulk"):
        catalogue.uws.destroy(job.id)  # turns are jobs, which count by themselves
    assert used(catalogue) == before + counted_bytes(row(catalogue, bulk_id)) > before + 4 * ROW_BYTES
    assert catalogue.bulks.delete(bulk_id)
    assert catalogue.bulks.get(bulk_id) is None and images_of(catalogue, bulk_id) == 0
    assert used(catalogue) == before
    assert images_of(catalogue, other) == row(catalogue, other).total == 3
    assert not catalogue.bulks.delete(bulk_id), "it is deleted once"
    assert made(catalogue, 3) != bulk_id, "the same request makes a new run"


@pytest.mark.parametrize("listed", [True, False], ids=["running", "listing"])
def test_a_run_at_work_is_not_deleted(catalogue: Catalogue, listed: bool) -> None:
    bulk_id = made(catalogue, 2, listed=listed)
    before = used(catalogue), row(catalogue, bulk_id).phase
    assert not catalogue.bulks.delete(bulk_id)
    assert (used(catalogue), row(catalogue, bulk_id).phase) == before
    assert images_of(catalogue, bulk_id) == 2


def test_a_deletion_that_was_interrupted_leaves_a_cancelled_run_that_can_be_deleted(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bulk_rows, "BATCH", 1)
    before = used(catalogue)
    bulk_id, lease = made(catalogue, 4), turn(catalogue)
    first, second, *_ = all_taken(catalogue, bulk_id, lease)
    done(catalogue, first, reused=True), catalogue.bulks.fail(second, BAD), catalogue.bulks.pause(bulk_id)
    with_turn, real, calls = used(catalogue) - counted_bytes(row(catalogue, bulk_id)), bulk_rows._changed, []

    def killed(*statement: Any) -> int:
        calls.append(statement)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*statement)

    monkeypatch.setattr(bulk_rows, "_changed", killed)
    with pytest.raises(KeyboardInterrupt):
        catalogue.bulks.delete(bulk_id)
    left = row(catalogue, bulk_id)
    assert (left.phase, left.total, left.done, left.reused, left.failed) == ("CANCELLED", 2, 0, 0, 0)
    check_counts(catalogue, bulk_id)
    assert used(catalogue) == with_turn + counted_bytes(left)
    assert not catalogue.bulks.resume(bulk_id) and catalogue.bulks.retry(bulk_id) is None
    assert catalogue.bulks.delete(bulk_id)
    catalogue.uws.destroy(lease.job_id)
    assert used(catalogue) == before


def test_a_worker_whose_run_is_deleted_records_nothing(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 3), turn(catalogue)
    first, second, third = all_taken(catalogue, bulk_id, lease)
    assert catalogue.bulks.pause(bulk_id) and catalogue.bulks.delete(bulk_id)
    told = done(catalogue, first), catalogue.bulks.fail(second, BAD), catalogue.bulks.release(third)
    assert told == (False, False, False)
    assert catalogue.bulks.take(bulk_id, lease, 3) is None
    assert not catalogue.bulks.stop_with(bulk_id, BAD)
    assert images_of(catalogue, bulk_id) == 0


def test_deletions_and_workers_at_the_same_moment_do_not_block_each_other(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three requests delete a paused run while workers record the images that they had taken."""
    monkeypatch.setattr(bulk_rows, "BATCH", 7)
    before = used(catalogue)
    bulk_id, lease = made(catalogue, 60), turn(catalogue)
    taken = list(all_taken(catalogue, bulk_id, lease))[::-1]
    assert catalogue.bulks.pause(bulk_id)
    with ThreadPoolExecutor(8) as pool:
        recorded = [pool.submit(done, catalogue, one) for one in taken]
        deleted = [pool.submit(catalogue.bulks.delete, bulk_id) for _ in range(3)]
        assert any(one.result() for one in deleted)
        assert [one.result() for one in recorded].count(True) <= 60
    assert catalogue.bulks.get(bulk_id) is None and images_of(catalogue, bulk_id) == 0
    catalogue.uws.destroy(lease.job_id)
    assert used(catalogue) == before


def test_each_transaction_deletes_a_batch_of_images(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    bulk_id, left = made(catalogue, 2 * bulk_progress.BATCH + 1), []
    catalogue.bulks.cancel(bulk_id)
    real = catalogue.bulks._delete_batch

    def counted(*asked: str) -> bool:
        more = real(*asked)
        left.append(images_of(catalogue, bulk_id))
        return more

    monkeypatch.setattr(catalogue.bulks, "_delete_batch", counted)
    assert catalogue.bulks.delete(bulk_id)
    assert left == [bulk_progress.BATCH + 1, 1, 0, 0]


def with_a_failure(catalogue: Catalogue) -> str:
    """A bulk that has ended, with an image that failed."""
    bulk_id, lease = made(catalogue, 2), turn(catalogue)
    first, second = all_taken(catalogue, bulk_id, lease)
    assert done(catalogue, first) and catalogue.bulks.fail(second, BAD)
    return bulk_id


def ends_unseen(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, bulk_id: str) -> None:
    """A bulk ends just before the next look for an open one."""
    database = catalogue.bulks._database
    real = database.reading

    def reading() -> Any:
        catalogue.bulks.cancel(bulk_id)
        return real()

    monkeypatch.setattr(database, "reading", reading)


def test_retry_is_refused_while_an_identical_run_is_open(catalogue: Catalogue) -> None:
    ended = with_a_failure(catalogue)
    other = made(catalogue, 2)
    assert other != ended
    for change, phase in ((catalogue.bulks.pause, "PAUSED"), (catalogue.bulks.resume, "RUNNING")):
        assert change(other)
        with pytest.raises(DataError, match=f"run {other} is {phase}") as refused:
            catalogue.bulks.retry(ended)
        assert refused.value.code == "equal-bulk-open"
        now = row(catalogue, ended)
        assert (now.phase, now.failed) == ("COMPLETED", 1), "nothing of it has changed"
        check_counts(catalogue, ended)
    catalogue.bulks.cancel(other)
    assert catalogue.bulks.retry(ended) == 1 and row(catalogue, ended).phase == "RUNNING"
    check_counts(catalogue, ended)


def test_retry_succeeds_if_the_identical_run_ends_meanwhile(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = with_a_failure(catalogue)
    ends_unseen(catalogue, monkeypatch, made(catalogue, 2))
    assert catalogue.bulks.retry(ended) == 1
    assert row(catalogue, ended).phase == "RUNNING"


def test_a_request_whose_identical_run_ends_meanwhile_makes_a_new_run(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = made(catalogue, 2)
    ends_unseen(catalogue, monkeypatch, first)
    second = made(catalogue, 3)
    assert second != first and row(catalogue, second).total == 3
    check_counts(catalogue, second)


def test_a_second_worker_continues_the_listing_of_a_lost_one(catalogue: Catalogue) -> None:
    bulk_id, lost = made(catalogue, 1, listed=False), turn(catalogue)
    bulks, before = catalogue.bulks, used(catalogue)
    begun = bulks.begin_listing(bulk_id, lost)
    assert begun is not None and begun.listed_to is None
    assert bulks.begin_listing(bulk_id, turn(catalogue)) is None, "another worker lists now"
    assert bulks.add_listed(bulk_id, lost, [Listed("/a", False), Listed("/b", False, BAD)], B)
    catalogue.jobs.give_up_silent(-1.0, 99)
    assert bulks.begin_listing(bulk_id, lost) is None
    other = turn(catalogue)
    begun = bulks.begin_listing(bulk_id, other)
    assert begun is not None and (begun.listed_to, begun.total) == (B, 3)
    assert not bulks.add_listed(bulk_id, lost, [Listed("/z", False)], C), "the lost one adds nothing more"
    assert bulks.add_listed(bulk_id, other, [Listed("/c", False)], C)
    check_counts(catalogue, bulk_id)
    assert not bulks.end_listing(bulk_id, lost) and bulks.end_listing(bulk_id, other)
    assert [one.source[-2:] for one in all_taken(catalogue, bulk_id, other)] == ["00", "/a", "/c"]
    assert row(catalogue, bulk_id).failed == 1
    assert used(catalogue) == before + 3 * ROW_BYTES + 2 * turn_bytes(catalogue, other)


def test_images_are_taken_while_others_are_listed_and_the_run_ends_after_all(catalogue: Catalogue) -> None:
    bulk_id, lister, other = made(catalogue, 0, listed=False), turn(catalogue), turn(catalogue)
    bulks = catalogue.bulks
    assert bulks.begin_listing(bulk_id, lister) is not None and bulks.take(bulk_id, other, 3) is None
    assert bulks.add_listed(bulk_id, lister, [Listed("/a", False)], B)
    first = bulks.take(bulk_id, other, 3)
    assert first is not None and first.source == "/a" and done(catalogue, first)
    assert row(catalogue, bulk_id).phase == "LISTING", (
        "all listed images are done, but not all images are listed"
    )
    assert bulks.add_listed(bulk_id, lister, [Listed("/b", False, BAD), Listed("/c", False)], C)
    (second,) = all_taken(catalogue, bulk_id, lister)
    assert (second.source, second.position) == ("/c", 2) and bulks.fail(second, BAD)
    assert bulks.retry(bulk_id) == 2 and row(catalogue, bulk_id).phase == "LISTING"
    again = list(all_taken(catalogue, bulk_id, other))
    assert [one.source for one in again] == ["/b", "/c"] and all(done(catalogue, one) for one in again)
    assert bulks.end_listing(bulk_id, lister)
    ended = row(catalogue, bulk_id)
    assert (ended.phase, ended.total, ended.done, ended.failed) == ("COMPLETED", 3, 3, 0)
    check_counts(catalogue, bulk_id)


def test_files_that_an_older_version_listed_are_listed_again(catalogue: Catalogue) -> None:
    """It stored no place, and took no file before all were listed."""
    bulk_id, lost = made(catalogue, 2, listed=False), turn(catalogue)
    bulks, before = catalogue.bulks, used(catalogue)
    assert bulks.begin_listing(bulk_id, lost) is not None
    assert bulks.add_listed(bulk_id, lost, [Listed("/a", False), Listed("/b", False, BAD)], B)
    with catalogue._engine.begin() as connection:
        connection.execute(update(BulkRow).where(BulkRow.id == bulk_id).values(listed_to=None))
    begun = bulks.begin_listing(bulk_id, lost)
    assert begun is not None and (begun.total, begun.failed) == (2, 0)
    check_counts(catalogue, bulk_id)
    assert used(catalogue) == before
    assert bulks.add_listed(bulk_id, lost, [Listed("/a", False)], B) and bulks.end_listing(bulk_id, lost)
    assert [one.position for one in all_taken(catalogue, bulk_id, lost)] == [0, 1, 2]


def test_files_whose_paths_cannot_be_stored_are_failed_images(
    catalogue: Catalogue, settings: Settings, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    long = root.joinpath(*(f"{n}" * 200 for n in range(6))) / "long.fits"
    strange = root / os.fsdecode(b"\xff\xfe") / os.fsdecode(b"Sonne\xf6.fits")
    many = root / os.fsdecode(b"\xf6" * 200) / os.fsdecode(b"\xf6" * 200) / "many.fits"
    for path in (root / "a.fits", strange, long, many):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path)
    (root / "loop.fits").symlink_to(root / "loop.fits")
    context = Context(
        catalogue=catalogue, store=Store(tmp_path / "data"), owner="o", job_id="j",
        settings=settings.model_copy(update={"bulk_roots": str(root)}), report=lambda *_: None,
    )  # fmt: skip
    bulk_id, lease = made(catalogue, 0, listed=False), turn(catalogue)
    request = {"files": [{"glob": f"{root}/**/*.fits", "where": {"NAXIS": 2}}]}
    with catalogue._engine.begin() as connection:
        connection.execute(update(BulkRow).where(BulkRow.id == bulk_id).values(request=request))
    begun = catalogue.bulks.begin_listing(bulk_id, lease)
    assert begun is not None
    listing.list_files(context, begun, lease, lambda: None, lambda: False)
    assert row(catalogue, bulk_id).phase == BulkPhase.RUNNING
    (taken,) = all_taken(catalogue, bulk_id, lease)
    assert taken.source == str(root / "a.fits")
    failed = {
        item.error["code"]: item
        for item in catalogue.bulks.progress.items(bulk_id, ItemState.FAILED)
        if item.error
    }
    assert set(failed) == {"unreadable-file", "path-too-long", "path-not-utf-8"}
    assert row(catalogue, bulk_id).failed == 4
    assert failed["unreadable-file"].source == str(root / "loop.fits")
    assert failed["path-too-long"].source == f"{str(long)[:1023]}…"
    message = failed["path-too-long"].error["message"]  # type: ignore[index]
    assert message.startswith(f"expected a path of at most 1024 characters; got {len(str(long))}")
    assert message.endswith("5/long.fits")
    sources = [item.source for item in catalogue.bulks.progress.items(bulk_id, ItemState.FAILED)]
    assert f"{root}/\\xff\\xfe/Sonne\\xf6.fits" in sources
    assert max(map(len, sources)) == matching.MOST_LETTERS == BulkItemRow.__table__.c.source.type.length  # type: ignore[attr-defined]
    check_counts(catalogue, bulk_id)
    assert done(catalogue, taken) and catalogue.bulks.retry(bulk_id) == 1, "no row tells where the others lie"
    assert [one.source for one in all_taken(catalogue, bulk_id, lease)] == [str(root / "loop.fits")]
    check_counts(catalogue, bulk_id)


def test_a_run_paused_while_listing_resumes_listing(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 0, listed=False), turn(catalogue)
    bulks = catalogue.bulks
    assert bulks.begin_listing(bulk_id, lease) and bulks.add_listed(bulk_id, lease, [Listed("/a", False)], B)
    assert bulks.pause(bulk_id) and not bulks.add_listed(bulk_id, lease, [Listed("/b", False)], C)
    assert bulks.take(bulk_id, lease, 3) is None
    assert bulks.resume(bulk_id) and row(catalogue, bulk_id).phase == BulkPhase.LISTING
    begun = bulks.begin_listing(bulk_id, lease)
    assert begun is not None and begun.listed_to == B and begun.total == 1


def test_images_are_sorted_by_artefact_score_over_pages(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 7), turn(catalogue)
    scores = [0.5, 2.0, 0.1, 2.0, 9.0, 0.5]
    for taken, score in zip(all_taken(catalogue, bulk_id, lease), scores, strict=False):
        done(catalogue, taken, score=score)
    found: list[BulkItemRow] = []
    while page := catalogue.bulks.progress.worst(
        bulk_id, after=(found[-1].score or 0.0, found[-1].position) if found else None, limit=2
    ):
        found += page
    assert [item.score for item in found] == sorted(scores, reverse=True)
    assert len({item.position for item in found}) == 6
    assert catalogue.bulks.progress.to_look_at(bulk_id, 1.0) == 3


def test_failed_images_are_counted_by_reason(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    bulk_id, lease = made(catalogue, 7), turn(catalogue)
    assert catalogue.bulks.progress.reasons(bulk_id) == []
    for code in ("bad", None, "worse", "bad", "bad", "also-bad"):
        taken = catalogue.bulks.take(bulk_id, lease, 3)
        assert taken is not None
        if code is None:
            catalogue.bulks.finish(taken, reused=False, **DONE)
        else:
            catalogue.bulks.fail(taken, BAD.model_copy(update={"code": code}))
    found = catalogue.bulks.progress.reasons(bulk_id)
    assert [(one.code, one.images, one.example.position) for one in found] == [
        ("bad", 3, 0), ("also-bad", 1, 5), ("worse", 1, 2),
    ]  # fmt: skip
    monkeypatch.setattr(bulk_progress, "MOST_EXPLAINED", 2)
    found = catalogue.bulks.progress.reasons(bulk_id)
    assert [(one.code, one.images) for one in found] == [("bad", 1), ("worse", 1)], "of the first two"


def test_images_without_a_product_are_the_newest_of_their_owner(catalogue: Catalogue) -> None:
    for number in range(6):
        owner = "other" if number == 5 else "o"
        identity = f"{number:064x}"
        name = f"{number}.fits" if number else None
        catalogue.add(
            ImageRow(owner=owner, id=identity, created_at=float(number), bytes=1, filename=name, summary={})
        )
    details = {
        "owner": "o",
        "kind": "deconvolve",
        "psf_id": "b" * 64,
        "psf_version": "1",
        "bytes": 1,
        "details": {},
    }
    files = {"file_sha256": "d" * 64, "preview_sha256": "e" * 64}
    for owner, number in (("o", 3), ("other", 2)):
        product = ProductRow(
            **{**details, **files, "owner": owner},
            id=f"{90 + number:064x}",
            image_id=f"{number:064x}",
            created_at=9.0,
        )
        catalogue.add(product)
    progress = catalogue.bulks.progress
    ids = [f"{number:064x}" for number in (4, 2, 1, 0)]
    assert list(progress.without_product("o", 10)) == ids
    assert list(progress.without_product("o", 2)) == ids[:2]
    assert progress.names_of_uploads([ids[0], ids[3], f"{5:064x}"], "o") == {ids[0]: "4.fits"}
    assert progress.still_there([f"{93:064x}", f"{92:064x}"], "o") == {f"{93:064x}"}


def test_missing_uploads_are_named(catalogue: Catalogue) -> None:
    catalogue.add(ImageRow(owner="o", id="a" * 64, created_at=1.0, bytes=1, summary={}))
    assert catalogue.bulks.progress.first_not_uploaded(["a" * 64], "o") is None
    assert catalogue.bulks.progress.first_not_uploaded(["a" * 64, "b" * 64], "o") == "b" * 64
    assert catalogue.bulks.progress.first_not_uploaded(["a" * 64], "other") == "a" * 64


def test_fifty_thousand_images(catalogue: Catalogue) -> None:
    """Created in seconds. Taking and finishing one costs as much as in a run of ten, whether few or most are done."""

    def cost(bulk_id: str) -> float:
        lease, times = turn(catalogue), []
        for _ in range(30):
            start = time.perf_counter()
            taken = catalogue.bulks.take(bulk_id, lease, 3)
            assert taken is not None and done(catalogue, taken)
            bulk = row(catalogue, bulk_id)
            catalogue.bulks.progress.pace(bulk), catalogue.bulks.progress.to_look_at(bulk_id, 1.0)
            times.append(time.perf_counter() - start)
        return sorted(times)[len(times) // 2]

    small = cost(made(catalogue, 40, key="small"))
    start = time.perf_counter()
    bulk_id = made(catalogue, 50_000, key="large")
    assert time.perf_counter() - start < 60.0
    first = cost(bulk_id)
    with catalogue._engine.begin() as connection:
        most = update(BulkItemRow).where(BulkItemRow.bulk_id == bulk_id, BulkItemRow.position < 49_000)
        connection.execute(most.values(state="done", score=0.2, ended_at=time.time()))
        connection.execute(update(BulkRow).where(BulkRow.id == bulk_id).values(done=49_000))
    if catalogue._engine.dialect.name == "postgresql":
        with catalogue._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.exec_driver_sql("ANALYZE bulk_items")
    last = cost(bulk_id)
    assert max(first, last) < 5 * small + 0.02
    with catalogue._engine.connect() as connection:
        assert connection.scalar(select(func.count()).select_from(JobRow).where(JobRow.queue == "bulk")) == 3


@pytest.mark.parametrize("gone_s", [0.0, 7200.0])
def test_the_pace_is_that_of_the_last_images(catalogue: Catalogue, gone_s: float) -> None:
    bulk_id, lease = made(catalogue, 20), turn(catalogue)
    for taken in list(all_taken(catalogue, bulk_id, lease))[:12]:
        done(catalogue, taken)
    now = time.time() - gone_s
    with catalogue._engine.begin() as connection:
        for position in range(12):  # one every ten seconds, up to now
            one = update(BulkItemRow).where(BulkItemRow.bulk_id == bulk_id, BulkItemRow.position == position)
            connection.execute(one.values(ended_at=now - 10 * (11 - position)))
        began = update(BulkRow).where(BulkRow.id == bulk_id)
        connection.execute(began.values(running_since=now - 120, ended_at=now if gone_s else None))
    assert catalogue.bulks.progress.pace(row(catalogue, bulk_id)).images_an_hour == pytest.approx(
        360.0, rel=0.05
    )


def test_images_of_open_bulks_are_counted_together(catalogue: Catalogue) -> None:
    assert catalogue.bulks.progress.open_images() == {"left": 0, "done": 0, "failed": 0}
    first, lease = made(catalogue, 3, key="a"), turn(catalogue)
    made(catalogue, 2, key="b")
    one, other, _ = all_taken(catalogue, first, lease)
    done(catalogue, one), catalogue.bulks.fail(other, BAD)
    assert catalogue.bulks.progress.open_images() == {"left": 3, "done": 1, "failed": 1}
    catalogue.bulks.cancel(first)
    assert catalogue.bulks.progress.open_images() == {"left": 2, "done": 0, "failed": 0}


def test_every_query_of_a_run_uses_an_index(catalogue: Catalogue) -> None:
    """No statement scans or sorts all images, of this run or of others."""
    bulk_id, lease = made(catalogue, 50), turn(catalogue)
    bulks = catalogue.bulks
    first, second = bulks.take(bulk_id, lease, 3), bulks.take(bulk_id, lease, 3)
    assert first is not None and second is not None
    bulk = row(catalogue, bulk_id)
    other = made(catalogue, 0, key="listing", listed=False)
    with statements(catalogue) as sent:
        assert bulks.begin_listing(other, lease) and bulks.begin_listing(other, lease) and bulks.cancel(other)
        bulks.progress.sources(other)
        third = bulks.take(bulk_id, lease, 3)
        assert (
            third is not None and done(catalogue, first) and bulks.fail(second, BAD) and bulks.release(third)
        )
        (
            bulks.progress.pace(bulk),
            bulks.progress.to_look_at(bulk_id, 1.0),
            bulks.at_work(),
            bulks.progress.open_images(),
        )
        (
            bulks.progress.items(bulk_id, ItemState.DONE, after=3, limit=51),
            bulks.progress.worst(bulk_id, after=(1.0, 3), limit=51),
            bulks.progress.without_product("o", 51),
            bulks.progress.names_of_uploads(["a" * 64], "o"),
            bulks.progress.still_there(["a" * 64], "o"),
        )
        bulks.progress.done_before("o", "c" * 64, "/out/x.fits"), bulks.retry(bulk_id), bulks.pause(bulk_id)
        catalogue.page(BulkRow, owner="o", limit=51, after=(1.0, "a"))
        assert bulks.delete(bulk_id)
    asked = [one for one in sent if one[0].lstrip().startswith(("SELECT", "UPDATE", "DELETE"))]
    assert len(asked) >= 24
    for statement, parameters in asked:
        steps = plan(catalogue, statement, parameters, forced=True)
        wrong = [step for step in steps if re.search(r"SCAN bulk|TEMP B-TREE|Seq Scan on bulk|Sort", step)]
        assert wrong == [], (statement, steps)
