"""A store that answers wrongly, or not at all: what could not be found out is not absent, and nothing is lost."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from moto.server import ThreadedMotoServer

from tests.s3 import WRONG, Faulty, client_of, elsewhere, kept, key_of, root_of, s3_bucket, started_server
from tests.workers.databases import BOTH
from tests.workers.psf_examples import psf
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, PsfRow
from workers.files import garbage, s3_store
from workers.files.s3_store import Patience
from workers.files.store import BadFile, Store, StoreAway, open_store
from workers.settings import Settings

CONTENT = b"light" * 10_000
MANY = 1_000  # pairs; each takes 20 requests, of which the server and the client need 12 ms of a core each
SHORT = Patience(silence_s=1.0, tries=2, pause_s=0.0)
PATIENT = s3_store.WORKER


@pytest.fixture(scope="module")
def server() -> Iterator[ThreadedMotoServer]:
    server = started_server()
    yield server
    server.stop()


@pytest.fixture(scope="module")
def faulty(server: ThreadedMotoServer) -> Faulty:
    return Faulty(server)


@pytest.fixture
def store(server: ThreadedMotoServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    """A store in that server, which waits for a second."""
    monkeypatch.setattr(s3_store, "WORKER", SHORT)
    with s3_bucket(monkeypatch, server) as (url, _):
        yield open_store(Settings(data_dir=tmp_path / "data", store_url=url))


# Every way to look for a file; what it finds if the file is there, and if it is absent.
LOOKS: dict[str, tuple[Callable[[Store, str], object], object, object]] = {
    "path": (lambda store, digest: store.path(digest).exists(), True, "file-lost"),
    "verified": (lambda store, digest: store.verified(digest).exists(), True, "file-lost"),
    "size": (lambda store, digest: store.size(digest), len(CONTENT), None),
    "kept_at": (lambda store, digest: store.kept_at(digest) is not None, True, False),
    "state": (lambda store, digest: store.state(digest, None, content=True), "good", "lost"),
    "bring_back": (lambda store, digest: store.bring_back(digest), False, False),
    "set_aside": (lambda store, digest: store.set_aside(digest), False, False),
}


def found(store: Store, digest: str, look: str) -> object:
    """What a look finds; "away" if it could not find out."""
    try:
        return LOOKS[look][0](store, digest)
    except StoreAway:
        return "away"
    except FileNotFoundError:
        return "file-lost"
    except BadFile as error:
        return error.code


def test_a_wrong_answer_says_nothing_about_a_file(
    store: Store, faulty: Faulty, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither that it is absent nor that it is damaged."""
    monkeypatch.setattr(s3_store, "WORKER", replace(SHORT, tries=1))
    digest, other = kept(store, CONTENT), elsewhere(store, tmp_path)
    for kind in WRONG:
        with faulty.answering(kind), ThreadPoolExecutor(len(LOOKS)) as pool:
            answers = pool.map(partial(found, other, digest), LOOKS)
            for look, answer in zip(LOOKS, answers, strict=True):
                # An answer without a body cannot be cut.
                assert answer == "away" or (kind == "cut" and answer == LOOKS[look][1]), (kind, look, answer)
    for look, (_, there, absent) in LOOKS.items():
        assert (found(other, digest, look), found(other, "a" * 64, look)) == (there, absent), look


def test_one_wrong_answer_is_asked_again_or_told(store: Store, faulty: Faulty, tmp_path: Path) -> None:
    digest = kept(store, CONTENT)
    for number in range(4):
        other = elsewhere(store, tmp_path / str(number))
        with faulty.answering(share=0.3, hang_s=1.2):
            answers = {look: found(other, digest, look) for look in LOOKS}
        for look, answer in answers.items():
            assert answer in ("away", LOOKS[look][1]), (look, answer)


# Silence ----------------------------------------------------------------------------------------------------


