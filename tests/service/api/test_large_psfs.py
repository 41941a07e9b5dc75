"""PSFs have limits of their own: larger than those of images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from psfcore.fits.blocks import FitsLimits
from tests.conftest import write_image, write_psf
from tests.service.conftest import refusal, upload
from workers.settings import Settings


def test_a_psf_may_be_larger_than_the_largest_image(
    api: TestClient,
    settings: Settings,
    run_jobs: Callable[[], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_psf(tmp_path / "psf.fits", size=1024)
    write_image(tmp_path / "i.fits")
    assert settings.max_pixels < 1024**2 < settings.max_psf_pixels
    assert settings.max_upload_bytes < (tmp_path / "psf.fits").stat().st_size < settings.max_psf_bytes
    sent = (tmp_path / "psf.fits").read_bytes()
    refusal(api.post("/v1/images", content=sent), 413, "too-large")
    named = {
        "image_id": upload(api, tmp_path / "i.fits"),
        "psf_id": upload(api, tmp_path / "psf.fits", "/v1/psfs"),
    }
    named |= {"method": {"name": "richardson-lucy", "steps": 1}}
    job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": named}).json()
    run_jobs()
    assert api.get(f"/v1/jobs/{job['id']}").json()["phase"] == "COMPLETED"
    write_psf(tmp_path / "larger.fits", size=1026)
    monkeypatch.setattr(Settings, "psf_limits", FitsLimits(max_pixels=1024**2))
    refusal(api.post("/v1/psfs", content=(tmp_path / "larger.fits").read_bytes()), 422, "too-many-pixels")
