"""Bulk runs over HTTP, with turns in this process: from uploads and an archive, into the service and a folder."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from fastapi.testclient import TestClient

from psfcore.deconvolve import run
from tests.conftest import write_image, write_psf
from tests.service.api.bulk.conftest import FEW, failures, now, results, started
from tests.service.conftest import upload
from tests.workers.jobs import run_job
from workers.bulk import image as bulk_image
from workers.bulk.runs import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.contract.jobs import Queue
from workers.files import archive as archive_files
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks import deconvolve as deconvolve_task

Work = Callable[[], None]


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Three images of two channels, and one file that is none."""
    root = tmp_path / "archive"
    for number, channel in enumerate((174, 174, 304)):
        path = root / str(2020 + number) / f"image {number}.fits"
        path.parent.mkdir(parents=True)
        cards = {"WAVELNTH": channel, "INSTRUME": "EUI", "DATE-BEG": f"{2020 + number}-03-01T12:00:00"}
        write_image(path, seed=number, **cards)
    (root / "2020" / "letter.fits").write_text("Dear archive,\n" * 300)
    return root


@pytest.fixture
def files(archive: Path) -> list[dict[str, str]]:
    """The pattern of all images."""
    return [{"glob": f"{archive}/*/image*"}]


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """One entry for each deconvolution that was really made."""
    made: list[object] = []
    real = deconvolve_task.make
    monkeypatch.setattr(deconvolve_task, "make", lambda *a, **k: made.append(a) or real(*a, **k))
    return made


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_uploads_become_products_and_a_manifest(
    api: TestClient, archive: Path, psf_id: str, work: Work
) -> None:
    ids = [upload(api, path) for path in sorted(archive.glob("*/image*"))[:2]]
    bulk = started(api, images=[*ids, ids[0]], psf_id=psf_id, name="two")
    assert bulk["phase"] == "RUNNING" and bulk["images"]["total"] == 2
    work()
    bulk = now(api, bulk)
    assert bulk["phase"] == "COMPLETED" and bulk["images"]["done"] == 2 and bulk["images"]["failed"] == 0
    assert bulk["images_an_hour"] > 0 and bulk["time_left_s"] is None
    manifest = results(api, bulk)
    assert [line["source"] for line in manifest] == ids
    for line in manifest:
        file = api.get(line["file"]).content
        assert hashlib.sha256(file).hexdigest() == line["sha256"] and len(file) == line["bytes"]
        product = api.get(f"/v1/products/{line['product_id']}").json()
        assert line["score"] == product["details"]["changes"]["artefacts"]["score"]
        assert line["flux_change_pct"] == product["details"]["flux_change_pct"]
        assert product["details"]["job_id"] == bulk["id"]
        assert line["thumbnail"] == product["thumbnail"] == f"/v1/products/{line['product_id']}/thumbnail"
        assert api.get(line["thumbnail"]).headers["Content-Type"] == "image/png"
        assert line["provenance"] == f"/v1/products/{line['product_id']}/provenance"
        assert f"product:{line['product_id']}" in api.get(line["provenance"]).json()["entity"]
        assert line["psf_id"] == psf_id and line["seconds"] >= line["kernel_seconds"] > 0
    assert [line["id"] for line in api.get("/v1/bulk").json()["items"]] == [bulk["id"]]


def test_files_are_found_by_pattern_and_header(
    api: TestClient, archive: Path, psf_id: str, work: Work
) -> None:
    pattern = {"glob": f"{archive}/**/*.fits", "where": {"INSTRUME": "EUI", "WAVELNTH": 174}}
    bulk = started(api, files=[pattern], psf_id=psf_id)
    assert bulk["phase"] == "LISTING"
    work()
    bulk = now(api, bulk)
    assert bulk["phase"] == "COMPLETED"
    counts = {"total": 3, "waiting": 0, "at_work": 0, "done": 2, "reused": 0, "failed": 1}
    assert {name: bulk["images"][name] for name in counts} == counts
    assert [Path(line["source"]).name for line in results(api, bulk)] == ["image 0.fits", "image 1.fits"]
    (failed,) = api.get(bulk["failures"]).json()["items"]
    assert failed["source"].endswith("letter.fits") and failed["error"]["code"] == "not-fits"
    assert failed["error"]["fault"] == "user"


