"""Files by their hash, in a folder and in S3: stored whole or not at all, removed only if not stored again."""

from __future__ import annotations

import errno
import hashlib
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import pytest
import s3fs
from pydantic import ValidationError

from tests.s3 import opened_store, s3_bucket
from workers.files import s3_store as remote_store
from workers.files.opened import open_store
from workers.files.store import BadFile, Store, StoreAway
from workers.settings import Settings

CONTENT = b"light" * 1000


@pytest.fixture(params=["folder", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with opened_store(request.param, tmp_path, monkeypatch, store_cache_mib=1) as opened:
        yield opened


def kept(store: Store, content: bytes = CONTENT) -> str:
    with store.temporary() as path:
        path.write_bytes(content)
        return store.keep(path)


def elsewhere(store: Store, tmp_path: Path) -> Store:
    """The same files, as another machine has them: without copies of its own, where copies are made."""
    if type(store) is Store:
        return store
    url = f"s3://{store._root}"  # type: ignore[attr-defined]
    return open_store(Settings(data_dir=tmp_path / "elsewhere", store_url=url))


def test_a_kept_file_is_whole_under_its_hash_and_nothing_else_is_left(store: Store, tmp_path: Path) -> None:
    digest = kept(store)
    assert digest == hashlib.sha256(CONTENT).hexdigest()
    assert store.path(digest).read_bytes() == CONTENT
    assert elsewhere(store, tmp_path).path(digest).read_bytes() == CONTENT
    assert [p for p in (tmp_path / "data").rglob("*") if p.is_file()] == [store.path(digest)]
    store.check()


def spoil(store: Store, digest: str, content: bytes | None) -> None:
    """Change the content of a stored file, as a bad disk does; None: lose it."""
    if type(store) is Store:
        path = store.path(digest)
        path.unlink() if content is None else path.write_bytes(content)
        return
    key = store._key(digest)  # type: ignore[attr-defined]
    s3 = s3fs.S3FileSystem(skip_instance_cache=True)
    s3.rm_file(key) if content is None else s3.pipe_file(key, content)
    Store.path(store, digest).unlink()


@pytest.mark.parametrize(
    ("content", "code"),
    [(CONTENT[:-1], "file-damaged"), (bytes(len(CONTENT)), "file-damaged"), (None, "file-lost")],
)
def test_a_file_that_is_not_what_was_stored_is_not_read(
    store: Store, content: bytes | None, code: str
) -> None:
    digest = kept(store)
    assert store.verified(digest).read_bytes() == CONTENT and store.size(digest) == len(CONTENT)
    assert store.state(digest, len(CONTENT), content=True) == "good"
    spoil(store, digest, content)
    state = code.removeprefix("file-")
    assert store.state(digest, len(CONTENT), content=True) == state
    same_size = content is not None and len(content) == len(CONTENT)
    assert store.state(digest, len(CONTENT), content=False) == ("good" if same_size else state)
    with pytest.raises(BadFile) as refused:
        store.verified(digest)
    assert refused.value.code == code
    assert store.set_aside(digest) is (content is not None)
    assert store.size(digest) is None
    assert kept(store) == digest and store.verified(digest).read_bytes() == CONTENT, "stored again"
    assert not store.set_aside(digest), "a good file stays"
    assert store.state(digest, len(CONTENT), content=True) == "good"


def test_a_damaged_copy_of_a_good_object_is_downloaded_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened_store("s3", tmp_path, monkeypatch, store_cache_mib=1) as store:
        digest = kept(store)
        store.path(digest).write_bytes(b"damaged")
        assert store.state(digest, len(CONTENT), content=True) == "good"
        assert store.verified(digest).read_bytes() == CONTENT


def test_an_abandoned_file_is_removed(store: Store, tmp_path: Path) -> None:
    with pytest.raises(InterruptedError), store.temporary() as path:
        path.write_bytes(b"half")
        raise InterruptedError
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


def test_a_sweep_tolerates_files_that_vanish(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tmp = tmp_path / "data" / "tmp"
    for name in ("kept", "left"):
        (tmp / name).write_bytes(b"half")
    os.utime(tmp / "left", (0, 0))
    gone = [tmp / "ended", tmp / "left", tmp / "kept"]  # the first was listed and is there no more
    monkeypatch.setattr(Path, "iterdir", lambda folder: iter(gone))
    store.sweep()
    monkeypatch.undo()
    assert [path.name for path in tmp.iterdir()] == ["kept"]


def test_a_missing_file_raises_an_error(store: Store) -> None:
    with pytest.raises(FileNotFoundError):
        store.path("a" * 64).open("rb")


def test_the_same_file_may_be_kept_by_many_at_once(store: Store) -> None:
    with ThreadPoolExecutor(6) as pool:
        digests = set(pool.map(lambda _: kept(store), range(12)))
    assert len(digests) == 1 and [blob.digest for blob in store.blobs()] == list(digests)


def test_stored_files_are_listed(store: Store) -> None:
    contents = {kept(store, content): len(content) for content in (b"a", b"bb", b"ccc")}
    found = {blob.digest: blob for blob in store.blobs()}
    assert {digest: blob.bytes for digest, blob in found.items()} == contents
    assert all(abs(blob.kept_at - time.time()) < 60 for blob in found.values())


def test_a_file_is_removed_unless_it_was_kept_again_since(store: Store, tmp_path: Path) -> None:
    digest = kept(store)
    assert not store.remove(digest, kept_before=time.time() - 3600.0)
    assert store.path(digest).read_bytes() == CONTENT
    assert store.remove(digest, kept_before=time.time() + 3600.0)
    assert not store.remove(digest, kept_before=time.time() + 3600.0), "it is gone"
    assert list(store.blobs()) == []
    assert store.settle(()) == set()
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    with pytest.raises(FileNotFoundError):
        elsewhere(store, tmp_path).path(digest).open("rb")


def test_an_old_file_that_is_kept_again_is_new(store: Store) -> None:
    digest = kept(store)
    if type(store) is Store:
        os.utime(store.path(digest), (1.0, 1.0))
    before = time.time()
    time.sleep(1.1)  # S3 tells whole seconds
    kept(store)
    (blob,) = store.blobs()
    assert blob.kept_at >= before and not store.remove(digest, kept_before=before)


def test_a_file_kept_while_it_is_removed_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    digest = kept(store)
    os.utime(store.path(digest), (1.0, 1.0))
    real, again = os.replace, []

    def kept_meanwhile(source: Path, target: Path) -> None:
        if not again and Path(source) == store.path(digest):
            again.append(1)
            kept(store)
        real(source, target)

    monkeypatch.setattr(os, "replace", kept_meanwhile)
    assert not store.remove(digest, kept_before=time.time() - 60.0)
    assert again and store.path(digest).read_bytes() == CONTENT


@pytest.fixture
def s3_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with opened_store("s3", tmp_path, monkeypatch) as opened:
        yield opened


def test_a_full_disk_of_the_copies_is_not_an_object_store_that_is_away(
    s3_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digest = kept(s3_store)
    fresh = elsewhere(s3_store, tmp_path)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(fresh._s3, "get_file", full)  # type: ignore[attr-defined]
    with pytest.raises(OSError, match="No space left") as error:
        fresh.path(digest)
    assert not isinstance(error.value, StoreAway)


def test_a_file_aside_with_a_row_is_restored(s3_store: Store, tmp_path: Path) -> None:
    wanted, other = kept(s3_store), kept(s3_store, b"other")
    for digest in (wanted, other):
        assert s3_store.remove(digest, kept_before=time.time() + 3600.0)
    assert list(s3_store.blobs()) == [], "what is aside is not listed"
    assert s3_store.settle(iter((wanted, "a" * 64))) == {wanted}
    assert elsewhere(s3_store, tmp_path).path(wanted).read_bytes() == CONTENT
    assert [blob.digest for blob in s3_store.blobs()] == [wanted]

    def unread() -> Iterator[str]:
        raise AssertionError("nothing is aside")
        yield

    assert s3_store.settle(unread(), after_s=3600.0) == set()


def test_a_file_that_was_kept_again_is_left_as_it_is(s3_store: Store) -> None:
    digest = kept(s3_store)
    assert s3_store.remove(digest, kept_before=time.time() + 3600.0)
    kept(s3_store)
    assert s3_store.settle([digest]) == set()
    assert [blob.digest for blob in s3_store.blobs()] == [digest]


def test_a_file_kept_while_its_copy_is_put_aside_is_not_removed(
    s3_store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    s3 = s3_store._s3  # type: ignore[attr-defined]
    digest = kept(s3_store)
    copied, looked_at, again = s3.cp_file, s3.info, []

    def kept_meanwhile(source: str, target: str) -> None:
        copied(source, target)
        again.append(kept(s3_store))

    def as_old(key: str, **how: object) -> dict[str, object]:
        about = looked_at(key, **how)
        return about if again else about | {"LastModified": about["LastModified"] - timedelta(days=9)}

    monkeypatch.setattr(s3, "cp_file", kept_meanwhile)
    monkeypatch.setattr(s3, "info", as_old)
    assert not s3_store.remove(digest, kept_before=time.time() - 3600.0)
    assert again == [digest] and [blob.digest for blob in s3_store.blobs()] == [digest]
    s3_store.settle(())
    assert [blob.digest for blob in s3_store.blobs()] == [digest], "the copy alone is dropped"


class Remote:
    """Stores on a server that a test may stop."""

    def __init__(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, url: str) -> None:
        monkeypatch.setattr(remote_store, "LOOK_AFTER_S", -1.0)
        monkeypatch.setattr(remote_store, "IN_USE_S", 0.0)
        monkeypatch.setattr(remote_store, "RETRIES", 1)
        self.folder = tmp_path / "data"
        self.store = open_store(Settings(data_dir=self.folder, store_url=url, store_cache_mib=1))

    def copies(self) -> set[str]:
        return {path.name for path in (self.folder / "copies").rglob("*") if path.is_file()}


def test_copies_have_a_bounded_size_and_the_last_used_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with s3_bucket(monkeypatch) as (url, _):
        remote = Remote(tmp_path, monkeypatch, url)
        digests = []
        for number in range(6):
            digests.append(kept(remote.store, bytes([number]) * 300_000))
            os.utime(remote.store.path(digests[0]))  # in use all the time
            time.sleep(0.01)
        assert len(remote.copies()) * 300_000 <= 2**20
        assert {digests[0], digests[-1]} <= remote.copies() and digests[1] not in remote.copies()
        assert remote.store.path(digests[1]).read_bytes() == bytes([1]) * 300_000, "it is fetched again"


def test_a_copy_in_use_is_not_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with s3_bucket(monkeypatch) as (url, _):
        remote = Remote(tmp_path, monkeypatch, url)
        monkeypatch.setattr(remote_store, "IN_USE_S", 60.0)
        digests = {kept(remote.store, bytes([number]) * 300_000) for number in range(6)}
        assert remote.copies() == digests


def test_a_damaged_download_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with s3_bucket(monkeypatch) as (url, _):
        store = Remote(tmp_path, monkeypatch, url).store
        digest = kept(store)
        store.path(digest).unlink()
        s3fs.S3FileSystem(skip_instance_cache=True).pipe_file(
            f"{url.removeprefix('s3://')}/blobs/{digest[:2]}/{digest}", b"something else"
        )
        with pytest.raises(BadFile, match="its content has changed"):
            store.path(digest)
        assert not (tmp_path / "data" / "copies" / digest[:2] / digest).exists()


def test_an_unavailable_server_is_a_transient_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with s3_bucket(monkeypatch) as (url, server):
        store = Remote(tmp_path, monkeypatch, url).store
        digest = kept(store)
        server.stop()
        assert store.path(digest).read_bytes() == CONTENT, "what is here is read"
        store.path(digest).unlink()
        for attempt in (
            lambda: store.path(digest),
            lambda: kept(store),
            store.check,
            lambda: list(store.blobs()),
            lambda: store.settle(()),
        ):
            with pytest.raises(StoreAway):
                attempt()
        assert list((tmp_path / "data" / "tmp").iterdir()) == []


@pytest.mark.parametrize("url", ["http://x/y", "s3://", "file:///etc", "bucket"])
def test_an_invalid_url_is_refused(tmp_path: Path, url: str) -> None:
    with pytest.raises(ValidationError):
        Settings(data_dir=tmp_path, store_url=url)


def failing(store: Store, content: bytes, meanwhile: bytes | None = None) -> None:
    """Keep a file for a row that then fails; ``meanwhile``: another upload stores this in between."""
    with store.temporary() as path:
        path.write_bytes(content)
        with pytest.raises(ZeroDivisionError), store.kept_if(path, hashlib.sha256(content).hexdigest()):
            assert store.path(hashlib.sha256(content).hexdigest()).read_bytes() == content
            if meanwhile is not None:
                kept(store, meanwhile)
            raise ZeroDivisionError


def test_the_file_of_a_row_that_fails_is_removed(store: Store) -> None:
    failing(store, CONTENT)
    assert list(store.blobs()) == [] and store.kept_at(hashlib.sha256(CONTENT).hexdigest()) is None


def test_it_stays_if_it_was_there_before(store: Store) -> None:
    digest = kept(store)
    failing(store, CONTENT)
    assert [blob.digest for blob in store.blobs()] == [digest]


def test_it_stays_if_it_was_stored_again_meanwhile(tmp_path: Path) -> None:
    """In S3, whose clock counts seconds, ``settle`` puts it back."""
    store = Store(tmp_path)
    failing(store, CONTENT, meanwhile=CONTENT)
    assert [blob.digest for blob in store.blobs()] == [hashlib.sha256(CONTENT).hexdigest()]


def test_the_file_of_a_row_that_is_added_stays(store: Store) -> None:
    with store.temporary() as path:
        path.write_bytes(CONTENT)
        digest = hashlib.sha256(CONTENT).hexdigest()
        with store.kept_if(path, digest):
            pass
    assert store.path(digest).read_bytes() == CONTENT
