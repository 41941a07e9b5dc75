"""Files by their hash, in a folder and in S3: stored whole or not at all, removed only if not stored again."""

from __future__ import annotations

import errno
import hashlib
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import pytest
from pydantic import ValidationError

from tests.s3 import client_of, digests, elsewhere, kept, key_of, s3_bucket
from workers.files import s3_store as remote_store
from workers.files.store import BadFile, Store, StoreAway, open_store
from workers.settings import Settings

CONTENT = b"light" * 1000
DIGEST = hashlib.sha256(CONTENT).hexdigest()
HOUR_S = 3600.0


def files_in(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file() and path.parent.name != "writers"]


def test_a_kept_file_is_whole_under_its_hash_and_nothing_else_is_left(store: Store, tmp_path: Path) -> None:
    with pytest.raises(InterruptedError), store.temporary() as path:
        path.write_bytes(b"half")
        raise InterruptedError
    assert files_in(tmp_path) == []
    with pytest.raises(FileNotFoundError):
        store.path("a" * 64).open("rb")
    assert kept(store, CONTENT) == DIGEST
    assert store.path(DIGEST).read_bytes() == CONTENT
    assert elsewhere(store, tmp_path).path(DIGEST).read_bytes() == CONTENT
    assert files_in(tmp_path / "data") == [store.path(DIGEST)]
    store.check()
    contents = {kept(store, content): len(content) for content in (b"a", b"bb")} | {DIGEST: len(CONTENT)}
    blobs = list(store.blobs())
    assert {blob.digest: blob.bytes for blob in blobs} == contents
    assert all(abs(blob.kept_at - time.time()) < 60 for blob in blobs)


def test_the_same_file_may_be_kept_by_many_at_once(store: Store) -> None:
    with ThreadPoolExecutor(6) as pool:
        assert set(pool.map(lambda _: kept(store, CONTENT), range(8))) == {DIGEST}
    assert digests(store) == {DIGEST}


def spoil(store: Store, content: bytes | None) -> None:
    """Change the content of the stored file, as a bad disk does; None: lose it."""
    if type(store) is Store:
        path = store.path(DIGEST)
        path.unlink() if content is None else path.write_bytes(content)
        return
    client, key = client_of(store), key_of(store, DIGEST)
    client.rm_file(key) if content is None else client.pipe_file(key, content)
    Store.path(store, DIGEST).unlink()


def test_a_file_that_is_not_what_was_stored_is_not_read(store: Store) -> None:
    for content, state in ((CONTENT[:-1], "damaged"), (bytes(len(CONTENT)), "damaged"), (None, "lost")):
        kept(store, CONTENT)
        assert store.verified(DIGEST).read_bytes() == CONTENT and store.size(DIGEST) == len(CONTENT)
        assert store.state(DIGEST, len(CONTENT), content=True) == "good"
        spoil(store, content)
        assert store.state(DIGEST, len(CONTENT), content=True) == state
        same_size = content is not None and len(content) == len(CONTENT)
        assert store.state(DIGEST, len(CONTENT), content=False) == ("good" if same_size else state)
        with pytest.raises(BadFile) as refused:
            store.verified(DIGEST)
        assert refused.value.code == f"file-{state}"
        assert store.set_aside(DIGEST) is (content is not None)
        assert store.size(DIGEST) is None
        assert kept(store, CONTENT) == DIGEST and store.verified(DIGEST).read_bytes() == CONTENT, (
            "stored again"
        )
        assert not store.set_aside(DIGEST), "a good file stays"


def test_a_file_is_removed_unless_it_was_kept_again_since(store: Store, tmp_path: Path) -> None:
    kept(store, CONTENT)
    assert not store.remove(DIGEST, kept_before=time.time() - HOUR_S)
    assert store.path(DIGEST).read_bytes() == CONTENT
    assert store.remove(DIGEST, kept_before=time.time() + HOUR_S)
    assert not store.remove(DIGEST, kept_before=time.time() + HOUR_S), "it is aside"
    assert digests(store) == set() and store.aside() == {DIGEST}
    assert store.aside(before=time.time() - HOUR_S) == set()
    store.delete_aside(DIGEST), store.delete_aside(DIGEST)
    assert store.aside() == set() and store.size(DIGEST) is None
    with pytest.raises(FileNotFoundError):
        elsewhere(store, tmp_path).path(DIGEST).open("rb")


