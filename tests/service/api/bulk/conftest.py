"""What tests of bulk runs share."""

from __future__ import annotations

from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from tests.conftest import write_psf
from tests.service.conftest import upload


@pytest.fixture
def psf_id(api: TestClient, tmp_path: Path) -> str:
    write_psf(tmp_path / "psf.fits")
    return upload(api, tmp_path / "psf.fits", "/v1/psfs")
