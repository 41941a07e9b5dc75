"""Empty stores, in a folder and in S3."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.s3 import opened_store
from workers.files import s3_store
from workers.files.store import Store


@pytest.fixture(params=["folder", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with opened_store(request.param, tmp_path, monkeypatch, store_cache_mib=1) as opened:
        yield opened


@pytest.fixture
def remote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    """In S3; its copies here are measured at once, and may be removed at once."""
    for name, value in (("LOOK_AFTER_S", -1.0), ("IN_USE_S", 0.0)):
        monkeypatch.setattr(s3_store, name, value)
    with opened_store("s3", tmp_path, monkeypatch, store_cache_mib=1) as opened:
        yield opened
