"""A server that speaks S3, of the test's own, on a free port."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import s3fs
from moto.server import ThreadedMotoServer

from workers.files.opened import open_store
from workers.files.store import Store
from workers.settings import Settings


@contextmanager
def s3_bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, ThreadedMotoServer]]:
    """The URL of a bucket that is empty, and its server; the environment says how to reach it."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
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
        yield f"s3://{bucket}/archive", server
    finally:
        server.stop()


@contextmanager
def opened_store(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **settings: object
) -> Iterator[Store]:
    """An empty store, in a folder or ("s3") in a bucket, whose settings may be given."""
    data = {"data_dir": tmp_path / "data"}
    if kind == "folder":
        yield open_store(Settings(**data))
        return
    with s3_bucket(monkeypatch) as (url, _):
        yield open_store(Settings.model_validate(data | {"store_url": url} | settings))
