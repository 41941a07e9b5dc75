"""What counts in an owner's quota, and that it is kept when several transactions add rows at the same moment."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from sqlalchemy import select

from tests.whole.many_rows import statements
from tests.workers.databases import BOTH, rows
from tests.workers.jobs import bulk_row, claimed, job_row
from tests.workers.psf_examples import OWNER, certify, identity, psf
from workers.catalogue.bulks import Listed, new_id
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.contexts import Pin
from workers.catalogue.owners import COUNTED, MIB, ROW_BYTES, OverQuota, counted_bytes
from workers.catalogue.psfs import StatusAsked
from workers.catalogue.tables import ImageRow, JobRow, SolutionRow
from workers.versions.status import PsfStatus

ROW = ROW_BYTES + len("{}")  # what the row of such an image counts, besides its file


def image(number: int, counted: int, owner: str = "o") -> ImageRow:
    """An image that counts this number of bytes: its file and its row."""
    return ImageRow(owner=owner, id=f"{number:064x}", created_at=1.0, bytes=counted - ROW, summary={})


def send(catalogue: Catalogue, row: ImageRow, quota_mib: int = 1) -> bool:
    """Add a row as an upload; whether it came in."""
    try:
        return catalogue.add(row, quota_mib)[1]
    except OverQuota as over:
        assert over.usage.limit_bytes is not None
        assert over.usage.limit_bytes < over.usage.used_bytes + counted_bytes(row)
        return False


@BOTH
def test_simultaneous_uploads_are_accepted_up_to_the_quota(catalogue: Catalogue) -> None:
    with ThreadPoolExecutor(8) as pool:
        came_in = list(pool.map(lambda n: send(catalogue, image(n, MIB // 4)), range(12)))
    assert sum(came_in) == 4
    assert catalogue.owners.usage("o", 1).used_bytes == MIB and catalogue.owners.recount() == []
    assert [catalogue.get(ImageRow, f"{n:064x}", "o") is not None for n in range(12)] == came_in


def test_an_owner_s_own_limit_counts_and_results_of_jobs_are_not_held_to_it(catalogue: Catalogue) -> None:
    catalogue.owners.set_quota("o", 2)
    assert send(catalogue, image(1, 2 * MIB)) and not send(catalogue, image(2, ROW))
    catalogue.owners.set_quota("o", 0)
    assert send(catalogue, image(2, ROW))
    catalogue.owners.set_quota("o", None)
    assert not send(catalogue, image(3, ROW)) and send(catalogue, image(3, ROW), quota_mib=0)
    assert catalogue.add(image(4, MIB))[1]
    assert catalogue.owners.usage("o", 1).used_bytes == 3 * MIB + 2 * ROW


def solution(number: int, size_bytes: int, owner: str = "o") -> SolutionRow:
    name = f"{number:064x}"
    return SolutionRow(owner=owner, id=name, created_at=float(number), bytes=size_bytes, file_sha256=name)


def kept(catalogue: Catalogue) -> list[str]:
    """Owner and number of each kept solution."""
    return sorted(f"{row.owner}{int(row.id, 16)}" for row in catalogue.owners.solutions_before(1e9))


@BOTH
def test_the_oldest_solutions_make_room_for_an_upload(catalogue: Catalogue) -> None:
    for number in (2, 1, 3):
        assert catalogue.add(solution(number, MIB // 4), 1)[1]
    assert catalogue.add(solution(1, MIB // 4, owner="p"), 1)[1]
    usage = catalogue.owners.usage("o", 1)
    assert (usage.used_bytes, usage.removable_bytes) == (3 * MIB // 4, 3 * MIB // 4)
    assert usage.allows(MIB) and not usage.allows(MIB + 1)
    assert send(catalogue, image(9, MIB // 2)) and kept(catalogue) == ["o2", "o3", "p1"]
    assert not send(catalogue, image(8, MIB)) and kept(catalogue) == ["o2", "o3", "p1"]
    assert send(catalogue, image(7, MIB // 2)) and kept(catalogue) == ["p1"]
    assert catalogue.owners.usage("o", 1).full and catalogue.owners.recount() == []


def test_a_new_solution_takes_the_room_of_older_ones_only_and_is_forgotten_once(catalogue: Catalogue) -> None:
    assert send(catalogue, image(1, MIB // 2))
    for number in (1, 2):
        assert catalogue.add(solution(number, MIB // 2), 1)[1]
    assert kept(catalogue) == ["o2"] and catalogue.get(ImageRow, f"{1:064x}", "o") is not None
    assert not catalogue.owners.usage("o", 1).full, "jobs run: a solution is no file that must stay"
    with pytest.raises(OverQuota):
        catalogue.add(solution(3, MIB), 1)
    assert kept(catalogue) == ["o2"] and catalogue.owners.recount() == []
    assert catalogue.owners.solutions_before(2.0) == []
    old = catalogue.owners.solutions_before(3.0)
    for _ in range(2):
        catalogue.owners.forget_solutions(old)
    assert kept(catalogue) == [] and catalogue.owners.usage("o", 0).used_bytes == MIB // 2


def test_the_json_of_a_row_counts_too_and_when_it_changes(catalogue: Catalogue) -> None:
    row = psf("a", bytes=5, details={"text": "sun \u2609" * 100})
    assert catalogue.add(row)[1]
    before = catalogue.owners.usage(OWNER, 0).used_bytes
    assert before == 5 + ROW_BYTES + len(json.dumps(row.details))
    catalogue.psfs.describe(row.id, OWNER, tables_sha256="b" * 64, preview_sha256="c" * 64)
    assert catalogue.owners.usage(OWNER, 0).used_bytes == before + len(', "tables_sha256": ""') + 64
    assert catalogue.owners.recount() == []


# Rows without files -----------------------------------------------------------------------------------


@contextmanager
def counting(catalogue: Catalogue, expected: int) -> Iterator[None]:
    """Check that the block changes the count of the owner by so much, and that a recount agrees."""
    before = catalogue.owners.usage(OWNER, 0).used_bytes
    yield
    assert catalogue.owners.usage(OWNER, 0).used_bytes - before == expected
    assert catalogue.owners.recount() == []


def ids(count: int) -> list[str]:
    return [f"{number:064x}" for number in range(count)]


def test_jobs_count_with_their_present_parameters_until_they_are_destroyed(catalogue: Catalogue) -> None:
    parameters = {"instrument_file": "sun \u2609" * 100}
    with counting(catalogue, ROW_BYTES + len(json.dumps(parameters))):
        job, _ = catalogue.jobs.submit("psf-build", parameters, "k", OWNER)
    with counting(catalogue, 0):  # a shared job, and what a job goes through
        assert not catalogue.jobs.submit("psf-build", parameters, "k", OWNER)[1]
        lease = claimed(catalogue, job.id)
        assert catalogue.jobs.complete(lease, "r")
    with counting(catalogue, -ROW_BYTES - len(json.dumps(parameters))):
        assert catalogue.uws.destroy(job.id) and not catalogue.uws.destroy(job.id)
    with counting(catalogue, ROW_BYTES + len('{"size": "64"}')):
        job = catalogue.uws.draft("psf-build", {"size": "64"}, owner=OWNER)
    with counting(catalogue, len(', "a": "bc"')):
        assert catalogue.uws.amend(job.id, lambda given: given | {"a": "bc"})
    given = {"size": "64", "a": "bc"}
    with counting(catalogue, len('{"size": 64}') - len(json.dumps(given))):
        assert catalogue.uws.start(job.id, given, {"size": 64}, "k")
    with counting(catalogue, 0):
        assert not catalogue.uws.amend(job.id, lambda given: given | {"more": "x" * 100})
        assert not catalogue.uws.start(job.id, given, {"size": 128}, "k")
    with counting(catalogue, -ROW_BYTES - len('{"size": 64}')):
        assert catalogue.uws.destroy(job.id)


def test_bulk_runs_parts_contexts_and_changes_count(catalogue: Catalogue) -> None:
    turn, _ = catalogue.jobs.submit("bulk", {}, new_id(), OWNER)
    lease = claimed(catalogue, turn.id)
    row = bulk_row(OWNER, listed=False)
    with counting(catalogue, ROW_BYTES * (1 + 3) + len("{}")):
        assert catalogue.bulks.create(row, ids(3))[1]
    with counting(catalogue, 0):
        assert not catalogue.bulks.create(bulk_row(OWNER, listed=False), ids(3))[1], "the same run"
    with counting(catalogue, 2 * ROW_BYTES):
        assert catalogue.bulks.begin_listing(row.id, lease)
        listed = [Listed("/a", False), Listed("/b", False)]
        assert catalogue.bulks.add_listed(row.id, lease, listed, {"pattern": 0, "names": ["b"]})
    with counting(catalogue, 0):
        assert catalogue.bulks.begin_listing(row.id, lease)
    with counting(catalogue, 4 * ROW_BYTES):
        catalogue.parts.open(OWNER, "k", 3)
        catalogue.parts.open(OWNER, "k", 4)
    for name in ("a", "b"):
        catalogue.add(psf(name))
    with counting(catalogue, ROW_BYTES):
        certify(catalogue, "a", "1.0.0")
    with counting(catalogue, 2 * ROW_BYTES):  # of both PSFs
        certify(catalogue, "b", "2.0.0", supersedes=(identity("a"),))
    for new, expected in ((True, 2 * ROW_BYTES), (False, 0)):
        with counting(catalogue, expected):
            assert catalogue.contexts.create("first", OWNER, "x", pins=[Pin(identity("b"))])[1] == new
    with counting(catalogue, ROW_BYTES):
        catalogue.contexts.set_default("first", OWNER, "x")


def certification(**more: str) -> StatusAsked:
    return StatusAsked(PsfStatus.CERTIFIED, "tested", **more)


ADDED: dict[str, Callable[[Catalogue], object]] = {
    "job": lambda catalogue: catalogue.jobs.submit("psf-build", {}, "new", OWNER, quota_mib=1),
    "uws": lambda catalogue: catalogue.uws.draft("psf-build", {}, owner=OWNER, quota_mib=1),
    "bulk": lambda catalogue: catalogue.bulks.create(bulk_row(OWNER), ids(1), 1),
    "context": lambda catalogue: catalogue.contexts.create("c", OWNER, "x", quota_mib=1),
    "default": lambda catalogue: catalogue.contexts.set_default(None, OWNER, "x", quota_mib=1),
    "range": lambda catalogue: catalogue.psfs.change(identity("a"), OWNER, certification(), "x", 1),
    "certification": lambda catalogue: catalogue.psfs.change(
        identity("b"), OWNER, certification(version="2.0.0"), "x", 1
    ),
}


def test_rows_over_the_quota_are_refused_and_add_nothing(catalogue: Catalogue) -> None:
    catalogue.add(psf("a"))
    certify(catalogue, "a", "1.0.0")
    catalogue.add(psf("b", channel="304"))
    draft = catalogue.uws.draft("psf-build", {}, owner=OWNER)
    used = catalogue.owners.usage(OWNER, 1).used_bytes
    catalogue.add(image(15, MIB - used - 100, OWNER))
    there = {"psfs": 2, "psf_changes": 1, "images": 1, "jobs": 1}
    with counting(catalogue, 0):
        for name, add in ADDED.items():
            with pytest.raises(OverQuota) as refused:
                add(catalogue)
            assert refused.value.usage.used_bytes == MIB - 100, name
            counts = {table.__tablename__: len(rows(catalogue, select(table))) for table in COUNTED}
            assert {table: count for table, count in counts.items() if count} == there, name
        with pytest.raises(OverQuota):
            catalogue.uws.amend(draft.id, lambda given: {"a": "b" * 100}, 1)
        job = job_row(catalogue, draft.id)
        assert job.parameters == {}, "a pending job does not grow either"
    catalogue.owners.set_quota(OWNER, 2)
    for add in ADDED.values():
        add(catalogue)
    assert catalogue.owners.usage(OWNER, 1).used_bytes > MIB
    catalogue.owners.set_quota(OWNER, None)
    with counting(catalogue, ROW_BYTES):
        wrong = StatusAsked(PsfStatus.DEPRECATED, "wrong")
        changed = catalogue.psfs.change(identity("a"), OWNER, wrong, "x", 1)
        assert changed.status == "deprecated", "a wrong PSF is deprecated whatever the quota"


@BOTH
def test_simultaneous_jobs_are_accepted_up_to_the_quota(catalogue: Catalogue) -> None:
    catalogue.add(image(15, MIB - 4 * ROW, OWNER))

    def submit(number: int) -> bool:
        try:
            return catalogue.jobs.submit("psf-build", {}, str(number), OWNER, quota_mib=1)[1]
        except OverQuota:
            return False

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(submit, range(12))) == 4
    assert catalogue.owners.usage(OWNER, 1).used_bytes == MIB and catalogue.owners.recount() == []
    assert len(catalogue.page(JobRow, owner=OWNER, limit=99)) == 4


def test_a_large_bulk_run_is_counted_in_one_statement_and_a_refused_one_adds_no_row(
    catalogue: Catalogue,
) -> None:
    with statements() as sent, counting(catalogue, ROW_BYTES * 3001 + len("{}")):
        catalogue.bulks.create(bulk_row(OWNER), ids(3000), 4)
    assert sum(one.startswith(("INSERT INTO owners", "UPDATE owners")) for one, _ in sent) == 1
    with statements() as sent, pytest.raises(OverQuota):
        catalogue.bulks.create(bulk_row(OWNER, "other"), ids(3000), 4)
    assert not [one for one, _ in sent if one.startswith("INSERT")], "nothing is written to be removed again"
