"""Where a job waits, as it is asked for over HTTP."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient

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


@pytest.mark.parametrize("queue", ["interactive", "crossval", "soon", "", 1])
def test_nobody_asks_to_be_before_others(api: TestClient, queue: object) -> None:
    answer = api.post("/v1/jobs", json={"kind": "psf-build", "parameters": BUILD, "queue": queue})
    assert answer.status_code == 422 and answer.json()["type"] == "urn:heliopsf:invalid-request"
