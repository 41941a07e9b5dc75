"""Rows that are deleted, on both databases: bytes, jobs that made them, and files that other rows still name."""

from __future__ import annotations

import pytest

from psfcore.errors import DataError
from tests.workers.jobs import claimed, job_row
from tests.workers.psf_examples import OWNER, certify, identity, product, psf
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ProductRow, PsfRow


def refused(catalogue: Catalogue, name: str) -> str:
    with pytest.raises(DataError) as caught:
        catalogue.delete_draft(identity(name), OWNER)
    return caught.value.code


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
    assert [refused(catalogue, name) for name in ("used", "parent", "asked", "certified", "never")] == [
        "psf-in-use", "psf-in-use", "psf-in-use", "not-a-draft", "no-such-psf",
    ]  # fmt: skip
    with pytest.raises(DataError) as caught:
        catalogue.delete_draft(identity("used"), OWNER)
    product_id = identity("product of used")[:12]
    assert f"delete that product first: `heliopsf product delete {product_id}`" in caught.value.message
    before = catalogue.owners.usage(OWNER, 0).used_bytes
    free = catalogue.get(PsfRow, identity("free"), OWNER)
    assert free is not None and catalogue.delete_draft(free.id, OWNER).name == "free"
    assert catalogue.get(PsfRow, identity("free"), OWNER) is None
    assert catalogue.owners.usage(OWNER, 0).used_bytes == before - free.bytes


def test_a_deleted_result_is_made_again_by_a_new_job(catalogue: Catalogue) -> None:
    catalogue.add(psf("built"))
    catalogue.add(product("p", "other"))
    results = (identity("built"), identity("product p"))
    jobs = [made_by_a_job(catalogue, result) for result in results]
    for result, job in zip(results, jobs, strict=True):
        assert catalogue.jobs.submit("psf-build", {}, result, OWNER)[0].id == job
    catalogue.delete_draft(results[0], OWNER)
    assert catalogue.delete_product(results[1], OWNER) and not catalogue.delete_product(results[1], OWNER)
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
