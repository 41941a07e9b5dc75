"""A server that speaks S3, of the test's own, on a free port."""

from __future__ import annotations

import atexit
import logging
import uuid
from collections.abc import Iterator
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
