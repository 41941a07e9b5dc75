"""An image of a bulk, with a store whose copies of the files here may be removed at any time."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from tests.s3 import s3_bucket, shared_server
from tests.service.conftest import upload
from tests.workers.jobs import claimed
from workers.bulk import image as bulk_image
from workers.bulk.turns import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.files.opened import open_store
from workers.run.runner import Runner
from workers.settings import Settings


def test_a_local_copy_removed_during_a_wait_is_downloaded_again(
    tmp_path: Path, image_file: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with s3_bucket(monkeypatch, shared_server()) as (url, _):
        data = {"data_dir": tmp_path / "data", "store_url": url}
        settings = Settings.model_validate(
            data | {"broker_url": "filesystem://", "allowed_hosts": "testserver"}
        )
        with TestClient(create_app(settings)) as api:
            image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
            few = {"method": {"name": "richardson-lucy", "steps": 1}}
            body = {"kind": "deconvolve", "parameters": {"image_id": image_id, "psf_id": psf_id, **few}}
            job = api.post("/v1/jobs", json=body).json()
            request = {"images": [image_id], "psf_id": psf_id, "parameters": few}
            bulk = api.post("/v1/bulk", json=request).json()
        catalogue = Catalogue(settings.catalogue_url)
        lease = claimed(catalogue, job["id"], "another")
        (copy,) = (path for path in tmp_path.rglob(image_id) if path.is_file())

        def rest(_seconds: float) -> None:
            copy.unlink()
            assert catalogue.jobs.requeue(lease)

        clock = SimpleNamespace(time=time.time, monotonic=time.monotonic, sleep=rest)
        monkeypatch.setattr(bulk_image, "time", clock)
        keep_turns(catalogue, settings)
        (turn,) = catalogue.jobs.of_kind("bulk")
        Runner(settings, catalogue, open_store(settings)).run(turn.id)
        row = catalogue.bulks.get(bulk["id"])
        assert row is not None and (row.done, row.failed) == (1, 0)
        assert copy.is_file()
        catalogue.close()
