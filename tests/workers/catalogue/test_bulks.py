"""Bulk runs and their images as rows: taken, lost, done, paused, retried, deleted; consistent counts."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, func, select, update

from psfcore.errors import DataError
from tests.conftest import write_image
from tests.whole.many_rows import plan, statements
from tests.workers.databases import BOTH, change, database, rows
from tests.workers.jobs import bulk_row, claimed
from tests.workers.psf_examples import product
from workers.bulk import listing
from workers.catalogue import bulk_progress
from workers.catalogue import bulks as bulk_rows
from workers.catalogue.bulks import BulkImage, new_id
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import BulkItemRow, BulkRow, ImageRow
from workers.contract.bulk import DELETABLE, BulkPhase, ItemState
from workers.contract.jobs import Fault, JobError
from workers.files.store import Store
from workers.intake.estimates import BULK, factor
from workers.settings import Settings
from workers.tasks.catalogue_workspace import CatalogueWorkspace

B, C = ({"pattern": 0, "names": [name]} for name in "bc")  # places up to which files are listed
BAD = JobError(fault=Fault.USER, code="bad", message="a bad image")
DONE: dict[str, Any] = {
    "image_sha256": "a" * 64, "psf_id": "b" * 64, "product_id": "c" * 64, "kept": True, "output": None,
    "sha256": "d" * 64, "bytes": 5, "score": 0.5, "statistics": {},
}  # fmt: skip


def made(catalogue: Catalogue, images: int, *, key: str = "k", listed: bool = True) -> str:
    """A bulk with uploads as its images."""
    return catalogue.bulks.create(bulk_row("o", key, listed=listed), [f"{n:064x}" for n in range(images)])[
        0
    ].id


def turn(catalogue: Catalogue) -> Lease:
    """A worker's lease of a turn."""
    return claimed(catalogue, catalogue.jobs.submit("bulk", {}, new_id(), "o")[0].id)


def row(catalogue: Catalogue, bulk_id: str) -> BulkRow:
    found = catalogue.bulks.get(bulk_id)
    assert found is not None
    return found


def one_taken(catalogue: Catalogue, bulk_id: str, lease: Lease) -> BulkItemRow:
    taken = catalogue.bulks.take(bulk_id, lease, 3)
    assert taken is not None
    return taken


def done(catalogue: Catalogue, taken: BulkItemRow, *, reused: bool = False, **values: Any) -> bool:
    return catalogue.bulks.finish(taken, reused=reused, **{**DONE, **values})


def all_taken(catalogue: Catalogue, bulk_id: str, lease: Lease) -> Iterator[BulkItemRow]:
    while (taken := catalogue.bulks.take(bulk_id, lease, 3)) is not None:
        yield taken


def check_counts(catalogue: Catalogue, bulk_id: str) -> None:
    """The counts of the run equal those of its images."""
    states = rows(catalogue, select(BulkItemRow.state).where(BulkItemRow.bulk_id == bulk_id))
    bulk = row(catalogue, bulk_id)
    assert (bulk.total, bulk.done, bulk.failed) == (len(states), states.count("done"), states.count("failed"))


def test_images_are_taken_in_order_and_the_last_one_ends_the_bulk(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 3), turn(catalogue)
    taken = list(all_taken(catalogue, bulk_id, lease))
    assert [one.position for one in taken] == [0, 1, 2]
    assert catalogue.bulks.progress.pace(row(catalogue, bulk_id)).taken == 3
    assert done(catalogue, taken[0]) and done(catalogue, taken[1], reused=True)
    assert not done(catalogue, taken[0]) and not catalogue.bulks.fail(taken[0], BAD), "it counts once"
    assert row(catalogue, bulk_id).phase == BulkPhase.RUNNING
    assert catalogue.bulks.fail(taken[2], BAD)
    ended = row(catalogue, bulk_id)
    assert ended.phase == BulkPhase.COMPLETED and ended.ended_at is not None
    assert (ended.total, ended.done, ended.reused, ended.failed) == (3, 2, 1, 1)
    check_counts(catalogue, bulk_id)


