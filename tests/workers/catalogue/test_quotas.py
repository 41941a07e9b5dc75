"""What counts in an owner's quota, also when several transactions add files at the same moment; and deleted rows."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest

from tests.workers.databases import BOTH
from tests.workers.jobs import claimed, job_row
from tests.workers.psf_examples import OWNER, certify, identity, product, psf, refused
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.quotas import MIB, OverQuota
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow, SolutionRow


def image(number: int, size_bytes: int, owner: str = "o") -> ImageRow:
    return ImageRow(owner=owner, id=f"{number:064x}", created_at=1.0, bytes=size_bytes, summary={})


def send(catalogue: Catalogue, row: ImageRow, quota_mib: int = 1) -> bool:
    """Add a row as an upload; whether it came in."""
    try:
        return catalogue.add(row, quota_mib)[1]
    except OverQuota as over:
        assert over.usage.limit_bytes is not None
        assert over.usage.limit_bytes < over.usage.used_bytes + row.bytes
        return False


@BOTH
def test_simultaneous_uploads_are_accepted_up_to_the_quota(catalogue: Catalogue) -> None:
    with ThreadPoolExecutor(8) as pool:
        came_in = list(pool.map(lambda n: send(catalogue, image(n, MIB // 4)), range(12)))
    assert sum(came_in) == 4
    assert catalogue.quotas.usage("o", 1).used_bytes == MIB
    assert [catalogue.get(ImageRow, f"{n:064x}", "o") is not None for n in range(12)] == came_in


def test_an_owner_s_own_limit_counts_and_results_of_jobs_are_not_held_to_it(catalogue: Catalogue) -> None:
    catalogue.quotas.set_quota("o", 2)
    assert send(catalogue, image(1, 2 * MIB)) and not send(catalogue, image(2, 1))
    catalogue.quotas.set_quota("o", 0)
    assert send(catalogue, image(2, 1))
    catalogue.quotas.set_quota("o", None)
    assert not send(catalogue, image(3, 1)) and send(catalogue, image(3, 1), quota_mib=0)
    assert catalogue.add(image(4, MIB))[1]
    assert catalogue.quotas.usage("o", 1).used_bytes == 3 * MIB + 2


def solution(number: int, size_bytes: int, owner: str = "o") -> SolutionRow:
    name = f"{number:064x}"
    return SolutionRow(owner=owner, id=name, created_at=float(number), bytes=size_bytes, file_sha256=name)


def kept(catalogue: Catalogue) -> list[str]:
    """Owner and number of each kept solution."""
    return sorted(f"{row.owner}{int(row.id, 16)}" for row in catalogue.quotas.solutions_before(1e9))


@BOTH
def test_the_oldest_solutions_make_room_for_an_upload(catalogue: Catalogue) -> None:
    for number in (2, 1, 3):
        assert catalogue.add(solution(number, MIB // 4), 1)[1]
    assert catalogue.add(solution(1, MIB // 4, owner="p"), 1)[1]
    usage = catalogue.quotas.usage("o", 1)
    assert (usage.used_bytes, usage.removable_bytes) == (3 * MIB // 4, 3 * MIB // 4)
    assert usage.allows(MIB) and not usage.allows(MIB + 1)
    assert send(catalogue, image(9, MIB // 2)) and kept(catalogue) == ["o2", "o3", "p1"]
    assert not send(catalogue, image(8, MIB)) and kept(catalogue) == ["o2", "o3", "p1"]
    assert send(catalogue, image(7, MIB // 2)) and kept(catalogue) == ["p1"]
    assert catalogue.quotas.usage("o", 1).full


def test_a_new_solution_takes_the_room_of_older_ones_only_and_is_forgotten_once(catalogue: Catalogue) -> None:
    assert send(catalogue, image(1, MIB // 2))
    for number in (1, 2):
        assert catalogue.add(solution(number, MIB // 2), 1)[1]
    assert kept(catalogue) == ["o2"] and catalogue.get(ImageRow, f"{1:064x}", "o") is not None
    assert not catalogue.quotas.usage("o", 1).full, "jobs run: a solution is no file that must stay"
    with pytest.raises(OverQuota):
        catalogue.add(solution(3, MIB), 1)
    assert kept(catalogue) == ["o2"]
    assert catalogue.quotas.solutions_before(2.0) == []
    old = catalogue.quotas.solutions_before(3.0)
    for _ in range(2):
        catalogue.quotas.forget_solutions(old)
    assert kept(catalogue) == [] and catalogue.quotas.usage("o", 0).used_bytes == MIB // 2


@BOTH
def test_the_files_of_each_kind_count_and_nobody_else_s(catalogue: Catalogue) -> None:
    for new in (True, False):
        rows = [psf("a", bytes=5), product("p", "a"), image(1, 7, OWNER), solution(2, 11, OWNER)]
        assert [catalogue.add(row)[1] for row in rows] == [new] * 4
    catalogue.add(image(1, 13, "somebody"))
    usage = catalogue.quotas.usage(OWNER, 1)
    assert usage.used_bytes == sum(row.bytes for row in rows) and usage.removable_bytes == 11
    assert [one.owner for one in catalogue.quotas.all(1)] == sorted([OWNER, "somebody"])
    assert catalogue.quotas.limited(OWNER, 1) == usage and catalogue.quotas.limited(OWNER, 0) is None


# Deletions ------------------------------------------------------------------------------------------


def made_by_a_job(catalogue: Catalogue, result_id: str) -> str:
    """The id of a completed job with this result."""
    row, _ = catalogue.jobs.submit("psf-build", {}, result_id, OWNER)
    lease = claimed(catalogue, row.id)
    assert catalogue.jobs.complete(lease, result_id)
    return row.id


def test_a_draft_is_deleted_unless_something_uses_it(catalogue: Catalogue) -> None:
    for name in ("free", "used", "parent", "asked", "certified"):
        catalogue.add(psf(name))
    catalogue.add(product("of used", "used"))
    catalogue.add(psf("child", details={"parents": {"psf": identity("parent")}}))
    certify(catalogue, "certified", "1.0.0")
    catalogue.jobs.submit("psf-tables", {"psf_id": identity("asked")}, "k" * 64, OWNER)
    for name, code, told in (
        ("used", "psf-in-use", f"`heliopsf product delete {identity('product of used')[:12]}`"),
        ("parent", "psf-in-use", ""),
        ("asked", "psf-in-use", ""),
        ("certified", "not-a-draft", ""),
        ("never", "no-such-psf", ""),
    ):
        assert told in refused(code, partial(catalogue.delete_draft, identity(name), OWNER))
    before = catalogue.quotas.usage(OWNER, 0).used_bytes
    free = catalogue.get(PsfRow, identity("free"), OWNER)
    assert free is not None and catalogue.delete_draft(free.id, OWNER).name == "free"
    assert catalogue.get(PsfRow, identity("free"), OWNER) is None
    assert catalogue.quotas.usage(OWNER, 0).used_bytes == before - free.bytes


def test_a_deleted_result_is_made_again_by_a_new_job(catalogue: Catalogue) -> None:
    catalogue.add(psf("built"))
    catalogue.add(product("p", "other"))
    results = (identity("built"), identity("product p"))
    jobs = [made_by_a_job(catalogue, result) for result in results]
    for result, job in zip(results, jobs, strict=True):
        assert catalogue.jobs.submit("psf-build", {}, result, OWNER)[0].id == job
    catalogue.delete_draft(results[0], OWNER)
    assert catalogue.delete(ProductRow, results[1], OWNER) and not catalogue.delete(
        ProductRow, results[1], OWNER
    )
    assert catalogue.get(ProductRow, results[1], OWNER) is None
    for result, job in zip(results, jobs, strict=True):
        row, new = catalogue.jobs.submit("psf-build", {}, result, OWNER)
        assert new and row.id != job
        kept = job_row(catalogue, job)
        assert kept.result_id == result, "the history of jobs stays"


def test_files_that_a_row_of_any_owner_names_are_found(catalogue: Catalogue) -> None:
    catalogue.add(psf("one", details={"tables_sha256": "a" * 64}))
    catalogue.add(product("p", "one", owner="bob"))
    catalogue.jobs.submit("psf-tables", {"psf_id": "b" * 64}, "c" * 64, OWNER)
    named = {identity("file of one"), "a" * 64, identity("file p"), identity("preview")}
    asked = frozenset({*named, "b" * 64, "d" * 64})
    assert catalogue.named_files.among(asked) == named
