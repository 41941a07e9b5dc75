"""Two equal jobs of UWS clients, run at the same moment with two workers: computed once, completed twice."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.conftest import write_image
from tests.whole.stack import running, wait_for

STEPS = 100


@pytest.mark.slow
def test_two_at_the_same_moment_are_computed_once(tmp_path: Path, psf_file: Path) -> None:
    write_image(tmp_path / "image.fits", shape=(1024, 1024))
    served = running("redis and postgresql", tmp_path, workers=2)
    with served as stack, httpx.Client(base_url=stack.client.server, timeout=60) as uws:
        client = stack.client
        fields = {
            "KIND": "deconvolve",
            "image_id": client.upload_image(tmp_path / "image.fits")["id"],
            "psf_id": client.upload_psf(psf_file)["id"],
            "method": f'{{"name": "richardson-lucy", "steps": {STEPS}}}',
        }

        def workers() -> bool:
            return "heliopsf_workers 2.0" in uws.get("/metrics").text

        wait_for(workers, "two workers are there")
        jobs = [uws.post("/uws/jobs", data=fields).headers["Location"] for _ in range(2)]
        for job in jobs:
            uws.post(f"{job}/phase", data={"PHASE": "RUN"})
        seen: set[tuple[str, ...]] = set()

        def ended() -> bool:
            seen.add(tuple(uws.get(f"{job}/phase").text for job in jobs))
            return ("COMPLETED", "COMPLETED") in seen

        wait_for(ended, "both are done", 120)
        assert ("EXECUTING", "QUEUED") in seen or ("QUEUED", "EXECUTING") in seen
        results = {client.job(job.rsplit("/", 1)[1])["result"] for job in jobs}
        assert len(results) == 1

        def steps() -> list[float]:
            families = text_string_to_metric_families(uws.get("/metrics").text)
            return [
                one.value
                for family in families
                for one in family.samples
                if one.name == "heliopsf_job_stage_steps_total"
                and one.labels == {"kind": "deconvolve", "stage": "deconvolving"}
            ]

        wait_for(lambda: bool(steps()), "the steps are counted")
        assert steps() == [STEPS], "one of the two did them"