@BOTH
def test_many_workers_take_each_image_once(catalogue: Catalogue) -> None:
    bulk_id = made(catalogue, 30)
    leases = [turn(catalogue) for _ in range(6)]

    def work(lease: Lease) -> list[int]:
        positions = []
        for taken in all_taken(catalogue, bulk_id, lease):
            positions.append(taken.position)
            assert done(catalogue, taken)
        return positions

    with ThreadPoolExecutor(6) as pool:
        positions = [position for part in pool.map(work, leases) for position in part]
    assert sorted(positions) == list(range(30))
    assert row(catalogue, bulk_id).phase == BulkPhase.COMPLETED
    check_counts(catalogue, bulk_id)


@BOTH
def test_an_image_of_a_lost_worker_is_taken_by_another_and_fails_with_the_third(catalogue: Catalogue) -> None:
    bulk_id, lost = made(catalogue, 3), turn(catalogue)
    first, other = one_taken(catalogue, bulk_id, lost), turn(catalogue)
    assert [one.position for one in all_taken(catalogue, bulk_id, other)] == [1, 2], "the first one is held"
    catalogue.jobs.give_up_silent(-1.0, 99)  # every worker was silent for longer than that
    other = turn(catalogue)
    second = one_taken(catalogue, bulk_id, other)
    assert second.position == 0
    assert not done(catalogue, first, score=9.0), "the lost one comes back too late"
    assert catalogue.bulks.take(bulk_id, lost, 3) is None, "and gets nothing more"
    assert done(catalogue, second)
    (item,) = catalogue.bulks.progress.items(bulk_id, ItemState.DONE)
    assert (item.attempts, item.score) == (2, 0.5)
    for _ in range(2):
        assert one_taken(catalogue, bulk_id, turn(catalogue)).position == 1
        catalogue.jobs.give_up_silent(-1.0, 99)
    last = one_taken(catalogue, bulk_id, turn(catalogue))
    assert last.position == 2, "the others go on"
    (item,) = catalogue.bulks.progress.items(bulk_id, ItemState.FAILED)
    assert item.error is not None and item.error["code"] == "worker-lost" and item.attempts == 3
    assert done(catalogue, last)
    assert row(catalogue, bulk_id).phase == BulkPhase.COMPLETED
    check_counts(catalogue, bulk_id)


def test_released_paused_resumed_cancelled(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 2), turn(catalogue)
    for _ in range(5):
        taken = one_taken(catalogue, bulk_id, lease)
        assert catalogue.bulks.release(taken), "as if it had not been taken"
    assert not catalogue.bulks.release(taken)
    taken = one_taken(catalogue, bulk_id, lease)
    assert catalogue.bulks.pause(bulk_id)
    assert not catalogue.bulks.pause(bulk_id) and catalogue.bulks.at_work() == []
    assert catalogue.bulks.take(bulk_id, lease, 3) is None
    assert done(catalogue, taken), "what is at work is let end"
    assert catalogue.bulks.resume(bulk_id) and not catalogue.bulks.resume(bulk_id)
    one_taken(catalogue, bulk_id, lease)
    assert catalogue.bulks.cancel(bulk_id)
    assert not catalogue.bulks.cancel(bulk_id) and not catalogue.bulks.resume(bulk_id)
    assert catalogue.bulks.take(bulk_id, lease, 3) is None
    assert catalogue.bulks.retry(bulk_id) is None
    assert row(catalogue, bulk_id).phase == BulkPhase.CANCELLED
    last = made(catalogue, 1)
    taken = one_taken(catalogue, last, lease)
    assert catalogue.bulks.pause(last) and done(catalogue, taken)
    assert row(catalogue, last).phase == BulkPhase.COMPLETED, "the last image ends a run that is paused"


def images_of(catalogue: Catalogue, bulk_id: str) -> int:
    query = select(func.count()).select_from(BulkItemRow).where(BulkItemRow.bulk_id == bulk_id)
    return int(rows(catalogue, query)[0])


def test_a_deleted_run_is_gone_with_its_images(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bulk_rows, "BATCH", 2)
    other, bulks = made(catalogue, 3, key="other"), catalogue.bulks
    for phase in sorted(DELETABLE):
        bulk_id = made(catalogue, 3)
        first, second, third = all_taken(catalogue, bulk_id, turn(catalogue))
        done(catalogue, first, reused=True), bulks.fail(second, BAD)
        match phase:
            case BulkPhase.PAUSED:
                bulks.pause(bulk_id)
            case BulkPhase.ERROR:
                bulks.stop_with(bulk_id, BAD)
            case BulkPhase.CANCELLED:
                bulks.cancel(bulk_id)
            case BulkPhase.COMPLETED:
                done(catalogue, third)
        assert row(catalogue, bulk_id).phase == phase
        assert bulks.delete(bulk_id) and not bulks.delete(bulk_id), phase
        assert bulks.get(bulk_id) is None and images_of(catalogue, bulk_id) == 0
        assert images_of(catalogue, other) == row(catalogue, other).total == 3
    for listed in (True, False):
        bulk_id = made(catalogue, 2, key=f"{listed}", listed=listed)
        phase = row(catalogue, bulk_id).phase
        assert not bulks.delete(bulk_id), "a run at work is not deleted"
        assert row(catalogue, bulk_id).phase == phase and images_of(catalogue, bulk_id) == 2


