"""A server that speaks S3, of the test's own, on a free port."""

from __future__ import annotations

import atexit
import logging
import random
import threading
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import botocore.session
import pytest
import s3fs
from moto.server import ThreadedMotoServer

from workers.files.store import Store, open_store
from workers.settings import Settings

# Each client reads the description of the interface, a megabyte of JSON: it is read once in this process.
botocore.session.create_loader = cache(botocore.session.create_loader)


def started_server() -> ThreadedMotoServer:
    """A new server; whoever starts it stops it."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    return server


@cache
def shared_server() -> ThreadedMotoServer:
    """The server of all tests of this process that do not stop it."""
    server = started_server()
    atexit.register(server.stop)
    return server


# --- wrong answers ---------------------------------------------------------------------------------------

_CANNED = {
    "no such bucket": (404, "NoSuchBucket"),
    "no such key": (404, "NoSuchKey"),
    "404": (404, None),
    "500": (500, "InternalError"),
}
WRONG = (*_CANNED, "hang", "hang when done", "cut")


class Faulty:
    """The application of a server, which answers some requests wrongly: as ``_CANNED`` says, or never ("hang": and does
    nothing; "hang when done"), or with half a body ("cut").

    asked, faults: numbers of requests and of wrong answers.
    """

    def __init__(self, server: ThreadedMotoServer, seed: int = 1) -> None:
        about: Any = server._server
        self._app, about.app = about.app, self
        self.asked, self.faults = 0, 0
        self._share, self._kinds, self._hang_s = 0.0, WRONG, 0.0
        self._chance, self._lock, self._end = random.Random(seed), threading.Lock(), threading.Event()

    @contextmanager
    def answering(self, *kinds: str, share: float = 1.0, hang_s: float = 60.0) -> Iterator[None]:
        """Answer this share of the requests wrongly during the block. kinds: of ``WRONG``; none: all."""
        self._share, self._kinds, self._hang_s = share, kinds or WRONG, hang_s
        self._end.clear()
        try:
            yield
        finally:
            self._share = 0.0
            self._end.set()

    def __call__(self, environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        with self._lock:
            self.asked += 1
            wrong = self._chance.random() < self._share
            kind = self._chance.choice(self._kinds) if wrong else None
            self.faults += wrong
        if kind is None or (kind == "cut" and environ["REQUEST_METHOD"] == "HEAD"):  # which has no body
            return self._app(environ, start)  # type: ignore[no-any-return]
        if kind not in ("hang when done", "cut"):
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        if kind in _CANNED:
            status, code = _CANNED[kind]
            body = "" if code is None else f"<?xml version='1.0'?><Error><Code>{code}</Code></Error>"
            sent = b"" if environ["REQUEST_METHOD"] == "HEAD" else body.encode()
            start(
                f"{status} Wrong", [("Content-Length", str(len(sent))), ("Content-Type", "application/xml")]
            )
            return [sent]
        answer: list[Any] = []
        body = b"" if kind == "hang" else b"".join(self._app(environ, lambda *given: answer.extend(given)))
        if kind == "cut":
            headers = [one for one in answer[1] if one[0].lower() not in ("content-length", "connection")]
            start(answer[0], [*headers, ("Content-Length", str(len(body) + 100)), ("Connection", "close")])
            return [body[: len(body) // 2]]
        self._end.wait(self._hang_s)
        start("503 Late", [("Content-Length", "0"), ("Connection", "close")])
        return [b""]


@contextmanager
def s3_bucket(
    monkeypatch: pytest.MonkeyPatch, server: ThreadedMotoServer | None = None
) -> Iterator[tuple[str, ThreadedMotoServer]]:
    """The URL of a bucket that is empty, and its server, by default a new one; the environment says how to reach it."""
    own = started_server() if server is None else server
    host, port = own.get_host_and_port()
    for name, value in {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
    }.items():
        monkeypatch.setenv(name, value)
    bucket = f"test-{uuid.uuid4().hex[:12]}"
    try:
        s3fs.S3FileSystem(skip_instance_cache=True).mkdir(bucket)
        yield f"s3://{bucket}/archive", own
    finally:
        if server is None:
            own.stop()


@contextmanager
def opened_store(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **settings: object
) -> Iterator[Store]:
    """An empty store, in a folder or ("s3") in a bucket, whose settings may be given."""
    data = {"data_dir": tmp_path / "data"}
    if kind == "folder":
        yield open_store(Settings(**data))
        return
    with s3_bucket(monkeypatch, shared_server()) as (url, _):
        yield open_store(Settings.model_validate(data | {"store_url": url} | settings))


def client_of(store: Store) -> Any:
    """The client with which a store speaks to its bucket."""
    return store._s3  # type: ignore[attr-defined]


def root_of(store: Store) -> str:
    """The bucket of a store and the prefix of its objects."""
    return str(store._root)  # type: ignore[attr-defined]


def key_of(store: Store, digest: str) -> str:
    """The object in which a file is stored."""
    return f"{root_of(store)}/blobs/{digest[:2]}/{digest}"


def elsewhere(store: Store, folder: Path) -> Store:
    """The same files as another machine has them, which has no copy of them; a store in a folder is the same."""
    if type(store) is Store:
        return store
    return open_store(Settings(data_dir=folder / "elsewhere", store_url=f"s3://{root_of(store)}"))


def kept(store: Store, content: bytes) -> str:
    """Store a file; returns its SHA-256."""
    with store.temporary() as path:
        path.write_bytes(content)
        return store.keep(path)


def digests(store: Store) -> set[str]:
    """The SHA-256 of all files of a store."""
    return {blob.digest for blob in store.blobs()}
