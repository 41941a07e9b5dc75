"""Where jobs and the images of bulks spend their time, as ``/metrics`` tells it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families

from tests.conftest import write_image
from tests.service.conftest import job_after, upload
from workers.bulk.turns import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.stage_times import KeptStageTimes
from workers.settings import Settings

FEW = {"method": {"name": "richardson-lucy", "steps": 3}}


def told(api: TestClient, kind: str) -> dict[str, tuple[float, float]]:
    """Seconds and steps of a kind's stages."""
    found: dict[str, dict[str, float]] = {}
    for family in text_string_to_metric_families(api.get("/metrics").text):
        if family.name.startswith("heliopsf_job_stage"):
            assert family.type == "counter"
        for sample in family.samples:
            if sample.labels.get("kind") == kind and "stage" in sample.labels:
                found.setdefault(sample.labels["stage"], {})[sample.name] = sample.value
    return {
        stage: (values["heliopsf_job_stage_seconds_total"], values["heliopsf_job_stage_steps_total"])
        for stage, values in found.items()
    }


def test_a_deconvolution_s_stages_outlive_it(
    api: TestClient, image_file: Path, psf_file: Path, run_jobs: Callable[[], None]
) -> None:
    assert told(api, "deconvolve") == {}
    ids = {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")}
    ended = job_after(api, run_jobs, "deconvolve", **ids, **FEW)
    stages = told(api, "deconvolve")
    assert set(stages) == {"starting", "reading", "deconvolving", "saving"}
    assert stages["deconvolving"][1] == 3 and stages["saving"][1] == 1
    assert all(seconds > 0 for seconds, _ in stages.values())
    assert sum(seconds for seconds, _ in stages.values()) <= ended["ended_at"] - ended["started_at"] + 0.05
    assert api.delete(f"/uws/jobs/{ended['id']}", follow_redirects=False).status_code == 303
    assert told(api, "deconvolve") == stages


def test_images_of_a_bulk_are_counted_and_written_once_a_turn(
    api: TestClient,
    settings: Settings,
    catalogue: Catalogue,
    tmp_path: Path,
    psf_file: Path,
    run_jobs: Callable[[], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    images = []
    for number in range(3):
        write_image(tmp_path / f"{number}.fits", seed=number)
        images.append(upload(api, tmp_path / f"{number}.fits"))
    written: list[str] = []
    add = KeptStageTimes.add

    def counted(kept: KeptStageTimes, kind: str, spent: Any) -> None:
        written.append(kind)
        add(kept, kind, spent)

    monkeypatch.setattr(KeptStageTimes, "add", counted)
    bulk = {"images": images, "psf_id": upload(api, psf_file, "/v1/psfs"), "parameters": FEW}
    assert api.post("/v1/bulk", json=bulk).status_code == 202
    keep_turns(catalogue, settings)
    run_jobs()
    assert written == ["bulk"]
    stages = told(api, "bulk")
    assert stages["deconvolving"][1] == 9 and set(stages) >= {"reading", "saving", "between images"}
    assert "images" not in stages
