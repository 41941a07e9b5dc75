"""Removal of files to which no row refers: recent files stay, and no other file is removed."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from psfcore.errors import DataError
from service.cli.main import main
from service.local import LocalService
from tests.s3 import opened_store
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, ReportRow, SolutionRow
from workers.files import collection
from workers.files import s3_store as remote_store
from workers.files.opened import open_store
from workers.files.store import Store
from workers.settings import Settings

DAY_S = 86_400.0
collect = partial(collection.collect, second_look_after_s=0.0)


class Killed(BaseException):
    """The end of a process; no handler of errors sees it."""


@pytest.fixture(params=["folder", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with opened_store(request.param, tmp_path, monkeypatch) as opened:
        yield opened


@pytest.fixture
def remote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[remote_store.RemoteStore]:
    with opened_store("s3", tmp_path, monkeypatch) as opened:
        assert isinstance(opened, remote_store.RemoteStore)
        yield opened


def kept(store: Store, content: bytes) -> str:
    with store.temporary() as path:
        path.write_bytes(content)
        return store.keep(path)


def image(digest: str) -> ImageRow:
    return ImageRow(owner="o", id=digest, created_at=1.0, bytes=1, summary={})


def test_files_without_a_row_are_removed_and_others_stay(store: Store, catalogue: Catalogue) -> None:
    named, deep, orphan = kept(store, b"a"), kept(store, b"b"), kept(store, b"cc")
    catalogue.add(image(named))
    report = ReportRow(
        owner="o", id="1" * 64, created_at=1.0, kind="k", file_sha256=named, bytes=1,
        details={"some": [{"page_sha256": deep}]},
    )  # fmt: skip
    catalogue.add(report)
    dry = collect(catalogue, store, -60.0, dry_run=True)
    assert (dry.files, dry.bytes, dry.removed_bytes) == (3, 4, 2)
    assert [blob.digest for blob in dry.removed] == [orphan]
    assert {blob.digest for blob in store.blobs()} == {named, deep, orphan}, "nothing was removed"
    assert collect(catalogue, store, -60.0) == dry
    assert {blob.digest for blob in store.blobs()} == {named, deep}
    assert collect(catalogue, store, -60.0).removed == ()


def test_recent_files_stay(store: Store, catalogue: Catalogue) -> None:
    catalogue.add(image(kept(store, b"a")))
    orphan = kept(store, b"an upload whose row is not written yet")
    assert collect(catalogue, store, DAY_S).removed == ()
    assert store.path(orphan).exists()


def test_an_old_orphan_that_is_being_uploaded_again_stays(
    tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is kept again after the rows were looked at: its own row comes later still."""
    store = Store(tmp_path / "data")
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


def objects(remote: remote_store.RemoteStore) -> dict[str, object]:
    """All that is in the bucket, and when it was written."""
    found = remote._s3.find(remote._root, detail=True)
    return {name.removeprefix(f"{remote._root}/"): about["LastModified"] for name, about in found.items()}


def names(remote: remote_store.RemoteStore, folder: str) -> set[str]:
    return {name.rsplit("/", 1)[1] for name in objects(remote) if name.startswith(f"{folder}/")}


def read_afresh(remote: remote_store.RemoteStore, folder: Path, digest: str) -> bytes:
    """The file as a machine reads it that has no copy of it."""
    return open_store(Settings(data_dir=folder, store_url=f"s3://{remote._root}")).path(digest).read_bytes()


def before_removal(
    remote: remote_store.RemoteStore, monkeypatch: pytest.MonkeyPatch, digest: str, act: Callable[[], object]
) -> None:
    """Have something happen once, after a file was looked at and right before it is deleted."""
    real, done = remote._s3.rm_file, []

    def deleted(key: str) -> None:
        if not done and key == remote._key(digest):
            done.append(1)
            act()
        real(key)

    monkeypatch.setattr(remote._s3, "rm_file", deleted)


