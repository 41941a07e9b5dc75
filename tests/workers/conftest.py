"""A temporary store and catalogue, and files taken into them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.local import LocalService
from workers.settings import Settings


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", database_url=None, broker_url="filesystem://")


@pytest.fixture
def local(settings: Settings) -> Iterator[LocalService]:
    service = LocalService(settings)
    yield service
    service.close()
