"""Dry runs of bulk runs: the same refusals as the run, and a size and a time, without a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.conftest import write_image
from tests.service.api.bulk.conftest import FEW, failures, now, started
from tests.service.conftest import refusal, result_of, upload
from workers.bulk import dry_run


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Three images of a channel, one of another, and a letter."""
    root = tmp_path / "archive"
    root.mkdir()
    for number, channel in enumerate((174, 174, 174, 304)):
        write_image(root / f"{number}.fits", shape=(256, 256), seed=number, WAVELNTH=channel)
    (root / "letter.fits").write_text("Dear archive,\n" * 300)
    return root


def estimated(api: TestClient, query: str = "", **request: Any) -> dict[str, Any]:
    answer = api.post(f"/v1/bulk/estimate{query}", json={"parameters": FEW, **request})
    assert answer.status_code == 200, answer.text
    assert api.get("/v1/bulk").json()["items"] == [], "an estimate starts nothing"
    return dict(answer.json())


@pytest.mark.parametrize("draws", [0, 2])
def test_a_dry_run_tells_what_the_run_then_does(
    api: TestClient, archive: Path, psf_id: str, work: Callable[[], None], draws: int
) -> None:
    noise = {"photon_gain_dn": 6.0, "read_noise_dn": 2.0}
    parameters = FEW | {"error_draws": draws, "noise": noise}
    files = [{"glob": f"{archive}/{name}"} for name in ("[03].fits", "l*")]
    request = {"files": files, "psf_id": psf_id, "parameters": parameters}
    told = estimated(api, **request)
    assert told["complete"] and (told["images"], told["examined"], told["refused_images"]) == (3, 3, 1)
    assert told["seconds"] > 0 and told["workers"] == 1 and told["memory_mib"] > 0
    bulk = started(api, **request)
    work()
    images = now(api, bulk)["images"]
    assert (images["total"], images["done"], images["failed"]) == (3, 2, 1)
    (failed,) = failures(api, bulk)
    assert told["refused"] == [{"source": failed["source"], "error": failed["error"]}]
    products = sum(one["bytes"] for one in api.get("/v1/products").json()["items"])
    assert told["output_bytes"] == pytest.approx(products, rel=0.05)


def test_conditions_and_patterns_choose_the_images_and_a_sample_stands_for_all(
    api: TestClient, archive: Path, psf_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [{"glob": f"{archive}/?.fits", "where": {"WAVELNTH": 304}}, {"glob": f"{archive}/[0-3].fits"}]
    assert estimated(api, files=files[:1], psf_id=psf_id)["images"] == 1
    whole = estimated(api, files=files, psf_id=psf_id)
    one = estimated(api, "?sample=1", files=files[1:], psf_id=psf_id)
    assert (whole["images"], one["images"], one["examined"]) == (4, 4, 1)
    assert one["output_bytes"] == whole["output_bytes"]
    assert one["seconds"] == pytest.approx(whole["seconds"], abs=0.2)
    assert api.post("/v1/bulk/estimate?sample=0", json={"files": files, "psf_id": psf_id}).status_code == 422
    monkeypatch.setattr(dry_run, "BUDGET_S", -1.0)
    late = estimated(api, files=files, psf_id=psf_id)
    assert not late["complete"] and late["examined"] == 0, "it ends in time"


def test_a_product_that_exists_costs_nothing(
    api: TestClient, archive: Path, psf_id: str, run_jobs: Callable[[], None]
) -> None:
    ids = [upload(api, archive / f"{number}.fits") for number in range(2)]
    before = estimated(api, images=ids, psf_id=psf_id)
    assert before["existing"] == 0
    result_of(api, run_jobs, "deconvolve", image_id=ids[0], psf_id=psf_id, **FEW)
    after = estimated(api, images=ids, psf_id=psf_id)
    assert (after["existing"], after["output_bytes"]) == (1, before["output_bytes"] // 2)


def test_errors_of_the_whole_run_are_those_of_the_run(api: TestClient, archive: Path, psf_id: str) -> None:
    elsewhere = {"files": [{"glob": "/etc/*"}], "psf_id": psf_id}
    for request in (elsewhere, {"images": ["a" * 64], "psf_id": psf_id}):
        answers = [api.post(where, json=request) for where in ("/v1/bulk", "/v1/bulk/estimate")]
        assert answers[0].status_code == answers[1].status_code >= 400
        assert answers[0].json()["detail"] == answers[1].json()["detail"]
    none = api.post("/v1/bulk/estimate", json={"files": [{"glob": f"{archive}/x*"}], "psf_id": psf_id})
    refusal(none, 422, "no-images")
