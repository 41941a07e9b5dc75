"""What is older than the operator keeps it is deleted, after a dry run; what is in use stays."""

from __future__ import annotations

import time
import uuid
from pathlib import Path

import pytest
from pydantic import ValidationError

from tests.s3 import digests, kept
from tests.workers.databases import BOTH, add
from tests.workers.jobs import bulk_row
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, JobRow, ReportRow
from workers.contract.bulk import BulkPhase
from workers.contract.jobs import Phase
from workers.files.collection import DAY_S, retain
from workers.files.store import Store
from workers.settings import Settings

OLD, NEW = time.time() - 40 * DAY_S, time.time() - 2 * DAY_S


def keeping(rules: str, *, dry_run: bool = False) -> Settings:
    return Settings(keep_days=rules, keep_dry_run=dry_run)


def report(catalogue: Catalogue, digest: str, owner: str, made_at: float) -> str:
    row = ReportRow(
        owner=owner, id=uuid.uuid4().hex * 2, created_at=made_at, kind="k", file_sha256=digest, bytes=7, details={}
    )  # fmt: skip
    return catalogue.add(row)[0].id


@BOTH
def test_the_rule_of_an_owner_replaces_the_general_one(catalogue: Catalogue, tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    files = {name: kept(store, name.encode()) for name in ("old", "new", "bob", "shared")}
    report(catalogue, files["old"], "ann", OLD)
    report(catalogue, files["shared"], "ann", OLD)
    for name in ("new", "shared"):
        report(catalogue, files[name], "ann", NEW)
    report(catalogue, files["bob"], "bob", OLD)
    rules = "report=30, bob/report=90"
    expected = {("ann", "report"): [7, 7]}
    assert retain(catalogue, store, keeping(rules, dry_run=True)) == expected
    assert digests(store) == set(files.values())
    assert retain(catalogue, store, keeping(rules)) == expected
    assert digests(store) == set(files.values()) - {files["old"]}, "another report has the shared file"
    assert retain(catalogue, store, keeping(rules)) == {}
    assert retain(catalogue, store, keeping("bob/report=30")) == {("bob", "report"): [7]}


def test_uploads_in_use_stay_and_jobs_and_runs_go_by_their_end(catalogue: Catalogue, tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    ids = [kept(store, name) for name in (b"free", b"of a job", b"of a run")]
    for identity in ids:
        catalogue.add(ImageRow(owner="ann", id=identity, created_at=OLD, bytes=1, summary={}))

    def job(phase: Phase, ended_at: float | None, **parameters: str) -> JobRow:
        key = uuid.uuid4().hex
        return JobRow(
            id=key, owner="ann", kind="deconvolve", parameters=parameters, request_key=key, work_key=key,
            phase=phase, created_at=OLD, ended_at=ended_at,
        )  # fmt: skip

    add(catalogue, job(Phase.QUEUED, None, image_id=ids[1]), job(Phase.ERROR, OLD), job(Phase.COMPLETED, NEW))
    catalogue.bulks.create(bulk_row("ann", created_at=OLD), [ids[2]])
    add(catalogue, bulk_row("ann", "ended", phase=BulkPhase.COMPLETED, created_at=OLD, ended_at=OLD))
    deleted = retain(catalogue, store, keeping("image=30,job=30,bulk=30"))
    assert {kind: len(sizes) for (_, kind), sizes in deleted.items()} == {"image": 1, "job": 1, "bulk": 1}
    assert digests(store) == set(ids[1:])


def test_rules_are_checked() -> None:
    for rules in ("psf=30", "image", "image=0", "image=-1", "image=ten", "ann/=3"):
        with pytest.raises(ValidationError):
            keeping(rules)
    assert keeping("").kept_days == {}