def test_an_upload_at_the_moment_of_the_removal_is_not_lost(
    remote: remote_store.RemoteStore, catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """S3 looks and deletes one after the other: what is sent in between is deleted, and named by its row."""
    catalogue.add(image(kept(remote, b"a")))
    orphan, other = kept(remote, b"sent long ago"), kept(remote, b"other")

    def sent_again() -> None:
        kept(remote, b"sent long ago")
        catalogue.add(image(orphan))

    before_removal(remote, monkeypatch, orphan, sent_again)
    removed = collect(catalogue, remote, -60.0, even_most=True).removed
    assert read_afresh(remote, tmp_path / "elsewhere", orphan) == b"sent long ago"
    assert [blob.digest for blob in removed] == [other]
    assert orphan in names(remote, "blobs") and names(remote, "aside") == set()


def test_a_row_that_is_written_a_little_later_saves_its_file(
    remote: remote_store.RemoteStore, catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalogue.add(image(kept(remote, b"a")))
    orphan = kept(remote, b"sent long ago")
    before_removal(remote, monkeypatch, orphan, lambda: kept(remote, b"sent long ago"))
    waited = []

    def sleep(seconds: float) -> None:
        waited.append(seconds)
        if seconds:
            catalogue.add(image(orphan))

    clock = SimpleNamespace(time=time.time, monotonic=time.monotonic, sleep=sleep)
    monkeypatch.setattr(remote_store, "time", clock)
    assert collection.collect(catalogue, remote, -60.0).removed == ()
    assert waited == [collection.SECOND_LOOK_AFTER_S]
    assert read_afresh(remote, tmp_path / "elsewhere", orphan) == b"sent long ago"
    assert collection.collect(catalogue, remote, -60.0).removed == () and len(waited) == 1, (
        "nothing to wait for"
    )


def left_aside(
    remote: remote_store.RemoteStore, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> tuple[str, str]:
    """A file that is named and one that is not, both aside: their collection was killed after it deleted them."""
    catalogue.add(image(kept(remote, b"a")))
    sent, orphan = kept(remote, b"sent long ago"), kept(remote, b"orphan")

    def killed(named: object, after_s: float = 0.0) -> set[str]:
        if names(remote, "aside"):
            raise Killed
        return set()

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(remote, "settle", killed)
        collect(catalogue, remote, -60.0, even_most=True)
    catalogue.add(image(sent))
    assert names(remote, "aside") == {sent, orphan} and len(list(remote.blobs())) == 1
    return sent, orphan


def test_the_next_collection_settles_files_that_a_killed_one_left_aside(
    remote: remote_store.RemoteStore, catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent, _ = left_aside(remote, catalogue, monkeypatch)
    another, there = kept(remote, b"another"), []
    before_removal(remote, monkeypatch, another, lambda: there.append(sent in names(remote, "blobs")))
    assert [blob.digest for blob in collect(catalogue, remote, -60.0).removed] == [another]
    assert there == [True], "it comes back before anything else goes"
    assert read_afresh(remote, tmp_path / "elsewhere", sent) == b"sent long ago"
    assert len(names(remote, "blobs")) == 2 and names(remote, "aside") == set()


def test_a_collection_killed_anywhere_loses_nothing(
    remote: remote_store.RemoteStore, catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalogue.add(image(kept(remote, b"a")))
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
                patched.setattr(remote._s3, name, partial(step, real=getattr(remote._s3, name), limit=steps))
            before_removal(remote, patched, sent, sent_again)
            try:
                collect(catalogue, remote, -60.0, even_most=True)
                killed = False
            except Killed:
                killed = True
                collect(catalogue, remote, -60.0, even_most=True)
        assert read_afresh(remote, tmp_path / "elsewhere", sent) == content, steps
        assert names(remote, "aside") == set() and orphan not in names(remote, "blobs"), steps
        if not killed:
            break
    assert steps == 8, "two were put aside and deleted, one came back, both copies went"


def test_a_dry_run_changes_no_file_aside(
    remote: remote_store.RemoteStore, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_aside(remote, catalogue, monkeypatch)
    orphan = kept(remote, b"another")
    before = objects(remote)
    for name in ("cp_file", "rm_file", "pipe_file", "put_file"):
        monkeypatch.setattr(remote._s3, name, None)
    assert [blob.digest for blob in collect(catalogue, remote, -60.0, dry_run=True).removed] == [orphan]
    assert objects(remote) == before and len(before) == 4


def test_nothing_is_left_aside(remote: remote_store.RemoteStore, catalogue: Catalogue) -> None:
    named = kept(remote, b"a")
    catalogue.add(image(named))
    orphans = {kept(remote, bytes([number])) for number in range(3)}
    removed = collect(catalogue, remote, -60.0, even_most=True).removed
    assert {blob.digest for blob in removed} == orphans
    assert list(objects(remote)) == [f"blobs/{named[:2]}/{named}"]


def test_files_aside_stay_if_the_database_seems_wrong(
    remote: remote_store.RemoteStore, catalogue: Catalogue
) -> None:
    orphan, _ = kept(remote, b"orphan"), kept(remote, b"a")
    assert remote.remove(orphan, time.time() + 60.0)
    with pytest.raises(DataError, match="name the right database"):
        collect(catalogue, remote, -60.0)
    assert names(remote, "aside") == {orphan}


def test_a_database_that_refers_to_no_file_is_refused(store: Store, catalogue: Catalogue) -> None:
    kept(store, b"a")
    with pytest.raises(DataError, match="name the right database"):
        collect(catalogue, store, -60.0)
    assert len(list(store.blobs())) == 1


def test_a_database_that_refers_to_few_files_needs_even_most(store: Store, catalogue: Catalogue) -> None:
    """As after a move to another database on the same files."""
    catalogue.add(image(kept(store, b"new")))
    orphans = {kept(store, bytes([number])) for number in range(2)}
    with pytest.raises(DataError, match=r"does not refer to 2 old files.*--even-most"):
        collect(catalogue, store, -60.0)
    assert len(list(store.blobs())) == 3
    assert {blob.digest for blob in collect(catalogue, store, -60.0, dry_run=True).removed} == orphans
    found = collect(catalogue, store, -60.0, even_most=True)
    assert {blob.digest for blob in found.removed} == orphans and len(list(store.blobs())) == 1


def test_a_collection_beside_a_running_service_loses_no_file(
    settings: Settings, tmp_path: Path, image_file: Path, psf_file: Path
) -> None:
    local = LocalService(settings)
    psf = local.upload_psf(psf_file)
    product = local.deconvolve(image_file, psf_id=psf["id"], steps=1, changes=tmp_path / "e.png")
    local.answer([psf["id"]], "curve", {})  # has tables and a picture made
    store, catalogue = Store(settings.data_dir), Catalogue(settings.catalogue_url)
    before = {blob.digest for blob in store.blobs()}
    assert len(before) >= 5 and collect(catalogue, store, -60.0).removed == ()
    for part in ("file", "preview", "changes"):
        local.download(product[part], tmp_path / part)
    local.close(), catalogue.close()


def test_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    monkeypatch.setenv("HELIOPSF_DATA_DIR", str(settings.data_dir))
    store, catalogue = Store(settings.data_dir), Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    catalogue.add(image(kept(store, b"a")))
    orphan = kept(store, b"x" * 2**20)
    long_ago = time.time() - 40 * DAY_S
    os.utime(store.path(orphan), (long_ago, long_ago))

    def said(*arguments: str, status: int = 0) -> str:
        answer = CliRunner().invoke(main, ["store", "collect", *arguments])
        assert answer.exit_code == status, answer.output
        return answer.output

    dry = said("--dry-run")
    assert orphan in dry and "1 of 2 files would be removed, 1.0 of 1.0 MiB" in dry
    assert "0 of 2 files would be removed" in said("--dry-run", "--older-than", "8w")
    assert "expected 2d or more" in said("--older-than", "1h", status=2)
    assert store.path(orphan).exists()
    assert "1 of 2 files were removed" in said()
    assert not store.path(orphan).exists()
    with catalogue._engine.begin() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    assert "not at the revision of this version" in said(status=1)
    catalogue.close()


def solution(digest: str, owner: str, created_at: float) -> SolutionRow:
    return SolutionRow(owner=owner, id="1" * 64, created_at=created_at, file_sha256=digest, bytes=3)


def test_old_solutions_go_with_their_files(store: Store, catalogue: Catalogue) -> None:
    named, old, shared = kept(store, b"a"), kept(store, b"bb"), kept(store, b"ccc")
    catalogue.add(image(named))
    catalogue.add(solution(old, "o", 1.0))
    catalogue.add(solution(shared, "p", 2.0))
    catalogue.add(
        solution(shared, "q", time.time() + 120.0)
    )  # the same solution, made by another owner later
    dry = collect(catalogue, store, -60.0, dry_run=True)
    assert [blob.digest for blob in dry.removed] == [old]
    assert len(catalogue.owners.solutions_before(1e12)) == 3, "nothing was removed"
    assert collect(catalogue, store, -60.0) == dry
    assert {blob.digest for blob in store.blobs()} == {named, shared}
    assert [row.owner for row in catalogue.owners.solutions_before(1e12)] == ["q"]
    assert catalogue.owners.recount() == []


def test_old_solutions_do_not_count_as_lost_files(store: Store, catalogue: Catalogue) -> None:
    catalogue.add(image(kept(store, b"a")))
    for number, content in enumerate((b"bb", b"ccc", b"dddd")):
        catalogue.add(solution(kept(store, content), f"o{number}", 1.0))
    assert len(collect(catalogue, store, -60.0).removed) == 3
