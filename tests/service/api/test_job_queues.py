"""Where a job waits, as it is asked for over HTTP."""

from __future__ import annotations

from typing import Any

from fastapi.testclient import TestClient

from tests.service.conftest import refusal

BUILD = {"instrument": "hri_euv", "size": 64}


def asked(api: TestClient, **more: Any) -> dict[str, Any]:
    answer = api.post("/v1/jobs", json={"kind": "psf-build", "parameters": BUILD, **more})
    assert answer.status_code in (200, 202), answer.text
    return dict(answer.json())


def test_a_job_that_can_wait_goes_up_once_somebody_asks_for_it_at_once(api: TestClient) -> None:
    later = asked(api, queue="bulk")
    assert later["queue"] == "bulk"
    now = asked(api)
    assert (now["id"], now["queue"]) == (later["id"], "interactive")
    assert asked(api, queue="bulk")["queue"] == "interactive"
    assert api.get(f"/v1/jobs/{now['id']}").json()["queue"] == "interactive"
    for queue in ("interactive", "crossval", "soon", "", 1):
        body = {"kind": "psf-build", "parameters": BUILD, "queue": queue}
        refusal(api.post("/v1/jobs", json=body), 422, "invalid-request")  # nobody asks to be before others