def test_a_file_aside_comes_back_when_it_is_needed(store: Store, tmp_path: Path) -> None:
    for needed in (
        lambda: store.size(DIGEST) == len(CONTENT),
        lambda: elsewhere(store, tmp_path).path(DIGEST).read_bytes() == CONTENT,
        lambda: store.verified(DIGEST).read_bytes() == CONTENT,
        lambda: store.state(DIGEST, len(CONTENT), content=True) == "good",
        lambda: store.bring_back(DIGEST) and not store.bring_back(DIGEST),
    ):
        kept(store, CONTENT)
        assert store.remove(DIGEST, kept_before=time.time() + HOUR_S) and digests(store) == set()
        assert needed() and digests(store) == {DIGEST}
        store.delete_aside(DIGEST)
        assert store.verified(DIGEST).read_bytes() == CONTENT
    assert store.remove(DIGEST, kept_before=time.time() + HOUR_S)
    kept(store, CONTENT)
    assert not store.bring_back(DIGEST), "it was stored again"


def failing(store: Store, meanwhile: bool = False) -> None:
    """Keep a file for a row that then fails; meanwhile: another upload stores it in between."""
    with store.temporary() as path:
        path.write_bytes(CONTENT)
        with pytest.raises(ZeroDivisionError), store.kept_if(path, DIGEST):
            assert store.path(DIGEST).read_bytes() == CONTENT
            if meanwhile:
                kept(store, CONTENT)
            raise ZeroDivisionError


def test_the_file_of_a_row_that_fails_is_removed_unless_it_was_there_before(store: Store) -> None:
    failing(store)
    assert digests(store) == set() and store.kept_at(DIGEST) is None
    with store.temporary() as path:
        path.write_bytes(CONTENT)
        with store.kept_if(path, DIGEST):
            pass
    assert store.path(DIGEST).read_bytes() == CONTENT, "the row was added"
    failing(store)
    assert digests(store) == {DIGEST}


# In a folder ------------------------------------------------------------------------------------------


def test_a_file_that_is_stored_again_meanwhile_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    failing(store, meanwhile=True)
    assert digests(store) == {DIGEST}
    os.utime(store.path(DIGEST), (1.0, 1.0))
    before = time.time() - 1.0
    with store.temporary() as path:
        path.write_bytes(CONTENT)
        os.utime(path, (1.0, 1.0))  # of an upload that took long
        store.keep(path)
    (blob,) = store.blobs()
    assert blob.kept_at >= before and not store.remove(DIGEST, kept_before=before), "an old file is new again"
    os.utime(store.path(DIGEST), (1.0, 1.0))
    real, again = os.replace, []

    def kept_meanwhile(source: Path, target: Path) -> None:
        if not again and Path(source) == store.path(DIGEST):
            again.append(1)
            kept(store, CONTENT)
        real(source, target)

    monkeypatch.setattr(os, "replace", kept_meanwhile)
    assert not store.remove(DIGEST, kept_before=time.time() - 60.0)
    assert again and store.path(DIGEST).read_bytes() == CONTENT


