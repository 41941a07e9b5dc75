"""What an owner may keep: refused before it is sent or worked on, by figures that are those of the rows."""

from __future__ import annotations

import json
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner
from fastapi.testclient import TestClient

from service.cli.main import main
from service.local import LocalService
from tests.conftest import write_image
from tests.service.conftest import upload
from tests.service.keyed import keyed
from workers.bulk.turns import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.owners import ROW_BYTES, counted_bytes
from workers.catalogue.tables import ImageRow, JobRow, ProductRow, PsfRow
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    more = {"quota_mib": 1, "max_upload_mib": 4, "bulk_roots": str(tmp_path / "archive")}
    return settings.model_copy(update=more)


def large(path: Path, kib: int) -> Path:
    """A file that can be uploaded as an image and as a PSF: all light is in its central pixel."""
    pixels = np.zeros((kib, 256), "f4")
    pixels[kib // 2, 128] = 1.0
    fits.PrimaryHDU(pixels).writeto(path)
    return path


def counted(api: TestClient) -> int:
    """What the owner of an open service has in its quota."""
    catalogue: Catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
    return catalogue.owners.usage("local", 1).used_bytes


def test_an_upload_over_the_quota_is_refused_with_figures(api: TestClient, tmp_path: Path) -> None:
    upload(api, large(tmp_path / "a.fits", 600))
    used = counted(api)
    assert 0 < used - (tmp_path / "a.fits").stat().st_size < 2000, "the file and its row"
    for where in ("/v1/images", "/v1/psfs"):
        content = large(tmp_path / f"{where[-4:]}.fits", 500).read_bytes()
        for body in (
            content,
            iter([content[:1000], content[1000:]]),
        ):  # with a length said before, and without
            answer = api.post(where, content=body, headers={"Content-Type": "application/fits"})
            problem = answer.json()
            assert (answer.status_code, problem["type"]) == (413, "urn:heliopsf:quota-exceeded")
            assert (problem["used_bytes"], problem["limit_bytes"]) == (used, 2**20)
            assert "0.6 of 1.0 MiB are used" in problem["detail"]
    assert list((tmp_path / "data" / "tmp").iterdir()) == []
    assert len(api.get("/v1/images").json()["items"]) == 1
    upload(api, large(tmp_path / "small.fits", 300))


def test_work_is_refused_where_nothing_could_be_kept(
    api: TestClient, tmp_path: Path, settings: Settings, psf_file: Path
) -> None:
    image_id, psf_id = upload(api, large(tmp_path / "a.fits", 600)), upload(api, psf_file, "/v1/psfs")
    catalogue: Catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
    row = catalogue.get(ImageRow, image_id, "local")
    assert row is not None
    catalogue.add(ImageRow(owner="local", id="b" * 64, created_at=1.0, bytes=2**20, summary=row.summary))
    requests: list[tuple[str, dict[str, Any]]] = [
        ("/v1/jobs", {"kind": "deconvolve", "parameters": {"image_id": image_id, "psf_id": psf_id}}),
        ("/v1/bulk", {"images": [image_id], "psf_id": psf_id}),
    ]
    for where, body in requests:
        answer = api.post(where, json=body)
        assert (answer.status_code, answer.json()["limit_bytes"]) == (507, 2**20), answer.text
    form = {"KIND": "psf-build", "instrument": "hri_euv", "PHASE": "RUN"}
    assert api.post("/uws/jobs", data=form).status_code == 507
    assert catalogue.jobs.of_kind("deconvolve") == [] and api.get("/v1/bulk").json()["items"] == []


def test_rows_without_files_are_refused_where_they_do_not_fit(
    api: TestClient, image_file: Path, psf_file: Path
) -> None:
    """Some bytes are left, so that the quota is not full; but no row fits."""
    image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    body = {
        "status": "certified",
        "reason": "r",
        "version": "1.0.0",
        "instrument": "i",
        "channel": "1",
        "kind": "total",
    }
    assert api.post(f"/v1/psfs/{psf_id}/status", json=body).status_code == 200
    form = {"KIND": "psf-build"}
    drafts = [
        api.post("/uws/jobs", data=form, follow_redirects=False).headers["Location"][-32:] for _ in range(2)
    ]
    catalogue: Catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
    last = ImageRow(owner="local", id="b" * 64, created_at=1.0, bytes=0, summary={})
    last.bytes = 2**20 - counted(api) - 10 - counted_bytes(last)
    catalogue.add(last)
    asked: list[tuple[str, str, dict[str, Any]]] = [
        ("POST", "/v1/jobs", {"kind": "deconvolve", "parameters": {"image_id": image_id, "psf_id": psf_id}}),
        ("POST", "/v1/bulk", {"images": [image_id], "psf_id": psf_id}),
        ("POST", "/v1/contexts", {"name": "c"}),
        ("PUT", "/v1/contexts/default", {"context": None}),
        ("POST", f"/v1/psfs/{psf_id}/status", {"status": "certified", "reason": "again"}),
    ]
    for method, where, body in asked:
        answer = api.request(method, where, json=body)
        problem = answer.json()
        assert (answer.status_code, problem["type"]) == (507, "urn:heliopsf:quota-exceeded"), (
            where,
            answer.text,
        )
        assert (problem["used_bytes"], problem["limit_bytes"]) == (2**20 - 10, 2**20)
        assert "what this request adds to the database could not be kept" in problem["detail"]
    for where in ("/uws/jobs", f"/uws/jobs/{drafts[0]}/parameters"):
        answer = api.post(where, data={"KIND": "psf-build", "instrument": "hri_euv"})
        assert answer.status_code == 507 and "expected free room in your quota" in answer.text
    assert counted(api) == 2**20 - 10 and catalogue.owners.recount() == []
    for draft in drafts:
        assert api.delete(f"/uws/jobs/{draft}", follow_redirects=False).status_code == 303
    assert api.post(asked[0][1], json=asked[0][2]).status_code == 202, "deleted jobs make room"


def test_a_listing_that_fills_the_quota_stops_and_goes_on_with_room(
    api: TestClient, tmp_path: Path, settings: Settings, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workers.bulk.listing.LIST_AT_ONCE", 4)
    (tmp_path / "archive").mkdir()
    for number in range(12):
        (tmp_path / "archive" / f"{number}.fits").touch()
    request = {"files": [{"glob": f"{tmp_path}/archive/*"}], "psf_id": upload(api, psf_file, "/v1/psfs")}
    here = f"/v1/bulk/{api.post('/v1/bulk', json=request).json()['id']}"
    catalogue: Catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
    keep_turns(catalogue, settings)
    last = ImageRow(owner="local", id="b" * 64, created_at=1.0, bytes=0, summary={})
    last.bytes = 2**20 - counted(api) - 6 * ROW_BYTES - counted_bytes(last)
    catalogue.add(last)
    runner = Runner(settings, catalogue, Store(settings.data_dir))

    def work() -> dict[str, Any]:
        keep_turns(catalogue, settings)
        for turn in catalogue.jobs.of_kind("bulk"):
            runner.run(turn.id)
        return dict(api.get(here).json())

    stopped = work()
    assert (stopped["phase"], stopped["error"]["code"]) == ("ERROR", "quota-exceeded")
    assert "not all files that the patterns match could be listed" in stopped["error"]["message"]
    assert stopped["images"]["total"] == 4 and counted(api) <= 2**20
    catalogue.owners.set_quota("local", 2)
    assert api.post(f"{here}/resume").status_code == 200
    assert work()["images"]["total"] == 12
    keep_turns(catalogue, settings)
    assert catalogue.owners.recount() == []


def test_uploads_at_one_moment_that_each_fit_do_not_all_come_in(
    api: TestClient, tmp_path: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = threading.Barrier(5, timeout=60.0)
    keep = Store.keep

    def keep_together(store: Store, *given: Any) -> str:
        together.wait()  # by now each was told that it fits
        return keep(store, *given)

    monkeypatch.setattr(Store, "keep", keep_together)
    files = [large(tmp_path / f"{n}.fits", 300 + n).read_bytes() for n in range(5)]
    places = ["/v1/images", "/v1/psfs", "/v1/images", "/v1/psfs", "/v1/images"]
    headers = {"Content-Type": "application/fits"}
    with ThreadPoolExecutor(5) as pool:
        answers = list(
            pool.map(
                lambda at: api.post(at[0], content=at[1], headers=headers), zip(places, files, strict=True)
            )
        )
    assert sorted(answer.status_code for answer in answers) == [201, 201, 201, 413, 413]
    for answer in answers:
        if answer.status_code == 413:
            problem = answer.json()
            assert problem["type"] == "urn:heliopsf:quota-exceeded" and problem["limit_bytes"] == 2**20
            assert "0.9 of 1.0 MiB are used, and this file needs at least" in problem["detail"]
    rows = [row for where in ("/v1/images", "/v1/psfs") for row in api.get(where).json()["items"]]
    catalogue: Catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
    assert len(rows) == 3 and sum(row["bytes"] for row in rows) < counted(api) <= 2**20
    assert catalogue.owners.recount() == []
    assert list((tmp_path / "data" / "tmp").iterdir()) == []


def test_the_same_upload_at_one_moment_counts_once(
    api: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = threading.Barrier(2, timeout=60.0)
    keep = Store.keep
    monkeypatch.setattr(Store, "keep", lambda *given: (together.wait(), keep(*given))[1])
    content = large(tmp_path / "a.fits", 900).read_bytes()
    headers = {"Content-Type": "application/fits"}
    with ThreadPoolExecutor(2) as pool:
        sent = [pool.submit(api.post, "/v1/images", content=content, headers=headers) for _ in range(2)]
    assert sorted(answer.result().status_code for answer in sent) == [200, 201]


def test_jobs_that_were_queued_while_there_was_room_end_where_there_is_none(
    api: TestClient, settings: Settings, image_file: Path, psf_file: Path
) -> None:
    image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    catalogue: Catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]

    def parameters(steps: int) -> dict[str, Any]:
        method = {"name": "richardson-lucy", "steps": steps}
        return {"image_id": image_id, "psf_id": psf_id, "method": method}

    def asked(kind: str, parameters: dict[str, Any]) -> str:
        answer = api.post("/v1/jobs", json={"kind": kind, "parameters": parameters})
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    first, second, third = (asked("deconvolve", parameters(steps)) for steps in (1, 2, 3))
    form = {
        "KIND": "deconvolve",
        "PHASE": "RUN",
        **parameters(1),
        "method": json.dumps(parameters(1)["method"]),
    }
    equal = api.post("/uws/jobs", data=form, follow_redirects=False).headers["Location"][-32:]
    tables = asked("psf-tables", {"psf_id": psf_id})
    row = catalogue.get(ImageRow, image_id, "local")
    assert row is not None
    last = ImageRow(owner="local", id="b" * 64, created_at=1.0, bytes=0, summary=row.summary)
    last.bytes = 2**20 - counted(api) - 1 - counted_bytes(last)
    catalogue.add(last)
    runner = Runner(settings, catalogue, Store(settings.data_dir))
    jobs = {}
    for job_id in (first, second, third, equal, tables):
        runner.run(job_id)
        jobs[job_id] = api.get(f"/v1/jobs/{job_id}").json()
    for job_id in (second, third):
        job = jobs[job_id]
        assert (job["phase"], job["error"]["code"], job["error"]["fault"]) == (
            "ERROR",
            "quota-exceeded",
            "user",
        )
        assert "of 1.0 MiB are used, and the result of this job could not be kept" in job["error"]["message"]
    assert len(api.get("/v1/products").json()["items"]) == 1, "what was at work when the room ended"
    assert jobs[first]["phase"] == "COMPLETED"
    assert jobs[equal]["phase"] == "COMPLETED" and jobs[equal]["result"] == jobs[first]["result"], (
        "nothing more"
    )
    assert jobs[tables]["phase"] == "COMPLETED", "tables are not counted"


def test_a_bulk_that_fills_the_quota_stops_and_goes_on_with_room(
    api: TestClient, tmp_path: Path, settings: Settings, psf_file: Path
) -> None:
    (tmp_path / "archive").mkdir()
    for number in range(8):
        write_image(tmp_path / "archive" / f"{number}.fits", shape=(288, 288), seed=number)
    request = {
        "files": [{"glob": f"{tmp_path}/archive/*"}],
        "psf_id": upload(api, psf_file, "/v1/psfs"),
        "parameters": {"method": {"name": "richardson-lucy", "steps": 1}},
    }
    here = f"/v1/bulk/{api.post('/v1/bulk', json=request).json()['id']}"
    catalogue = Catalogue(settings.catalogue_url)
    runner = Runner(settings, catalogue, Store(settings.data_dir))

    def work() -> dict[str, Any]:
        while catalogue.bulks.at_work():
            keep_turns(catalogue, settings)
            for turn in catalogue.jobs.of_kind("bulk"):
                runner.run(turn.id)
        return dict(api.get(here).json())

    stopped = work()
    assert stopped["phase"] == "ERROR" and stopped["error"]["code"] == "quota-exceeded"
    # The quota is checked before an image is computed; the last product may still be written then.
    assert 0 < stopped["images"]["done"] < 8 and stopped["images"]["failed"] == 0
    catalogue.owners.set_quota("local", 100)
    assert api.post(f"{here}/resume").status_code == 200
    assert work()["images"]["done"] == 8
    catalogue.close()


def test_quotas_are_each_owner_s_own(settings: Settings, tmp_path: Path) -> None:
    with keyed(settings) as service:
        mine, other = service.client("mine"), service.client("other")
        content = large(tmp_path / "a.fits", 900).read_bytes()
        headers = {"Content-Type": "application/fits"}
        assert mine.post("/v1/images", content=content, headers=headers).status_code == 201
        assert mine.post("/v1/psfs", content=content, headers=headers).status_code == 413
        assert other.post("/v1/images", content=content, headers=headers).status_code == 201
        service.catalogue.owners.set_quota("mine", 0)
        assert mine.post("/v1/psfs", content=content, headers=headers).status_code == 201
        service.catalogue.owners.set_quota("mine", None)
        assert mine.post("/v1/psfs", content=content, headers=headers).status_code == 413


def test_what_is_counted_is_what_the_rows_say(
    settings: Settings, tmp_path: Path, image_file: Path, psf_file: Path
) -> None:
    local = LocalService(settings)
    for _ in range(2):  # asked for twice, counted once
        local.deconvolve(image_file, psf_id=local.upload_psf(psf_file)["id"], steps=1)
    local.close()
    catalogue = Catalogue(settings.catalogue_url)
    rows = [
        row
        for table in (ImageRow, PsfRow, ProductRow, JobRow)
        for row in catalogue.page(table, owner="local", limit=9)
    ]
    used = catalogue.owners.usage("local", 1).used_bytes
    assert len(rows) == 4 and used == sum(counted_bytes(row) for row in rows)
    assert catalogue.owners.recount() == []
    with catalogue._engine.begin() as connection:
        connection.exec_driver_sql("UPDATE owners SET bytes = 7")
    assert catalogue.owners.recount() == ["local"]
    assert catalogue.owners.usage("local", 1).used_bytes == used
    with catalogue._engine.begin() as connection:
        connection.exec_driver_sql("DELETE FROM owners")
    assert catalogue.owners.recount() == ["local"]
    assert catalogue.owners.usage("local", 1).used_bytes == used
    catalogue.close()


def test_the_command_line_tells_and_sets_quotas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HELIOPSF_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("HELIOPSF_QUOTA_MIB", "5")

    def said(*arguments: str, status: int = 0) -> str:
        answer = CliRunner().invoke(main, list(arguments))
        assert answer.exit_code == status, answer.output
        return re.sub(" +", " ", answer.output.strip())

    said("database", "upgrade")
    assert said("store", "quota", "me", "7") == "me 0.0 MiB of 7 MiB"
    assert said("store", "quota", "me", "0") == "me 0.0 MiB no limit"
    assert said("store", "quota", "me", "--default") == "me 0.0 MiB of 5 MiB" == said("store", "usage")
    said("store", "quota", "me", status=2), said("store", "quota", "No Body", "1", status=2)