def test_results_by_artefact_score_and_as_csv_and_an_existing_product_is_not_made_again(
    api: TestClient, files: list[dict[str, str]], psf_id: str, work: Work, computed: list[object]
) -> None:
    first = started(api, files=files, psf_id=psf_id)
    assert api.post("/v1/bulk", json={"files": files, "psf_id": psf_id, "parameters": FEW}).status_code == 200
    address = f"/v1/bulk/{first['id']}/results"
    empty = api.get(address, params={"format": "csv"})
    assert empty.headers["Content-Type"].startswith("text/csv") and empty.text.startswith("position,source,")
    work()
    lines, worst = results(api, first), results(api, first, order="worst")
    scores = [line["score"] for line in worst]
    assert scores == sorted(scores, reverse=True) and len(worst) == len(computed) == 3
    assert results(api, first, order="worst", limit="2") == worst[:2]
    rows = list(csv.DictReader(io.StringIO(api.get(address, params={"format": "csv"}).text)))
    assert [row["sha256"] for row in rows] == [line["sha256"] for line in lines]
    assert [float(row["bright_sum_pct"]) for row in rows] == [line["bright"]["sum_pct"] for line in lines]

    second = started(api, files=files, psf_id=psf_id)
    assert second["id"] != first["id"]
    work()
    assert now(api, second)["images"]["reused"] == 3 and len(computed) == 3
    own = {"reused", "seconds", "kernel_seconds", "ended_at"}
    for line, again in zip(lines, results(api, second), strict=True):
        assert {name: line[name] for name in line.keys() - own} == {
            name: again[name] for name in again.keys() - own
        }


def test_products_in_a_folder_beside_the_service(
    api: TestClient, archive: Path, psf_id: str, work: Work, out: Path
) -> None:
    output = {"folder": str(out / "run 1")}
    bulk = started(api, files=[{"glob": f"{archive}/2020/image*"}], psf_id=psf_id, output=output)
    work()
    (line,) = results(api, bulk)
    written = Path(line["output"])
    assert written == out / "run 1" / f"image_0-{line['product_id'][:16]}.fits"
    assert sha256(written) == line["sha256"] == hashlib.sha256(api.get(line["file"]).content).hexdigest()
    with fits.open(written, checksum=True) as hdus:
        assert hdus[0].header["PRODID"] == line["product_id"]
    assert [path.name for path in written.parent.iterdir()] == [written.name], "nothing half-written is left"


