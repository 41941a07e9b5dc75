"""The jobs of a bulk run: a key that may submit jobs cannot stop them one by one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from tests.service.conftest import upload
from tests.service.keyed import Keyed, keyed
from workers.bulk.turns import keep_turns
from workers.catalogue.access.keys import Scope
from workers.catalogue.tables import JobRow
from workers.contract.phases import Phase
from workers.settings import Settings


@pytest.fixture
def service(settings: Settings) -> Iterator[Keyed]:
    with keyed(settings) as service:
        yield service


@pytest.fixture
def bulk(service: Keyed, image_file: Path, psf_file: Path) -> str:
    """The id of a bulk run of the owner."""
    client = service.client("owner")
    image, psf = upload(client, image_file), upload(client, psf_file, "/v1/psfs")
    answer = client.post("/v1/bulk", json={"images": [image], "psf_id": psf})
    assert answer.status_code == 202, answer.text
    identity: str = answer.json()["id"]
    return identity


@pytest.fixture
def turn(service: Keyed, settings: Settings, bulk: str) -> JobRow:
    """A turn of the bulk run, which waits."""
    keep_turns(service.catalogue, settings)
    (turn,) = service.catalogue.jobs.of_kind("bulk")
    return turn


@pytest.fixture
def submitter(service: Keyed) -> TestClient:
    """The owner's key that may read and submit, but may not start bulk runs."""
    return service.client("owner", Scope.READ, Scope.SUBMIT)


def phase(service: Keyed, turn: JobRow) -> str:
    row = service.catalogue.jobs.get(turn.id)
    assert row is not None and not row.cancel_requested
    return row.phase


def test_a_key_that_may_submit_cannot_stop_the_turn_of_a_bulk_run(
    service: Keyed, submitter: TestClient, turn: JobRow, bulk: str
) -> None:
    answer = submitter.delete(f"/v1/jobs/{turn.id}")
    assert (answer.status_code, answer.json()["type"]) == (409, "urn:heliopsf:job-of-bulk")
    assert f"/v1/bulk/{bulk}" in answer.json()["detail"]
    here = f"/uws/jobs/{turn.id}"
    for address, form in (
        (here, {"ACTION": "DELETE"}),
        (f"{here}/phase", {"PHASE": "ABORT"}),
        (f"{here}/executionduration", {"EXECUTIONDURATION": "1"}),
        (f"{here}/destruction", {"DESTRUCTION": "2001-01-01T00:00:00"}),
    ):
        refused = submitter.post(address, data=form, follow_redirects=False)
        assert refused.status_code == 409 and bulk in refused.text, address
    assert submitter.delete(here, follow_redirects=False).status_code == 409
    assert phase(service, turn) == Phase.QUEUED


def test_the_bulk_run_itself_can_be_cancelled(service: Keyed, turn: JobRow, bulk: str) -> None:
    assert service.client("owner").post(f"/v1/bulk/{bulk}/cancel").status_code == 200
    row = service.catalogue.jobs.get(turn.id)
    assert row is None or row.phase == Phase.ABORTED
