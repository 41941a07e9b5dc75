"""What tests of bulk runs share: folders that the service may read and write, and the run of all turns."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from workers.settings import Settings

FEW = {"method": {"name": "richardson-lucy", "steps": 1}}


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    """Bulk runs may read the folder archive, and write into the folder out."""
    folders = {"bulk_roots": str(tmp_path / "archive"), "bulk_output_roots": str(tmp_path / "out")}
    return settings.model_copy(update=folders)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def started(api: TestClient, **request: Any) -> dict[str, Any]:
    """A new bulk run."""
    answer = api.post("/v1/bulk", json={"parameters": FEW, **request})
    assert answer.status_code == 202, answer.text
    assert answer.headers["Location"] == f"/v1/bulk/{answer.json()['id']}"
    return dict(answer.json())


def now(api: TestClient, bulk: dict[str, Any]) -> dict[str, Any]:
    """The bulk run as it is now."""
    return dict(api.get(f"/v1/bulk/{bulk['id']}").json())


def results(api: TestClient, bulk: dict[str, Any], **query: str) -> list[dict[str, Any]]:
    answer = api.get(f"/v1/bulk/{bulk['id']}/results", params=query)
    assert answer.status_code == 200 and answer.headers["Content-Type"].startswith("application/x-ndjson")
    return [json.loads(line) for line in answer.text.splitlines()]


def failures(api: TestClient, bulk: dict[str, Any]) -> list[dict[str, Any]]:
    return list(api.get(f"/v1/bulk/{bulk['id']}/failures").json()["items"])
