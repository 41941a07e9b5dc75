"""Removal of files that no row names, and of rows that are older than the operator keeps them; nothing else goes."""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner
from pydantic import ValidationError
from sqlalchemy import text

from psfcore.errors import DataError
from service.cli.main import main
from tests.in_process import InProcess
from tests.s3 import client_of, digests, elsewhere, kept, key_of, root_of
from tests.workers.databases import BOTH, add, change
from tests.workers.jobs import bulk_row
from tests.workers.psf_examples import psf
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, JobRow, PsfRow, ReportRow, SolutionRow
from workers.contract.bulk import BulkPhase
from workers.contract.jobs import Phase
from workers.files import garbage
from workers.files.garbage import DAY_S, retain
from workers.files.store import Store
from workers.settings import Settings

collect = partial(garbage.collect, second_look_after_s=0.0)


class Killed(BaseException):
    """The end of a process; no handler of errors sees it."""


in_a_folder = pytest.mark.parametrize("store", ["folder"], indirect=True)


def image(digest: str) -> ImageRow:
    return ImageRow(owner="o", id=digest, created_at=1.0, bytes=1, summary={})


def solution(digest: str, owner: str, created_at: float) -> SolutionRow:
    return SolutionRow(owner=owner, id="1" * 64, created_at=created_at, file_sha256=digest, bytes=3)


def test_files_without_a_row_are_removed_and_others_stay(store: Store, catalogue: Catalogue) -> None:
    named, deep, orphan = kept(store, b"a"), kept(store, b"b"), kept(store, b"cc")
    catalogue.add(image(named))
    report = ReportRow(
        owner="o", id="1" * 64, created_at=1.0, kind="k", file_sha256=named, bytes=1,
        details={"some": [{"page_sha256": deep}]},
    )  # fmt: skip
    catalogue.add(report)
    assert collect(catalogue, store, DAY_S).removed == (), "recent files: a row may not be written yet"
    dry = collect(catalogue, store, -60.0, dry_run=True)
    assert (dry.files, dry.bytes, dry.removed_bytes) == (3, 4, 2)
    assert [blob.digest for blob in dry.removed] == [orphan]
    assert digests(store) == {named, deep, orphan}, "nothing was removed"
    assert collect(catalogue, store, -60.0) == dry
    assert digests(store) == {named, deep}
    assert collect(catalogue, store, -60.0).removed == ()
    if type(store) is not Store:
        assert names(store, "aside") == set() and len(objects(store)) == 2, "nothing is left aside"