def test_an_interrupted_deletion_can_be_repeated(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bulk_rows, "BATCH", 2)
    bulk_id = made(catalogue, 7)
    first, second, *_ = all_taken(catalogue, bulk_id, turn(catalogue))
    done(catalogue, first, reused=True), catalogue.bulks.fail(second, BAD), catalogue.bulks.pause(bulk_id)
    deleted: list[str] = []

    @event.listens_for(database(catalogue).engine, "after_cursor_execute")
    def killed_in_the_third(*given: Any) -> None:
        if given[2].startswith("DELETE FROM bulk_items"):
            deleted.append(given[2])
            if len(deleted) == 3:
                raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        catalogue.bulks.delete(bulk_id)
    left = row(catalogue, bulk_id)
    assert (left.phase, left.total, left.done, left.reused, left.failed) == ("CANCELLED", 3, 0, 0, 0)
    check_counts(catalogue, bulk_id)
    assert not catalogue.bulks.resume(bulk_id) and catalogue.bulks.retry(bulk_id) is None
    assert catalogue.bulks.delete(bulk_id) and len(deleted) == 5


def test_a_worker_whose_run_is_deleted_records_nothing(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 3), turn(catalogue)
    first, second, third = all_taken(catalogue, bulk_id, lease)
    assert catalogue.bulks.pause(bulk_id) and catalogue.bulks.delete(bulk_id)
    assert not done(catalogue, first) and not catalogue.bulks.fail(second, BAD)
    assert not catalogue.bulks.release(third) and catalogue.bulks.take(bulk_id, lease, 3) is None
    assert not catalogue.bulks.stop_with(bulk_id, BAD)
    assert images_of(catalogue, bulk_id) == 0


