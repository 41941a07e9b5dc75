"""Quotas are kept when several transactions add files at the same moment."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.owners import MIB, OverQuota
from workers.catalogue.tables import ImageRow


def image(number: int, size_bytes: int) -> ImageRow:
    return ImageRow(owner="o", id=f"{number:064x}", created_at=1.0, bytes=size_bytes, summary={})


def send(catalogue: Catalogue, row: ImageRow, quota_mib: int = 1) -> bool:
    """Add a row as an upload; whether it came in."""
    try:
        return catalogue.add(row, quota_mib)[1]
    except OverQuota as over:
        assert over.usage.limit_bytes is not None
        assert over.usage.limit_bytes < over.usage.used_bytes + row.bytes
        return False


def test_simultaneous_uploads_are_accepted_up_to_the_quota(catalogue: Catalogue) -> None:
    with ThreadPoolExecutor(8) as pool:
        came_in = list(pool.map(lambda n: send(catalogue, image(n, MIB // 4)), range(12)))
    assert sum(came_in) == 4
    assert catalogue.owners.usage("o", 1).used_bytes == MIB and catalogue.owners.recount() == []
    assert [catalogue.get(ImageRow, f"{n:064x}", "o") is not None for n in range(12)] == came_in


def test_an_owner_s_own_limit_counts(catalogue: Catalogue) -> None:
    catalogue.owners.set_quota("o", 2)
    assert send(catalogue, image(1, 2 * MIB)) and not send(catalogue, image(2, 1))
    catalogue.owners.set_quota("o", 0)
    assert send(catalogue, image(2, 1))
    catalogue.owners.set_quota("o", None)
    assert not send(catalogue, image(3, 1)) and send(catalogue, image(3, 1), quota_mib=0)


@pytest.mark.parametrize("size_bytes", [0, MIB])
def test_results_of_jobs_are_not_held_to_the_quota(catalogue: Catalogue, size_bytes: int) -> None:
    assert send(catalogue, image(1, MIB))
    assert catalogue.add(image(2, size_bytes))[1]
    assert catalogue.owners.usage("o", 1).used_bytes == MIB + size_bytes