def writer(folder: Path) -> subprocess.Popen[str]:
    """A process with a temporary file and a temporary folder, which waits."""
    code = (
        "import sys, pathlib; from workers.files.store import Store; store = Store(pathlib.Path(sys.argv[1]))\n"
        "with store.temporary() as file, store.temporary_folder() as inner:\n"
        "    file.write_text('half'); (inner / 'a').write_text('half'); print('ready', flush=True); sys.stdin.read()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    return process


def test_a_sweep_removes_only_the_temporary_files_of_ended_processes(tmp_path: Path) -> None:
    """However old the files look: the clock of one of the machines may be wrong."""
    store, tmp = Store(tmp_path), tmp_path / "tmp"
    with writer(tmp_path) as living, store.temporary() as own:
        own.write_bytes(b"half")
        for path in tmp.iterdir():
            os.utime(path, (0, 0))
        Store(tmp_path).sweep()
        assert len(list(tmp.iterdir())) == 3, "all are in use"
        living.kill()
        living.wait()
        Store(tmp_path).sweep()
        assert list(tmp.iterdir()) == [own]
    assert list(tmp.iterdir()) == []


def test_sweeps_at_the_same_moment_as_new_writers_remove_nothing_in_use(tmp_path: Path) -> None:
    def write(_: int) -> bool:
        store = Store(tmp_path)
        with store.temporary() as path:
            path.write_bytes(b"half")
            Store(tmp_path).sweep()
            return path.exists()

    with ThreadPoolExecutor(8) as threads:
        assert all(threads.map(write, range(200)))


# In S3 ------------------------------------------------------------------------------------------------


def test_a_damaged_copy_is_downloaded_again_and_a_damaged_download_is_refused(remote: Store) -> None:
    kept(remote, CONTENT)
    remote.path(DIGEST).write_bytes(b"damaged")
    assert remote.state(DIGEST, len(CONTENT), content=True) == "good", "the object is"
    assert remote.verified(DIGEST).read_bytes() == CONTENT
    copy = remote.path(DIGEST)
    copy.unlink()
    client_of(remote).pipe_file(key_of(remote, DIGEST), b"something else")
    with pytest.raises(BadFile, match="its content has changed"):
        remote.path(DIGEST)
    assert not copy.exists()


def test_a_file_kept_again_is_sent_again(remote: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    client, sent = client_of(remote), []
    real = client.put_file
    monkeypatch.setattr(client, "put_file", lambda *given: sent.append(given[1]) or real(*given))
    kept(remote, CONTENT), kept(remote, CONTENT)
    assert sent == [key_of(remote, DIGEST)] * 2


def test_a_file_kept_while_it_is_put_aside_stays(remote: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    client, again = client_of(remote), []
    kept(remote, CONTENT)
    copied, asked = client.cp_file, client.call_s3

    def kept_meanwhile(source: str, target: str) -> None:
        copied(source, target)
        again.append(kept(remote, CONTENT))

    def as_old(method: str, **how: object) -> dict[str, object]:
        about = asked(method, **how)
        return about if again else about | {"LastModified": about["LastModified"] - timedelta(days=9)}

    monkeypatch.setattr(client, "cp_file", kept_meanwhile)
    monkeypatch.setattr(client, "call_s3", as_old)
    assert not remote.remove(DIGEST, kept_before=time.time() - HOUR_S)
    assert again == [DIGEST] and digests(remote) == {DIGEST}
    assert remote.aside() == {DIGEST} and not remote.bring_back(DIGEST)
    remote.delete_aside(DIGEST)
    assert digests(remote) == {DIGEST}, "the copy alone is dropped"


def test_copies_have_a_bounded_size_and_those_in_use_stay(
    remote: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def copies() -> set[str]:
        return {path.name for path in files_in(tmp_path / "data" / "copies")}

    sizes, names = 300_000, []
    for number in range(6):
        names.append(kept(remote, bytes([number]) * sizes))
        os.utime(remote.path(names[0]))  # in use all the time
        time.sleep(0.01)
    assert len(copies()) * sizes <= 2**20
    assert {names[0], names[-1]} <= copies() and names[1] not in copies()
    assert remote.path(names[1]).read_bytes() == bytes([1]) * sizes, "it is fetched again"
    monkeypatch.setattr(remote_store, "IN_USE_S", 60.0)
    used = {kept(remote, bytes([number]) * sizes) for number in range(10, 16)}
    assert used <= copies()


def test_a_full_disk_of_the_copies_is_not_an_object_store_that_is_away(
    remote: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept(remote, CONTENT)
    fresh = elsewhere(remote, tmp_path)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(client_of(fresh), "get_file", full)
    with pytest.raises(OSError, match="No space left") as error:
        fresh.path(DIGEST)
    assert not isinstance(error.value, StoreAway)


def test_a_server_that_is_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with s3_bucket(monkeypatch) as (url, server):
        store = open_store(Settings(data_dir=tmp_path / "data", store_url=url))
        kept(store, CONTENT)
        server.stop()
        assert store.path(DIGEST).read_bytes() == CONTENT, "what is here is read"
        store.path(DIGEST).unlink()
        for attempt in (
            lambda: store.path(DIGEST),
            lambda: kept(store, CONTENT),
            store.check,
            lambda: digests(store),
            store.aside,
            lambda: store.bring_back(DIGEST),
        ):
            with pytest.raises(StoreAway):
                attempt()
        assert list((tmp_path / "data" / "tmp").iterdir()) == []


def test_an_invalid_url_is_refused(tmp_path: Path) -> None:
    for url in ("http://x/y", "s3://", "file:///etc", "bucket"):
        with pytest.raises(ValidationError):
            Settings(data_dir=tmp_path, store_url=url)
