"""The heartbeat of a job goes on after the database did not answer once."""

from __future__ import annotations

import threading
from types import SimpleNamespace

from sqlalchemy.exc import OperationalError

from workers.catalogue.jobs import Lease
from workers.run.attempt import Attempt
from workers.run.child import Stopping


def test_a_heartbeat_that_failed_is_followed_by_another() -> None:
    beats: list[str] = []
    third = threading.Event()

    def heartbeat(lease: Lease) -> bool:
        beats.append(lease.job_id)
        if len(beats) == 1:
            raise OperationalError("UPDATE", {}, OSError("gone"))
        if len(beats) == 3:
            third.set()
        return True

    catalogue = SimpleNamespace(jobs=SimpleNamespace(heartbeat=heartbeat))
    attempt = Attempt(catalogue, Lease("job", "token"), 0.01, Stopping(), None, limit_s=60.0)  # type: ignore[arg-type]
    with attempt.beating():
        assert third.wait(10.0), beats
    assert not attempt.stopped.is_set()