@in_a_folder
def test_an_old_orphan_that_is_being_uploaded_again_stays(
    store: Store, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is kept again after the rows were looked at: its own row comes later still."""
    catalogue.add(image(kept(store, b"a")))
    orphan = kept(store, b"sent long ago")
    long_ago = time.time() - 100 * DAY_S
    os.utime(store.path(orphan), (long_ago, long_ago))
    real = type(catalogue.named_files).all

    def sent_again(self: object, **how: float) -> Iterator[str]:
        yield from real(self, **how)  # type: ignore[arg-type]
        kept(store, b"sent long ago")

    with monkeypatch.context() as patched:
        patched.setattr(type(catalogue.named_files), "all", sent_again)
        assert collect(catalogue, store, DAY_S).removed == ()
    assert store.path(orphan).exists()


@in_a_folder
def test_a_database_that_refers_to_few_files_needs_even_most(store: Store, catalogue: Catalogue) -> None:
    """As after a move to another database on the same files."""
    orphan = kept(store, b"a")
    with pytest.raises(DataError, match="name the right database"):
        collect(catalogue, store, -60.0)
    assert digests(store) == {orphan}, "no row refers to a file"
    catalogue.add(image(kept(store, b"new")))
    orphans = {orphan, kept(store, b"another")}
    with pytest.raises(DataError, match=r"does not refer to 2 old files.*--even-most"):
        collect(catalogue, store, -60.0)
    assert len(digests(store)) == 3
    assert {blob.digest for blob in collect(catalogue, store, -60.0, dry_run=True).removed} == orphans
    removed = collect(catalogue, store, -60.0, even_most=True).removed
    assert {blob.digest for blob in removed} == orphans and len(digests(store)) == 1


@in_a_folder
def test_old_solutions_go_with_their_files(store: Store, catalogue: Catalogue) -> None:
    named, old, shared, third = (kept(store, content) for content in (b"a", b"bb", b"ccc", b"dddd"))
    catalogue.add(image(named))
    for digest, owner in ((old, "o"), (shared, "p"), (third, "r")):
        catalogue.add(solution(digest, owner, 1.0))
    catalogue.add(
        solution(shared, "q", time.time() + 120.0)
    )  # the same solution, made by another owner later
    dry = collect(catalogue, store, -60.0, dry_run=True)
    assert {blob.digest for blob in dry.removed} == {old, third}
    assert len(catalogue.quotas.solutions_before(1e12)) == 4, "nothing was removed"
    assert collect(catalogue, store, -60.0) == dry
    assert digests(store) == {named, shared}
    assert [row.owner for row in catalogue.quotas.solutions_before(1e12)] == ["q"]


# Removal beside uploads --------------------------------------------------------------------------------


def draft(digest: str, owner: str) -> PsfRow:
    return psf("draft", owner=owner, file_sha256=digest)


def delete(catalogue: Catalogue, store: Store, row: PsfRow) -> None:
    catalogue.delete_draft(row.id, row.owner)
    garbage.remove_unnamed(catalogue, store, [row.file_sha256])


def test_a_file_is_there_for_the_row_that_comes_after_another_owner_deleted_it(
    store: Store, catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, orphan = kept(store, b"same bytes"), kept(store, b"orphan")
    catalogue.add(draft(other, "a"))
    kept(store, b"same bytes")  # the upload of another owner has stored its file, but not yet added its row
    time.sleep(0.01)
    delete(catalogue, store, draft(other, "a"))
    garbage.remove_unnamed(catalogue, store, [orphan])
    assert store.aside() == {other, orphan}
    garbage.settle_old(catalogue, store)
    assert store.aside() == {other, orphan}, "they were moved aside a moment ago"
    catalogue.add(draft(other, "b"))
    monkeypatch.setattr(garbage, "SETTLED_AFTER_S", -60.0)
    garbage.settle_old(catalogue, store)
    assert elsewhere(store, tmp_path).verified(other).read_bytes() == b"same bytes"
    assert digests(store) == {other} and store.aside() == set()


@pytest.mark.parametrize(
    ("store", "catalogue", "pairs"),
    [("folder", "sqlite", 25), ("folder", "postgresql", 25), ("s3", "sqlite", 10)],
    indirect=["store", "catalogue"],
)
def test_no_upload_loses_its_file_to_a_deletion(store: Store, catalogue: Catalogue, pairs: int) -> None:
    """Two owners delete and upload the same bytes."""
    with ThreadPoolExecutor(2) as threads:
        for number in range(pairs):
            content = b"%d" % number
            digest = kept(store, content)
            catalogue.add(draft(digest, "a"))

            def upload(content: bytes = content, digest: str = digest) -> None:
                with store.temporary() as path:
                    path.write_bytes(content)
                    with store.kept_if(path, digest):
                        catalogue.add(draft(digest, "b"))

            together = [threads.submit(upload), threads.submit(delete, catalogue, store, draft(digest, "a"))]
            for one in together:
                one.result()
            assert store.size(digest) is not None, number
            delete(catalogue, store, draft(digest, "b"))


def test_a_row_deleted_while_it_is_added(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    row = draft("3" * 64, "a")
    catalogue.add(row)
    real, asked = catalogue.get, []

    def deleted_before(table: type[PsfRow], identity: str, owner: str) -> PsfRow | None:
        if not asked:
            asked.append(catalogue.delete_draft(identity, owner))
        return real(table, identity, owner)

    monkeypatch.setattr(catalogue, "get", deleted_before)
    assert catalogue.add(draft("3" * 64, "a"))[1] and asked


# In S3 ------------------------------------------------------------------------------------------------


def objects(remote: Store) -> dict[str, object]:
    """All that is in the bucket, and when it was written."""
    root = root_of(remote)
    there = client_of(remote).find(root, detail=True)
    return {name.removeprefix(f"{root}/"): about["LastModified"] for name, about in there.items()}


def names(remote: Store, folder: str) -> set[str]:
    return {name.rsplit("/", 1)[1] for name in objects(remote) if name.startswith(f"{folder}/")}


def before_removal(
    remote: Store, monkeypatch: pytest.MonkeyPatch, digest: str, act: Callable[[], object]
) -> None:
    """Have something happen once, after a file was looked at and right before it is deleted."""
    real, done = client_of(remote).rm_file, []

    def deleted(key: str) -> None:
        if not done and key == key_of(remote, digest):
            done.append(1)
            act()
        real(key)

    monkeypatch.setattr(client_of(remote), "rm_file", deleted)


def test_a_file_that_is_sent_at_the_moment_of_its_removal_is_not_lost(
    remote: Store, catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """S3 looks and deletes one after the other. What is sent in between is deleted; its row comes a little later."""
    catalogue.add(image(kept(remote, b"a")))
    orphan, other = kept(remote, b"sent long ago"), kept(remote, b"other")
    waits: list[float] = []

    def sleep(seconds: float) -> None:
        waits.append(seconds)
        if seconds:
            catalogue.add(image(orphan))

    clock = SimpleNamespace(time=time.time, sleep=sleep)
    monkeypatch.setattr(garbage, "time", clock)
    before_removal(remote, monkeypatch, orphan, lambda: kept(remote, b"sent long ago"))
    removed = garbage.collect(catalogue, remote, -60.0, even_most=True).removed
    assert [blob.digest for blob in removed] == [other]
    assert waits == [garbage.SECOND_LOOK_AFTER_S]
    assert elsewhere(remote, tmp_path).path(orphan).read_bytes() == b"sent long ago"
    assert orphan in names(remote, "blobs") and names(remote, "aside") == set()
    assert garbage.collect(catalogue, remote, -60.0).removed == () and len(waits) == 1, "nothing to wait for"


def test_a_collection_killed_anywhere_loses_nothing(
    remote: Store, catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalogue.add(image(kept(remote, b"a")))
    monkeypatch.setattr(garbage, "SETTLED_AFTER_S", -60.0)
    for steps in range(1, 20):
        content = f"sent long ago {steps}".encode()
        sent, orphan = kept(remote, content), kept(remote, f"orphan {steps}".encode())
        done = []

        def step(key: str, *to: str, real: Callable[..., None], limit: int, done: list[str] = done) -> None:
            real(key, *to)
            done.append(key)
            if len(done) == limit:
                raise Killed

        def sent_again(content: bytes = content, sent: str = sent) -> None:
            kept(remote, content)
            catalogue.add(image(sent))

        with monkeypatch.context() as patched:
            for name in ("cp_file", "rm_file"):
                real = getattr(client_of(remote), name)
                patched.setattr(client_of(remote), name, partial(step, real=real, limit=steps))
            before_removal(remote, patched, sent, sent_again)
            try:
                collect(catalogue, remote, -60.0, even_most=True)
                killed = False
            except Killed:
                killed, before = True, objects(remote)
                with monkeypatch.context() as reading:
                    for name in ("cp_file", "rm_file", "pipe_file", "put_file"):
                        reading.setattr(client_of(remote), name, None)
                    collect(catalogue, remote, -60.0, dry_run=True)
                assert objects(remote) == before, "a dry run settles nothing"
                collect(catalogue, remote, -60.0, even_most=True)
        assert client_of(remote).cat_file(key_of(remote, sent)) == content, steps
        assert names(remote, "aside") == set() and orphan not in names(remote, "blobs"), steps
        if not killed:
            break
    assert steps == 8, "two were put aside and deleted, one came back, both copies went"


def test_files_aside_stay_if_the_database_seems_wrong(remote: Store, catalogue: Catalogue) -> None:
    orphan, _ = kept(remote, b"orphan"), kept(remote, b"a")
    assert remote.remove(orphan, time.time() + 60.0)
    with pytest.raises(DataError, match="name the right database"):
        collect(catalogue, remote, -60.0)
    assert names(remote, "aside") == {orphan}


# The whole ------------------------------------------------------------------------------------------


def test_a_collection_beside_a_running_service_loses_no_file(
    local: InProcess, tmp_path: Path, image_file: Path, psf_file: Path
) -> None:
    psf = local.upload_psf(psf_file)
    product = local.deconvolve(image_file, psf_id=psf["id"], steps=1, changes=tmp_path / "e.png")
    local.wait(local.submit("psf-tables", psf_id=psf["id"]))  # tables and a picture
    assert len(digests(local.store)) >= 5 and collect(local.catalogue, local.store, -60.0).removed == ()
    for part in ("file", "preview", "changes"):
        local.download(product[part], tmp_path / part)


def test_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    monkeypatch.setenv("HELIOPSF_DATA_DIR", str(settings.data_dir))
    monkeypatch.setattr(garbage, "time", SimpleNamespace(time=time.time, sleep=lambda _: None))
    store, catalogue = Store(settings.data_dir), Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    catalogue.add(image(kept(store, b"a")))
    orphan = kept(store, b"x" * 2**20)
    long_ago = time.time() - 40 * DAY_S
    os.utime(store.path(orphan), (long_ago, long_ago))

    def output(*arguments: str, status: int = 0) -> str:
        answer = CliRunner().invoke(main, ["store", "collect", *arguments])
        assert answer.exit_code == status, answer.output
        return answer.output

    dry = output("--dry-run")
    assert orphan in dry and "1 of 2 files would be removed, 1.0 of 1.0 MiB" in dry
    assert "0 of 2 files would be removed" in output("--dry-run", "--older-than", "8w")
    assert "expected 2d or more" in output("--older-than", "1h", status=2)
    assert store.path(orphan).exists()
    assert "1 of 2 files were removed" in output()
    assert not store.path(orphan).exists()
    change(catalogue, text("UPDATE alembic_version SET version_num = '9999'"))
    assert "not at the revision of this version" in output(status=1)
    catalogue.close()


# Rows that are too old ------------------------------------------------------------------------------


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