def test_an_unwritable_output_folder_fails_before_the_deconvolution(
    api: TestClient, archive: Path, psf_id: str, work: Work, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out.mkdir()
    (out / "run").write_text("a file where the folder is to be")
    # Root may write to any folder: what the system would answer to another user.
    monkeypatch.setattr(archive_files.os, "access", lambda *_, **__: False)
    monkeypatch.delattr(bulk_image.deconvolve_task, "make")
    for folder, reason in (("run", "Not a directory"), ("other", "Permission denied")):
        output = {"folder": str(out / folder)}
        bulk = started(api, files=[{"glob": f"{archive}/2020/image*"}], psf_id=psf_id, output=output)
        work()
        (failed,) = failures(api, bulk)
        assert failed["error"]["code"] == "output-not-written" and reason in failed["error"]["message"]


def test_products_only_in_a_folder(
    api: TestClient,
    files: list[dict[str, str]],
    psf_id: str,
    settings: Settings,
    work: Work,
    out: Path,
    computed: list[object],
) -> None:
    request = {"files": files, "psf_id": psf_id, "output": {"folder": str(out), "only": True}}
    first = started(api, **request)
    work()
    lines = results(api, first)
    assert len(lines) == 3 and all(line["file"] is None and not line["reused"] for line in lines)
    assert all(sha256(Path(line["output"])) == line["sha256"] for line in lines)
    assert api.get("/v1/products").json()["items"] == []
    blobs = [path for path in (settings.data_dir / "blobs").rglob("*") if path.is_file()]
    assert len(blobs) == 1, "the PSF"
    gone, changed = Path(lines[0]["output"]), Path(lines[1]["output"])
    gone.unlink()
    changed.write_bytes(b"something else")
    computed.clear()
    second = started(api, **request)
    work()
    again = results(api, second)
    assert [line["reused"] for line in again] == [False, False, True] and len(computed) == 2
    assert [line["sha256"] for line in again] == [line["sha256"] for line in lines]
    assert sha256(gone) == lines[0]["sha256"] and sha256(changed) == lines[1]["sha256"]


@pytest.mark.parametrize("job_ends", [True, False])
def test_a_run_waits_for_a_job_that_is_computing_the_image(
    api: TestClient,
    archive: Path,
    psf_id: str,
    settings: Settings,
    catalogue: Catalogue,
    work: Work,
    computed: list[object],
    monkeypatch: pytest.MonkeyPatch,
    job_ends: bool,
) -> None:
    """Its product is made once: by the job, or, where that has lost its worker, by the bulk."""
    image_id = upload(api, archive / "2020" / "image 0.fits")
    body = {"kind": "deconvolve", "parameters": {"image_id": image_id, "psf_id": psf_id, **FEW}}
    job = api.post("/v1/jobs", json=body).json()
    lease = catalogue.jobs.claim(job["id"], worker="another")
    assert lease is not None
    rests: list[bool] = []

    def rest() -> None:
        rests.append(True)
        if len(rests) < 3:
            return
        catalogue.jobs.requeue(lease)
        if job_ends:
            run_job(Runner(settings, catalogue, Store(settings.data_dir)), catalogue, job["id"])

    monkeypatch.setattr(bulk_image, "_rest", rest)
    bulk = started(api, images=[image_id], psf_id=psf_id)
    work()
    (line,) = results(api, bulk)
    assert len(rests) == 3 and len(computed) == 1 and line["reused"] == job_ends
    assert now(api, bulk)["images"]["done"] == 1
    if not job_ends:
        run_job(Runner(settings, catalogue, Store(settings.data_dir)), catalogue, job["id"])
        assert len(computed) == 1
    assert api.get(f"/v1/jobs/{job['id']}").json()["result"] == f"/v1/products/{line['product_id']}"


def test_a_cancelled_run_stops_at_the_next_reported_step(
    api: TestClient, files: list[dict[str, str]], psf_id: str, work: Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[int] = []
    long = {"method": {"name": "richardson-lucy", "steps": 200}}
    bulk = started(api, files=files, psf_id=psf_id, parameters=long)
    monkeypatch.setattr("workers.run.attempt.REPORT_EVERY_S", 0.0)
    monkeypatch.setattr("workers.bulk.task.TELL_EVERY_S", 0.0)
    real = run.deconvolve

    def counted(*given: Any, begin: Callable[..., Any], **more: Any) -> run.Product:
        inner = begin(run.DECONVOLVING, 0)

        def report(step: int, of: int) -> None:
            steps.append(step)
            if step == 3:
                assert api.post(f"/v1/bulk/{bulk['id']}/cancel").json()["phase"] == "CANCELLED"
            inner(step, of)

        return real(*given, begin=lambda stage, _: report if stage == run.DECONVOLVING else None, **more)

    monkeypatch.setattr(run, "deconvolve", counted)
    work()
    assert steps == [1, 2, 3]
    bulk = now(api, bulk)
    assert bulk["phase"] == "CANCELLED" and bulk["images"]["waiting"] == 3
    assert api.get("/v1/products").json()["items"] == []
    assert api.post(f"/v1/bulk/{bulk['id']}/retry").status_code == 409


def test_patterns_without_files_stop_the_run_with_the_reason(
    api: TestClient, archive: Path, psf_id: str, work: Work
) -> None:
    bulk = started(api, files=[{"glob": f"{archive}/**/*.nothing"}], psf_id=psf_id)
    work()
    assert now(api, bulk)["error"]["code"] == "no-images" and now(api, bulk)["phase"] == "ERROR"
    write_image(archive / "2020" / "late.nothing")
    assert api.post(f"/v1/bulk/{bulk['id']}/resume").json()["error"] is None
    work()
    assert now(api, bulk)["images"]["done"] == 1


def test_a_context_pins_the_psf_of_each_image(
    api: TestClient, files: list[dict[str, str]], work: Work, tmp_path: Path
) -> None:
    of_channel = []
    for channel in (174, 304):
        write_psf(tmp_path / f"{channel}.fits", size=channel // 4 // 2 * 2)
        of_line = f"/v1/psfs?instrument=eui&channel={channel}&kind=total"
        of_channel.append(upload(api, tmp_path / f"{channel}.fits", of_line))
    pins = [{"psf_id": one} for one in of_channel]
    context = api.post("/v1/contexts", json={"name": "both", "pins": pins}).json()
    bulk = started(api, files=files, context="both")
    assert bulk["context_id"] == context["id"] and bulk["psf_id"] is None
    work()
    expected = [of_channel[0]] * 2 + [of_channel[1]]
    assert [line["psf_id"] for line in results(api, bulk)] == expected


INVALID: list[tuple[dict[str, Any], int, str]] = [
    ({"psf_id": "{psf}"}, 422, "invalid-request"),
    ({"images": ["a" * 64], "psf_id": "{psf}"}, 404, "no-such-image"),
    ({"files": [{"glob": "{root}/*"}]}, 422, "invalid-request"),
    ({"files": [{"glob": "{root}/*"}], "psf_id": "a" * 64}, 404, "no-such-psf"),
    ({"files": [{"glob": "{root}/*"}], "context": "now"}, 404, "no-such-context"),
    ({"files": [{"glob": "{root}/*"}], "psf_id": "{psf}", "context": "x"}, 422, "invalid-request"),
    ({"files": [{"glob": "/etc/*"}], "psf_id": "{psf}"}, 422, "path-not-allowed"),
    ({"files": [{"glob": "{root}/../../etc/*"}], "psf_id": "{psf}"}, 422, "bad-path"),
    ({"files": [{"glob": "{root}/loop/*.fits"}], "psf_id": "{psf}"}, 422, "bad-path"),
    ({"files": [{"glob": "*.fits"}], "psf_id": "{psf}"}, 422, "bad-path"),
    ({"files": [{"glob": "{root}/*", "where": {"x": 1}}], "psf_id": "{psf}"}, 422, "invalid-request"),
    (
        {"files": [{"glob": "{root}/*"}], "psf_id": "{psf}", "output": {"folder": "{root}"}},
        422,
        "path-not-allowed",
    ),
    (
        {
            "files": [{"glob": "{root}/*"}],
            "psf_id": "{psf}",
            "output": {"folder": "{out}", "layout": "{telescope}.fits"},
        },
        422,
        "invalid-request",
    ),
    ({"images": ["a" * 64] * 100_001, "psf_id": "{psf}"}, 422, "invalid-request"),
]


def test_invalid_requests_are_refused(api: TestClient, archive: Path, out: Path, psf_id: str) -> None:
    (archive / "loop").symlink_to(archive / "loop")
    for request, status, code in INVALID:
        body = json.dumps(request).replace("{psf}", psf_id).replace("{root}", str(archive))
        body = body.replace("{out}", str(out))
        answer = api.post("/v1/bulk", content=body, headers={"Content-Type": "application/json"})
        assert (answer.status_code, answer.json()["type"]) == (status, f"urn:heliopsf:{code}"), body[:300]
    assert api.get("/v1/bulk").json()["items"] == []


def test_a_turn_lets_others_go_first_after_each_image(
    api: TestClient, files: list[dict[str, str]], psf_id: str, catalogue: Catalogue, settings: Settings
) -> None:
    bulk = started(api, files=files, psf_id=psf_id)
    again: list[tuple[str, Queue]] = []

    def submit(job_id: str, queue: Queue) -> bool:
        again.append((job_id, queue))
        return True

    runner = Runner(settings, catalogue, Store(settings.data_dir), submit=submit)
    keep_turns(catalogue, settings)
    (turn,) = catalogue.jobs.of_kind("bulk")
    assert turn.queue == Queue.BULK
    waiting, _ = catalogue.jobs.submit("psf-build", {"instrument": "hri_euv"}, "k", "somebody")
    turns = 0
    for done in (1, 2):
        while now(api, bulk)["images"]["done"] < done:
            run_job(runner, catalogue, turn.id)
            turns += 1
            row = catalogue.jobs.get(turn.id)
            assert row is not None and (row.phase, row.attempt, row.lease) == ("QUEUED", 0, None)
            assert again == [(turn.id, Queue.BULK)] * turns and row.submitted_at is not None
        assert now(api, bulk)["images"]["done"] == done
    assert turns <= 3  # the first turn may end as soon as it has listed files
    catalogue.jobs.cancel(waiting.id)
    run_job(runner, catalogue, turn.id)
    assert now(api, bulk)["images"]["done"] == 3 and len(again) == turns


def test_images_of_another_channel_fail_alone_unless_the_request_says_so(
    api: TestClient, work: Work, archive: Path, tmp_path: Path
) -> None:
    """One image at 174 angstrom and one at 304."""
    write_psf(tmp_path / "174.fits")
    fits.setval(tmp_path / "174.fits", "WAVELNTH", value=174)
    psf_id = upload(api, tmp_path / "174.fits", "/v1/psfs")
    request = {"files": [{"glob": f"{archive}/202[12]/*.fits"}], "psf_id": psf_id}
    strict = started(api, **request)
    work()
    assert [row["warnings"] for row in results(api, strict)] == [[]]
    assert [failure["error"]["code"] for failure in failures(api, strict)] == ["channel-mismatch"]
    told = started(api, **request, parameters={**FEW, "other_channel": True})
    work()
    assert [row["warnings"] for row in results(api, told, warning="channel")] == [["channel"]]
    assert results(api, told, warning="frame") == []
