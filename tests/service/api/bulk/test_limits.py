"""What a bulk run would do, and the limits that hold for each of its images as for a single job."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from tests.conftest import write_image
from tests.service.api.bulk.conftest import FEW, failures, now, started
from tests.service.conftest import refusal, result_of, upload, work_through_bulks
from tests.workers.jobs import run_job
from workers.bulk import dry_run
from workers.bulk import task as bulk_task
from workers.bulk.runs import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.files.store import Store
from workers.intake.costs import COSTS, Cost
from workers.run import attempt, runner
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks import deconvolve as deconvolve_task


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


def test_a_dry_run_tells_what_the_run_then_does(
    api: TestClient, archive: Path, psf_id: str, work: Callable[[], None]
) -> None:
    noise = {"photon_gain_dn": 6.0, "read_noise_dn": 2.0}
    parameters = FEW | {"error_draws": 2, "noise": noise}
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


def test_an_image_over_a_limit_fails_like_a_single_job(
    settings: Settings, tmp_path: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # So slow a machine that the limit parts the images, and no clock does.
    monkeypatch.setitem(COSTS, "deconvolve", Cost(base_s=0.6, pixel_ns=1e6))
    shapes = {"a": (96, 128), "b": (512, 512)}
    archive = tmp_path / "archive"
    archive.mkdir()
    for number, (name, shape) in enumerate(shapes.items()):
        write_image(archive / f"{name}.fits", shape=shape, seed=number)
    limited = settings.model_copy(update={"worker_threads": 1, "max_upload_mib": 4, "max_job_s": 60.0})
    worked_on: list[tuple[int, ...]] = []
    make = deconvolve_task.make

    def seen(workspace: Any, request: Any, read: Any, **more: Any) -> Any:
        worked_on.append(read().pixels.shape)
        return make(workspace, request, read, **more)

    monkeypatch.setattr(deconvolve_task, "make", seen)
    with TestClient(create_app(limited)) as api:
        psf_id = upload(api, psf_file, "/v1/psfs")
        ids = [upload(api, archive / f"{name}.fits") for name in shapes]
        body = {"kind": "deconvolve", "parameters": {"image_id": ids[1], "psf_id": psf_id, **FEW}}
        alone = api.post("/v1/jobs", json=body)
        detail = refusal(alone, 422, "too-much-time")
        asked = {"files": [{"glob": f"{archive}/*.fits"}]}
        bulk = api.post("/v1/bulk", json={"psf_id": psf_id, "parameters": FEW, **asked}).json()
        work_through_bulks(limited)
        ended = now(api, bulk)
        assert (ended["phase"], ended["images"]["done"], ended["images"]["failed"]) == ("COMPLETED", 1, 1)
        (failed,) = failures(api, bulk)
        assert failed["error"] == {"fault": "user", "code": "too-much-time", "message": detail}
        assert failed["source"] == str(archive / "b.fits")
        assert worked_on == [(96, 128)]


def test_an_image_that_takes_too_long_fails_but_a_turn_may_last_longer(
    settings: Settings, tmp_path: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limited = settings.model_copy(update={"max_job_s": 30.0})
    clock = _Clock()
    for module in (runner, attempt):  # both measure the time of an attempt
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(bulk_task, "TELL_EVERY_S", 0.0)
    make = deconvolve_task.make

    def slow(workspace: Any, request: Any, read: Any, **more: Any) -> Any:
        clock.ahead_s += 100.0 if read().pixels.shape == (80, 128) else 20.0
        return make(workspace, request, read, **more)

    monkeypatch.setattr(deconvolve_task, "make", slow)
    with TestClient(create_app(limited)) as api:
        psf_id = upload(api, psf_file, "/v1/psfs")
        ids = []
        for number, shape in enumerate([(96, 128), (96, 128), (80, 128), (96, 128)]):
            write_image(tmp_path / f"{number}.fits", shape=shape, seed=number)
            ids.append(upload(api, tmp_path / f"{number}.fits"))
        bulk = api.post("/v1/bulk", json={"images": ids, "psf_id": psf_id, "parameters": FEW}).json()
        catalogue = Catalogue(limited.catalogue_url)
        keep_turns(catalogue, limited)
        (turn,) = catalogue.jobs.of_kind("bulk")
        run_job(Runner(limited, catalogue, Store(limited.data_dir)), catalogue, turn.id)
        catalogue.close()
        ended = now(api, bulk)
        assert (ended["phase"], ended["images"]["done"], ended["images"]["failed"]) == ("COMPLETED", 3, 1)
        (failed,) = failures(api, bulk)
        assert (failed["source"], failed["error"]["code"]) == (ids[2], "took-too-long")
        assert failed["error"]["fault"] == "user" and "30 s" in failed["error"]["message"]


class _Clock:
    """The runner's clock, which can be put ahead."""

    ahead_s = 0.0

    def monotonic(self) -> float:
        return time.monotonic() + self.ahead_s

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)