@BOTH
def test_deletions_and_workers_do_not_block(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three requests delete a paused run while workers record the images that they had taken."""
    monkeypatch.setattr(bulk_rows, "BATCH", 7)
    bulk_id = made(catalogue, 30)
    taken = list(all_taken(catalogue, bulk_id, turn(catalogue)))[::-1]
    assert catalogue.bulks.pause(bulk_id)
    with ThreadPoolExecutor(8) as pool:
        recorded = [pool.submit(done, catalogue, one) for one in taken]
        deleted = [pool.submit(catalogue.bulks.delete, bulk_id) for _ in range(3)]
        assert any(one.result() for one in deleted)
        for one in recorded:
            one.result()
    assert catalogue.bulks.get(bulk_id) is None and images_of(catalogue, bulk_id) == 0


def with_a_failure(catalogue: Catalogue) -> str:
    """A bulk that has ended, with an image that failed."""
    bulk_id, lease = made(catalogue, 2), turn(catalogue)
    first, second = all_taken(catalogue, bulk_id, lease)
    assert done(catalogue, first) and catalogue.bulks.fail(second, BAD)
    return bulk_id


def test_failed_images_are_retried_unless_an_identical_run_is_open(catalogue: Catalogue) -> None:
    ended = with_a_failure(catalogue)
    other = made(catalogue, 2)
    assert other != ended
    for act, phase in ((catalogue.bulks.pause, "PAUSED"), (catalogue.bulks.resume, "RUNNING")):
        assert act(other)
        with pytest.raises(DataError, match=f"run {other} is {phase}") as refused:
            catalogue.bulks.retry(ended)
        assert refused.value.code == "equal-bulk-open"
        now = row(catalogue, ended)
        assert (now.phase, now.failed) == ("COMPLETED", 1), "nothing of it has changed"
        check_counts(catalogue, ended)
    assert made(catalogue, 2) == other and made(catalogue, 2, key="other") != other
    assert row(catalogue, other).total == 2
    catalogue.bulks.cancel(other)
    assert catalogue.bulks.retry(ended) == 1
    again = row(catalogue, ended)
    assert (again.phase, again.done, again.failed, again.ended_at) == (BulkPhase.RUNNING, 1, 0, None)
    assert [one.position for one in all_taken(catalogue, ended, turn(catalogue))] == [1]
    assert catalogue.bulks.retry(ended) == 0
    check_counts(catalogue, ended)


@BOTH
def test_equal_requests_and_retries_at_the_same_moment_open_one_run(catalogue: Catalogue) -> None:
    ended = with_a_failure(catalogue)

    def retried(_: int) -> str | None:
        try:
            return ended if catalogue.bulks.retry(ended) else None
        except DataError as refused:
            assert refused.code == "equal-bulk-open"
            return None

    with ThreadPoolExecutor(8) as pool:
        opened = pool.map(lambda n: retried(n) if n % 2 else made(catalogue, 2), range(8))
        assert len(set(opened) - {None}) == 1


@BOTH
def test_a_second_worker_continues_the_listing_of_a_lost_one(catalogue: Catalogue) -> None:
    bulk_id, lost = made(catalogue, 1, listed=False), turn(catalogue)
    bulks = catalogue.bulks
    begun = bulks.begin_listing(bulk_id, lost)
    assert begun is not None and begun.listed_to is None
    assert bulks.begin_listing(bulk_id, turn(catalogue)) is None, "another worker lists now"
    assert bulks.add_listed(bulk_id, lost, [BulkImage("/a", False), BulkImage("/b", False, BAD)], B)
    catalogue.jobs.give_up_silent(-1.0, 99)
    assert bulks.begin_listing(bulk_id, lost) is None
    other = turn(catalogue)
    begun = bulks.begin_listing(bulk_id, other)
    assert begun is not None and (begun.listed_to, begun.total) == (B, 3)
    assert not bulks.add_listed(bulk_id, lost, [BulkImage("/z", False)], C), "the lost one adds nothing more"
    assert bulks.add_listed(bulk_id, other, [BulkImage("/c", False)], C)
    check_counts(catalogue, bulk_id)
    assert not bulks.end_listing(bulk_id, lost) and bulks.end_listing(bulk_id, other)
    assert [one.source[-2:] for one in all_taken(catalogue, bulk_id, other)] == ["00", "/a", "/c"]
    assert row(catalogue, bulk_id).failed == 1


def test_images_are_taken_while_others_are_listed_and_the_run_ends_after_all(catalogue: Catalogue) -> None:
    bulk_id, lister, other = made(catalogue, 0, listed=False), turn(catalogue), turn(catalogue)
    bulks = catalogue.bulks
    assert bulks.begin_listing(bulk_id, lister) is not None and bulks.take(bulk_id, other, 3) is None
    assert bulks.add_listed(bulk_id, lister, [BulkImage("/a", False)], B)
    assert bulks.pause(bulk_id) and not bulks.add_listed(bulk_id, lister, [BulkImage("/b", False)], C)
    assert bulks.take(bulk_id, lister, 3) is None
    assert bulks.resume(bulk_id) and row(catalogue, bulk_id).phase == BulkPhase.LISTING
    begun = bulks.begin_listing(bulk_id, lister)
    assert begun is not None and begun.listed_to == B and begun.total == 1
    first = one_taken(catalogue, bulk_id, other)
    assert first.source == "/a" and done(catalogue, first)
    assert row(catalogue, bulk_id).phase == "LISTING", "all listed images are done, but not all are listed"
    assert bulks.add_listed(bulk_id, lister, [BulkImage("/b", False, BAD), BulkImage("/c", False)], C)
    (second,) = all_taken(catalogue, bulk_id, lister)
    assert (second.source, second.position) == ("/c", 2) and bulks.fail(second, BAD)
    assert bulks.retry(bulk_id) == 2 and row(catalogue, bulk_id).phase == "LISTING"
    again = list(all_taken(catalogue, bulk_id, other))
    assert [one.source for one in again] == ["/b", "/c"] and all(done(catalogue, one) for one in again)
    assert bulks.end_listing(bulk_id, lister)
    ended = row(catalogue, bulk_id)
    assert (ended.phase, ended.total, ended.done, ended.failed) == ("COMPLETED", 3, 3, 0)
    check_counts(catalogue, bulk_id)


def test_paths_that_cannot_be_stored(catalogue: Catalogue, settings: Settings, tmp_path: Path) -> None:
    root = tmp_path / "archive"
    long = root.joinpath(*(f"{n}" * 200 for n in range(6))) / "long.fits"
    strange = root / os.fsdecode(b"\xff\xfe") / os.fsdecode(b"Sonne\xf6.fits")
    many = root / os.fsdecode(b"\xf6" * 200) / os.fsdecode(b"\xf6" * 200) / "many.fits"
    for path in (root / "a.fits", strange, long, many):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path)
    (root / "loop.fits").symlink_to(root / "loop.fits")
    bulk_id, lease = made(catalogue, 0, listed=False), turn(catalogue)
    context = CatalogueWorkspace(
        catalogue=catalogue, store=Store(tmp_path / "data"), owner="o", job_id="j", lease=lease,
        settings=settings.model_copy(update={"bulk_roots": str(root)}), report=lambda *_: None,
    )  # fmt: skip
    request = {"files": [{"glob": f"{root}/**/*.fits", "where": {"NAXIS": 2}}]}
    change(catalogue, update(BulkRow).where(BulkRow.id == bulk_id).values(request=request))
    begun = catalogue.bulks.begin_listing(bulk_id, lease)
    assert begun is not None
    listing.list_files(context, begun, lambda: None, lambda: False)
    assert row(catalogue, bulk_id).phase == BulkPhase.RUNNING
    (taken,) = all_taken(catalogue, bulk_id, lease)
    assert taken.source == str(root / "a.fits")
    items = catalogue.bulks.progress.items(bulk_id, ItemState.FAILED)
    failed = {item.error["code"]: item for item in items if item.error}
    assert set(failed) == {"unreadable-file", "path-too-long", "path-not-utf-8"} and len(items) == 4
    assert row(catalogue, bulk_id).failed == 4
    assert failed["unreadable-file"].source == str(root / "loop.fits")
    assert failed["path-too-long"].source == f"{str(long)[:1023]}…"
    message = failed["path-too-long"].error["message"]  # type: ignore[index]
    assert "1024" in message and str(len(str(long))) in message and "5/long.fits: " in message
    sources = [item.source for item in items]
    assert f"{root}/\\xff\\xfe/Sonne\\xf6.fits" in sources
    assert max(map(len, sources)) == listing.MOST_LETTERS == BulkItemRow.__table__.c.source.type.length  # type: ignore[attr-defined]
    check_counts(catalogue, bulk_id)
    assert done(catalogue, taken) and catalogue.bulks.retry(bulk_id) == 1, "no row tells where the others lie"
    assert [one.source for one in all_taken(catalogue, bulk_id, lease)] == [str(root / "loop.fits")]
    check_counts(catalogue, bulk_id)


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
        taken = one_taken(catalogue, bulk_id, lease)
        if code is None:
            done(catalogue, taken)
        else:
            catalogue.bulks.fail(taken, BAD.model_copy(update={"code": code}))
    reasons = catalogue.bulks.progress.reasons(bulk_id)
    assert [(one.code, one.images, one.example.position) for one in reasons] == [
        ("bad", 3, 0), ("also-bad", 1, 5), ("worse", 1, 2),
    ]  # fmt: skip
    monkeypatch.setattr(bulk_progress, "MOST_EXPLAINED", 2)
    reasons = catalogue.bulks.progress.reasons(bulk_id)
    assert [(one.code, one.images) for one in reasons] == [("bad", 1), ("worse", 1)], "of the first two"


def test_the_newest_images_of_an_owner_without_a_product(catalogue: Catalogue) -> None:
    for number in range(6):
        owner, name = "other" if number == 5 else "o", f"{number}.fits" if number else None
        image = ImageRow(
            owner=owner, id=f"{number:064x}", created_at=float(number), bytes=1, filename=name, summary={}
        )
        catalogue.add(image)
    for owner, number in (("o", 3), ("other", 2)):
        one = product(f"of {number}", "p", owner=owner)
        one.image_id = f"{number:064x}"
        catalogue.add(one)
    progress = catalogue.bulks.progress
    ids = [f"{number:064x}" for number in (4, 2, 1, 0)]
    assert list(progress.without_product("o", 10)) == ids
    assert list(progress.without_product("o", 2)) == ids[:2]
    assert progress.names_of_uploads([ids[0], ids[3], f"{5:064x}"], "o") == {ids[0]: "4.fits"}


def test_the_pace_is_that_of_the_last_images(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 20), turn(catalogue)
    for taken in list(all_taken(catalogue, bulk_id, lease))[:12]:
        done(catalogue, taken)
    for gone_s in (0.0, 7200.0):
        now = time.time() - gone_s
        item, bulk = update(BulkItemRow), update(BulkRow).where(BulkRow.id == bulk_id)
        change(
            catalogue,
            bulk.values(running_since=now - 120, ended_at=now if gone_s else None),
            *(  # one every ten seconds, up to now
                item.where(BulkItemRow.position == n).values(ended_at=now - 10 * (11 - n)) for n in range(12)
            ),
        )
        pace = catalogue.bulks.progress.pace(row(catalogue, bulk_id))
        assert pace.images_an_hour == pytest.approx(360.0, rel=0.05), gone_s


def test_images_of_open_bulks_are_counted_together(catalogue: Catalogue) -> None:
    assert catalogue.bulks.progress.open_images() == {"left": 0, "done": 0, "failed": 0}
    first, lease = made(catalogue, 3, key="a"), turn(catalogue)
    made(catalogue, 2, key="b")
    one, other, _ = all_taken(catalogue, first, lease)
    done(catalogue, one), catalogue.bulks.fail(other, BAD)
    assert catalogue.bulks.progress.open_images() == {"left": 3, "done": 1, "failed": 1}
    catalogue.bulks.cancel(first)
    assert catalogue.bulks.progress.open_images() == {"left": 2, "done": 0, "failed": 0}
    assert catalogue.bulks.progress.ended_images() == {"deconvolved": 1, "reused": 0, "failed": 1}


def test_estimates_learn_from_the_images_of_the_newest_run(catalogue: Catalogue) -> None:
    bulk_id, lease = made(catalogue, 4), turn(catalogue)
    for taken, start_s in zip(all_taken(catalogue, bulk_id, lease), (1.0, 2.0, None, 4.0), strict=True):
        statistics = {"seconds": 3.0} | ({} if start_s is None else {"start_s": start_s})
        assert done(catalogue, taken, statistics=statistics)
    assert sorted(catalogue.bulks.progress.image_times(10)) == [(1.0, 3.0), (2.0, 3.0), (4.0, 3.0)]
    assert factor(BULK, 2.0, catalogue) == pytest.approx(1.5)
    assert factor("deconvolve", 2.0, catalogue) == 1.0, "the images are no jobs"


@BOTH
def test_every_query_of_a_run_uses_an_index(catalogue: Catalogue) -> None:
    """No statement scans or sorts all images, of this run or of others."""
    bulk_id, lease = made(catalogue, 50), turn(catalogue)
    bulks, progress = catalogue.bulks, catalogue.bulks.progress
    first, second = one_taken(catalogue, bulk_id, lease), one_taken(catalogue, bulk_id, lease)
    bulk = row(catalogue, bulk_id)
    other = made(catalogue, 0, key="listing", listed=False)
    with statements() as sent:
        assert bulks.begin_listing(other, lease) and bulks.begin_listing(other, lease) and bulks.cancel(other)
        progress.sources(other)
        third = one_taken(catalogue, bulk_id, lease)
        assert done(catalogue, first) and bulks.fail(second, BAD) and bulks.release(third)
        progress.pace(bulk), progress.to_look_at(bulk_id, 1.0), bulks.at_work(), progress.open_images()
        progress.items(bulk_id, ItemState.DONE, after=3, limit=51)
        progress.worst(bulk_id, after=(1.0, 3), limit=51), progress.without_product("o", 51)
        progress.names_of_uploads(["a" * 64], "o")
        progress.done_before("o", "c" * 64, "/out/x.fits"), bulks.retry(bulk_id), bulks.pause(bulk_id)
        catalogue.page(BulkRow, owner="o", limit=51, after=(1.0, "a"))
        assert bulks.delete(bulk_id)
    queries = [one for one in sent if one[0].lstrip().startswith(("SELECT", "UPDATE", "DELETE"))]
    assert len(queries) >= 24
    for statement, parameters in queries:
        steps = plan(database(catalogue), statement, parameters, forced=True)
        wrong = [step for step in steps if re.search(r"SCAN bulk|TEMP B-TREE|Seq Scan on bulk|Sort", step)]
        assert wrong == [], (statement, steps)
