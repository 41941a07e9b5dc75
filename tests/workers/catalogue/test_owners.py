"""Quotas are kept when several transactions add files at the same moment."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

import pytest

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.owners import MIB, ROW_BYTES, OverQuota, counted_bytes
from workers.catalogue.tables import ImageRow, PsfRow, SolutionRow

ROW = ROW_BYTES + len("{}")  # what the row of such an image counts, besides its file


def image(number: int, counted: int) -> ImageRow:
    """An image that counts this number of bytes: its file and its row."""
    return ImageRow(owner="o", id=f"{number:064x}", created_at=1.0, bytes=counted - ROW, summary={})


def send(catalogue: Catalogue, row: ImageRow, quota_mib: int = 1) -> bool:
    """Add a row as an upload; whether it came in."""
    try:
        return catalogue.add(row, quota_mib)[1]
    except OverQuota as over:
        assert over.usage.limit_bytes is not None
        assert over.usage.limit_bytes < over.usage.used_bytes + counted_bytes(row)
        return False


def test_simultaneous_uploads_are_accepted_up_to_the_quota(catalogue: Catalogue) -> None:
    with ThreadPoolExecutor(8) as pool:
        came_in = list(pool.map(lambda n: send(catalogue, image(n, MIB // 4)), range(12)))
    assert sum(came_in) == 4
    assert catalogue.owners.usage("o", 1).used_bytes == MIB and catalogue.owners.recount() == []
    assert [catalogue.get(ImageRow, f"{n:064x}", "o") is not None for n in range(12)] == came_in


def test_an_owner_s_own_limit_counts(catalogue: Catalogue) -> None:
    catalogue.owners.set_quota("o", 2)
    assert send(catalogue, image(1, 2 * MIB)) and not send(catalogue, image(2, ROW))
    catalogue.owners.set_quota("o", 0)
    assert send(catalogue, image(2, ROW))
    catalogue.owners.set_quota("o", None)
    assert not send(catalogue, image(3, ROW)) and send(catalogue, image(3, ROW), quota_mib=0)


@pytest.mark.parametrize("size_bytes", [ROW, MIB])
def test_results_of_jobs_are_not_held_to_the_quota(catalogue: Catalogue, size_bytes: int) -> None:
    assert send(catalogue, image(1, MIB))
    assert catalogue.add(image(2, size_bytes))[1]
    assert catalogue.owners.usage("o", 1).used_bytes == MIB + size_bytes


def solution(number: int, size_bytes: int, owner: str = "o") -> SolutionRow:
    identity = f"{number:064x}"
    return SolutionRow(
        owner=owner, id=identity, created_at=float(number), bytes=size_bytes, file_sha256=identity
    )


def kept(catalogue: Catalogue) -> list[str]:
    """Owner and number of each kept solution."""
    return sorted(f"{row.owner}{int(row.id, 16)}" for row in catalogue.owners.solutions_before(1e9))


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


def test_a_new_solution_takes_the_room_of_older_ones_only(catalogue: Catalogue) -> None:
    assert send(catalogue, image(1, MIB // 2))
    for number in (1, 2):
        assert catalogue.add(solution(number, MIB // 2), 1)[1]
    assert kept(catalogue) == ["o2"] and catalogue.get(ImageRow, f"{1:064x}", "o") is not None
    with pytest.raises(OverQuota):
        catalogue.add(solution(3, MIB), 1)
    assert kept(catalogue) == ["o2"] and catalogue.owners.recount() == []


def test_jobs_run_if_only_solutions_fill_the_quota(catalogue: Catalogue) -> None:
    assert catalogue.add(solution(1, MIB), 1)[1]
    assert not catalogue.owners.usage("o", 1).full


def test_a_solution_is_forgotten_once(catalogue: Catalogue) -> None:
    catalogue.add(solution(1, 10))
    rows = catalogue.owners.solutions_before(2.0)
    assert catalogue.owners.solutions_before(1.0) == []
    catalogue.owners.forget_solutions(rows)
    catalogue.owners.forget_solutions(rows)
    assert kept(catalogue) == [] and catalogue.owners.usage("o", 0).used_bytes == 0


def test_the_json_of_a_row_counts_too_and_when_it_changes(catalogue: Catalogue) -> None:
    identity = "a" * 64
    psf = PsfRow(
        owner="o", id=identity, created_at=1.0, name="n", version="1", kind="total", status="draft", origin="uploaded",
        file_sha256=identity, bytes=5, details={"text": "sun \u2609" * 100},
    )  # fmt: skip
    assert catalogue.add(psf)[1]
    before = catalogue.owners.usage("o", 0).used_bytes
    assert before == 5 + ROW_BYTES + len(json.dumps(psf.details))
    catalogue.psfs.describe(identity, "o", tables_sha256="b" * 64, preview_sha256="c" * 64)
    assert catalogue.owners.usage("o", 0).used_bytes == before + len(', "tables_sha256": ""') + 64
    assert catalogue.owners.recount() == []