def test_a_request_waits_for_silence_twice_and_then_not_for_a_while(
    store: Store, faulty: Faulty, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (s3_store.REQUEST.silence_s, s3_store.REQUEST.tries) == (10.0, 2)
    monkeypatch.setattr(s3_store, "REQUEST", Patience(silence_s=0.5, tries=2, pause_s=1.5))
    digest, absent = kept(store, CONTENT), "a" * 64
    settings = Settings(data_dir=tmp_path / "server", store_url=f"s3://{root_of(store)}")
    server = open_store(settings, within_requests=True)
    server.path(digest)

    def seconds(look: Callable[[], object]) -> float:
        started = time.monotonic()
        with pytest.raises(StoreAway):
            look()
        return time.monotonic() - started

    before = faulty.asked
    with faulty.answering("hang"):
        assert 1.0 <= seconds(lambda: server.size(absent)) < 2.5 and faulty.asked == before + 2
        assert seconds(lambda: server.size(digest)) < 0.2 and faulty.asked == before + 2
        assert server.path(digest).read_bytes() == CONTENT, "its copy is here"
    assert seconds(lambda: server.size(digest)) < 0.2, "it is not asked yet"
    time.sleep(1.5)
    assert server.size(digest) == len(CONTENT) and server.size(absent) is None


def test_the_check_of_a_store_that_hangs_ends_within_its_time(
    store: Store, faulty: Faulty, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert s3_store.PROBE_S < checks.CHECK_S
    monkeypatch.setattr(s3_store, "PROBE_S", 1.0)
    monkeypatch.setattr(s3_store, "WORKER", replace(SHORT, silence_s=30.0))
    hung = open_store(Settings(data_dir=tmp_path / "server", store_url=f"s3://{root_of(store)}"))
    hung.check()
    with faulty.answering("hang"):
        started = time.monotonic()
        with pytest.raises(checks.Unusable, match="object store"):
            checks.object_store(hung)
        assert time.monotonic() - started < 2.5
    hung.check()


# Files aside ------------------------------------------------------------------------------------------------


def image(digest: str) -> ImageRow:
    return ImageRow(owner="o", id=digest, created_at=1.0, bytes=len(CONTENT), summary={})


def test_the_only_copy_stays_aside_while_the_store_answers_wrongly(
    store: Store, faulty: Faulty, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a failover: no such bucket. A row refers to the file."""
    monkeypatch.setattr(garbage, "SETTLED_AFTER_S", -60.0)
    digest = kept(store, CONTENT)
    assert store.remove(digest, time.time() + 60.0)
    catalogue.add(image(digest))
    for kind in WRONG:
        with faulty.answering(kind), pytest.raises(StoreAway):
            garbage.settle(catalogue, store, {digest})
        assert store.aside() == {digest}, kind
    garbage.settle_old(catalogue, store)
    assert store.aside() == set() and client_of(store).cat_file(key_of(store, digest)) == CONTENT


def test_files_aside_go_once_they_are_confirmed_or_no_row_names_them(
    store: Store, faulty: Faulty, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five minutes after they were moved there, also if some of the answers of the store are wrong."""
    contents = [b"%d" % number for number in range(12)]
    digests = [kept(store, content) for content in contents]
    for digest in digests:
        assert store.remove(digest, time.time() + 60.0)
    for digest in digests[:8]:
        catalogue.add(image(digest))
    for digest in digests[:4]:
        assert store.size(digest) is not None, "it is needed, and comes back; its copy aside stays"
    garbage.settle_old(catalogue, store)
    assert store.aside() == set(digests), "they were moved a moment ago"
    clock = SimpleNamespace(time=lambda: time.time() + garbage.SETTLED_AFTER_S + 2.0)
    monkeypatch.setattr(garbage, "time", clock)
    with faulty.answering(share=0.1, hang_s=1.2):
        for _ in range(100):
            with suppress(StoreAway):
                garbage.settle_old(catalogue, store)
                break
    assert store.aside() == set()
    assert {blob.digest for blob in store.blobs()} == set(digests[:8])


# Deletions beside uploads -----------------------------------------------------------------------------------


def draft(digest: str, owner: str) -> PsfRow:
    return psf(digest, owner=owner, file_sha256=digest)


def upload(store: Store, catalogue: Catalogue, content: bytes, owner: str) -> bool:
    """Upload a file as a request does; returns whether it was accepted."""
    digest = hashlib.sha256(content).hexdigest()
    try:
        with store.temporary() as path:
            path.write_bytes(content)
            with store.kept_if(path, digest):
                catalogue.add(draft(digest, owner))
    except StoreAway:  # the answer is 503, and the client sends it again
        return False
    return True


def delete(store: Store, catalogue: Catalogue, digest: str, owner: str) -> None:
    catalogue.delete_draft(draft(digest, owner).id, owner)
    garbage.remove_unnamed(catalogue, store, [digest])


def pair(number: int, store: Store, catalogue: Catalogue) -> str | None:
    """An owner deletes a file, and another uploads it; returns the file if this upload was accepted, and not deleted
    later."""
    content = b"%d" % number
    digest = hashlib.sha256(content).hexdigest()
    while not upload(store, catalogue, content, "a"):
        pass
    with ThreadPoolExecutor(1) as beside:
        deleted = beside.submit(delete, store, catalogue, digest, "a")
        accepted = upload(store, catalogue, content, "b")
        deleted.result()
    if accepted:
        with suppress(StoreAway):
            assert store.state(digest, len(content), content=True) == "good", number
    if accepted and number % 4 == 0:
        delete(store, catalogue, digest, "b")
        return None
    return digest if accepted else None


def settled(store: Store, catalogue: Catalogue, ended: threading.Event) -> int:
    """Settle files aside once a second until the event; returns how often that was done to the end."""
    done = 0
    while not ended.wait(1.0):
        with suppress(StoreAway):
            garbage.settle_old(catalogue, store)
            done += 1
    return done


def check_pairs(
    store: Store,
    faulty: Faulty,
    catalogue: Catalogue,
    pairs: int,
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
) -> None:
    """One of 20 answers of the store is wrong. Who reads an accepted file finds it, or is told to try again later; at
    the end all accepted files are there, and no others.
    """
    # Longer than an upload takes between its file and its row: a call waits for 2 s.
    monkeypatch.setattr(garbage, "SETTLED_AFTER_S", 15.0)
    ended, before = threading.Event(), (faulty.asked, faulty.faults)
    with faulty.answering(share=0.05, hang_s=1.2):
        with ThreadPoolExecutor(1) as beside, ThreadPoolExecutor(8) as pool:
            settling = beside.submit(settled, store, catalogue, ended)
            try:
                there = set(pool.map(partial(pair, store=store, catalogue=catalogue), range(pairs))) - {None}
            finally:
                ended.set()
            rounds = settling.result()
        monkeypatch.setattr(garbage, "SETTLED_AFTER_S", -60.0)
        for _ in range(pairs):
            with suppress(StoreAway):
                garbage.settle_old(catalogue, store)
                break
    asked, faults = faulty.asked - before[0], faulty.faults - before[1]
    print(f"{pairs} pairs, {len(there)} accepted, {asked} requests, {faults} wrong answers, {rounds} rounds")
    assert len(there) > pairs / 3 and faults > asked / 40
    monkeypatch.setattr(s3_store, "WORKER", PATIENT)
    patient = elsewhere(store, folder)
    with ThreadPoolExecutor(4) as pool:
        states = set(pool.map(lambda digest: patient.state(digest, None, content=True), there))
    assert states == {"good"} and patient.aside() == set()


@BOTH
def test_no_accepted_upload_is_lost_while_the_store_answers_wrongly(
    store: Store, faulty: Faulty, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    check_pairs(store, faulty, catalogue, 20, monkeypatch, tmp_path)


@pytest.mark.slow
@BOTH
def test_no_accepted_upload_of_many_is_lost(
    store: Store, faulty: Faulty, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    check_pairs(store, faulty, catalogue, MANY, monkeypatch, tmp_path)
