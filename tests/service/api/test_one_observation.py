"""The contents of `tests.heliopsf.test_one_observation` as uploads: a service sees the same observation."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.io import fits
from fastapi.testclient import TestClient

from tests.heliopsf.test_one_observation import CONTENTS, all_warnings, observed, write, write_psf
from tests.service.conftest import upload

BITS = 1 | 2 | 128  # not finite, saturated, lost


def test_an_upload_gives_the_same_observation(
    api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    psf_id = upload(api, write_psf(tmp_path / "psf.fits"), "/v1/psfs")
    paths = {
        name: write(tmp_path / f"{number}.fits", content)
        for number, (name, content) in enumerate(CONTENTS.items())
    }
    jobs = {}
    for name, path in paths.items():
        method = {"name": "richardson-lucy", "steps": 1}
        parameters = {
            "image_id": upload(api, path),
            "psf_id": psf_id,
            "method": method,
            "other_channel": True,
        }
        asked = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})
        assert asked.status_code == 202, asked.text
        jobs[name] = asked.headers["Location"]
    run_jobs()
    for name, job in jobs.items():
        product = api.get(api.get(job).json()["result"]).json()
        wanted = observed(paths[name])
        with fits.open(io.BytesIO(api.get(product["file"]).content)) as hdus:
            np.testing.assert_array_equal(hdus["QUALITY"].data & BITS, wanted.mask, err_msg=name)
        told = {one["code"]: one["message"] for one in product["details"]["warnings"]}
        assert all_warnings(wanted).items() <= told.items(), name
