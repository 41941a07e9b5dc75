"""Queues: who waits where, in which order messages are taken, and what goes up when somebody wants it at once."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import signal
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from queue import Empty
from typing import Any

import pytest
import redis
from click.testing import CliRunner
from kombu import pools
from pydantic import ValidationError
from sqlalchemy import update

from service.cli.main import main
from tests.whole.stack import Missing, Redis, wait_for
from tests.workers.databases import change
from tests.workers.jobs import claimed, job_row
from tests.workers.run.processes import started_worker, worker_of
from workers.broker import app as queue
from workers.broker.order import FolderTransport, MostUrgentFirst
from workers.broker.reconciler import AT_ONCE, reconcile
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.jobs import Phase, Queue, broker_name, by_urgency, queues_named
from workers.contract.kinds import KINDS
from workers.settings import Settings


def test_the_most_urgent_come_first_whatever_order_they_are_named_in() -> None:
    assert queues_named(" bulk,interactive ") == (Queue.INTERACTIVE, Queue.BULK)
    names = [broker_name(one) for one in (Queue.BULK, Queue.INTERACTIVE, Queue.CROSSVAL)]
    ours = [broker_name(one) for one in Queue]
    assert by_urgency([*names, "celery@host.pidbox"]) == ["celery@host.pidbox", *ours]
    assert MostUrgentFirst(list(names)).consume(3) == ours


def test_queues_that_are_none_are_refused() -> None:
    for names in ("", ",", "interactive,soon", "Bulk"):
        with pytest.raises(ValueError, match="expected queues of interactive, crossval, bulk"):
            queues_named(names)
        with pytest.raises(ValidationError):
            Settings(worker_queues=names)
    answer = CliRunner().invoke(main, ["worker", "--queues", "Bulk"])
    assert answer.exit_code == 2 and "expected queues of" in answer.output


def test_a_job_waits_where_its_kind_does_or_where_it_was_told_to(catalogue: Catalogue) -> None:
    slow = {"cross-validate": Queue.CROSSVAL, "bulk": Queue.BULK}
    for kind in KINDS:
        row, _ = catalogue.jobs.submit(kind, {}, kind, "o")
        assert row.queue == slow.get(kind, Queue.INTERACTIVE)
    assert catalogue.jobs.submit("deconvolve", {}, "later", "o", queue=Queue.BULK)[0].queue == Queue.BULK
    assert catalogue.uws.draft("cross-validate", {}, owner="o").queue == Queue.CROSSVAL


def test_what_is_most_urgent_is_submitted_first_then_what_is_oldest(catalogue: Catalogue) -> None:
    made = [
        catalogue.jobs.submit("psf-build", {}, str(number), "o", queue=one)[0].id
        for number, one in enumerate((Queue.BULK, Queue.INTERACTIVE, Queue.CROSSVAL, Queue.INTERACTIVE))
    ]
    expected = [made[1], made[3], made[2], made[0]]
    waiting = catalogue.jobs.unsubmitted(0.0)
    assert [job_id for job_id, _ in waiting] == expected and waiting[-1][1] == Queue.BULK
    assert catalogue.jobs.unsubmitted(0.0, limit=3) == waiting[:3]
    catalogue.jobs.mark_submitted(*made)
    assert catalogue.jobs.unsubmitted(60.0) == []


def test_an_equal_job_that_somebody_wants_at_once_goes_up_and_never_down(catalogue: Catalogue) -> None:
    row, _ = catalogue.jobs.submit("deconvolve", {}, "k", "o", queue=Queue.BULK)
    catalogue.jobs.mark_submitted(row.id)
    assert catalogue.jobs.unsubmitted(60.0) == []
    again, new = catalogue.jobs.submit("deconvolve", {}, "k", "o")
    assert (again.id, new, again.queue) == (row.id, False, Queue.INTERACTIVE)
    assert catalogue.jobs.unsubmitted(60.0) == [(row.id, Queue.INTERACTIVE)], "submitted again"
    assert catalogue.jobs.submit("deconvolve", {}, "k", "o", queue=Queue.BULK)[0].queue == Queue.INTERACTIVE
    claimed(catalogue, row.id)
    catalogue.jobs.submit("deconvolve", {}, "k", "o")
    found = job_row(catalogue, row.id)
    assert found.phase == "EXECUTING"


def test_the_wait_of_a_job_doubles_with_each_submission_up_to_a_limit(catalogue: Catalogue) -> None:
    catalogue.jobs.submit("psf-build", {}, "k", "o")
    for submissions, wait_s in ((1, 1e3), (2, 2e3), (8, 1.28e5), (9, 2.56e5), (40, 2.56e5)):
        for ago_s, due in ((wait_s * 0.9, False), (wait_s * 1.1, True)):
            values = {"submissions": submissions, "submitted_at": time.time() - ago_s}
            change(catalogue, update(JobRow).values(**values))
            assert bool(catalogue.jobs.unsubmitted(1e3)) is due, values
            assert bool(catalogue.jobs.unsubmitted(1e3, idle=True)) is (ago_s > 1e3), values


def test_a_lost_message_is_repeated_soon_if_workers_are_idle(catalogue: Catalogue, tmp_path: Path) -> None:
    """It was submitted nine times while the queue was long. Then the broker lost the last message."""
    settings = Settings(data_dir=tmp_path / "data", broker_url="filesystem://", resubmit_s=10.0)
    app = queue.make_app(settings)
    lost, _ = catalogue.jobs.submit("psf-build", {}, "lost", "o")
    other, _ = catalogue.jobs.submit("psf-build", {}, "other", "o")

    def submitted(worked_ago_s: float, phase: str = "COMPLETED") -> int:
        """How many jobs are submitted if a worker last worked on the other job so long ago."""
        now = time.time()
        waits = {"submissions": 9, "submitted_at": now - 15.0}
        works = {"phase": phase, "heartbeat_at": now - worked_ago_s}
        jobs = update(JobRow)
        change(
            catalogue,
            jobs.where(JobRow.id == lost.id).values(**waits),
            jobs.where(JobRow.id == other.id).values(**works),
        )
        return reconcile(catalogue, app, settings)

    assert submitted(12.0) == 0, "there is no worker"
    catalogue.census.announce("w", time.time(), "1")
    assert submitted(1.0, "EXECUTING") == submitted(8.0) == 0, "a worker may take the message soon"
    assert submitted(12.0) == 1


def test_the_folder_s_messages_come_in_our_order(catalogue: Catalogue, settings: Settings) -> None:
    app = queue.make_app(settings)
    for number in range(AT_ONCE + 10):
        catalogue.jobs.submit("psf-build", {}, str(number), "o", queue=Queue.BULK)
    assert reconcile(catalogue, app, settings) == AT_ONCE
    mine, _ = catalogue.jobs.submit("deconvolve", {}, "mine", "o")
    folds, _ = catalogue.jobs.submit("cross-validate", {}, "folds", "o")
    assert reconcile(catalogue, app, settings) == 12, "what is left of the many, after the two"
    taken: list[str] = []
    with app.connection_for_read() as connection:
        channel = connection.default_channel
        for one in (Queue.BULK, Queue.CROSSVAL, Queue.INTERACTIVE):
            channel.basic_consume(
                broker_name(one), True, lambda message: taken.append(message.payload[0][0]), str(one)
            )
        for _ in range(3):
            channel.drain_events(timeout=1)
        assert taken[:2] == [mine.id, folds.id]
        for _ in range(AT_ONCE + 9):
            channel.drain_events(timeout=1)
        with pytest.raises(Empty):
            channel.drain_events(timeout=1)
    assert len(set(taken)) == AT_ONCE + 12


def test_the_folder_has_no_host_of_which_the_log_could_warn(
    settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    with queue.make_app(settings).connection_for_read() as connection:
        connection.clone().ensure_connection(max_retries=1)
    assert caplog.messages == []


def test_what_was_cut_in_the_folder_when_the_power_went_stops_nobody(settings: Settings) -> None:
    broker = settings.data_dir / "broker"

    def take() -> list[str]:
        taken: list[str] = []
        with queue.make_app(settings).connection_for_read() as connection:
            channel = connection.default_channel
            name = broker_name(Queue.BULK)
            channel.basic_consume(name, True, lambda message: taken.append(message.payload[0][0]), "tag")
            channel.drain_events(timeout=1)
        return taken

    first, second = uuid.uuid4().hex, uuid.uuid4().hex
    assert queue.submit(queue.make_app(settings), first, Queue.BULK)
    assert take() == [first]
    for content in ("", "[[", "null"):
        (broker / "control" / f"{broker_name(Queue.INTERACTIVE)}.exchange").write_text(content)
        # As in a process that has just started.
        FolderTransport.global_state.clear()
        pools.reset()
        # A message that is being written is not taken.
        (broker / "queue" / f"1_x.{broker_name(Queue.BULK)}.msg.ab.part").write_text("")
        assert queue.submit(queue.make_app(settings), second, Queue.BULK)
        assert take() == [second]


def test_a_named_pipe_in_the_folder_holds_no_worker(settings: Settings) -> None:
    app, name = queue.make_app(settings), broker_name(Queue.BULK)
    broker, job = settings.data_dir / "broker", uuid.uuid4().hex
    for path in (
        broker / "queue" / f"0_x.{name}.msg",
        broker / "control" / f"{name}.exchange",
        broker / "control" / "lock",
    ):
        os.mkfifo(path)
    (broker / "queue" / f"1_x.{name}.msg").symlink_to(__file__)
    FolderTransport.global_state.clear()
    pools.reset()
    taken: list[str] = []

    def work() -> None:
        assert queue.submit(app, job, Queue.BULK)
        with app.connection_for_read() as connection:
            channel = connection.default_channel
            channel.basic_consume(name, True, lambda message: taken.append(message.payload[0][0]), "tag")
            channel.drain_events(timeout=1)

    working = threading.Thread(target=work, daemon=True)
    working.start()
    working.join(10.0)
    assert taken == [job]


def test_a_process_that_binds_a_queue_waits_for_another_that_does(settings: Settings) -> None:
    """Two that write the table of bindings at once would lose the binding of one."""
    assert queue.submit(queue.make_app(settings), "first", Queue.BULK)
    lock = settings.data_dir / "broker" / "control" / "lock"
    FolderTransport.global_state.clear()
    pools.reset()
    submitting = threading.Thread(target=lambda: queue.submit(queue.make_app(settings), "second", Queue.BULK))
    with lock.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_SH)
        submitting.start()
        submitting.join(0.3)
        assert submitting.is_alive()
    submitting.join(10.0)
    assert not submitting.is_alive()


# Others write into the broker -----------------------------------------------------------------------

WORKER = worker_of('task = lambda context, _: "result"')


@dataclass
class Broker:
    """A broker that others can write into. put: puts bytes into the queue of interactive jobs; left: what is in it."""

    settings: Settings
    put: Callable[[bytes], object]
    left: Callable[[], list[Any]]


@pytest.fixture(params=["folder", "redis"])
def broker(request: pytest.FixtureRequest, settings: Settings, tmp_path: Path) -> Iterator[Broker]:
    name = broker_name(Queue.INTERACTIVE)
    settings.data_dir.mkdir()
    if request.param == "folder":
        queue.make_app(settings)
        folder = settings.data_dir / "broker" / "queue"

        def put(text: bytes) -> None:
            (tmp_path / "message").write_bytes(text)
            (tmp_path / "message").rename(folder / f"1_{uuid.uuid4()}.{name}.msg")

        yield Broker(settings, put, lambda: list(folder.iterdir()))
        return
    try:
        server = Redis(tmp_path)
    except Missing as missing:
        pytest.skip(str(missing))
    with server, redis.Redis.from_url(server.url) as client:
        yield Broker(
            settings.model_copy(update={"broker_url": server.url}),
            lambda text: client.lpush(name, text),
            lambda: [key for key in client.scan_iter() if client.type(key) in (b"list", b"hash", b"zset")],
        )


def own_message(settings: Settings) -> dict[str, Any]:
    """A message as the service sends it, for a job that does not exist."""
    apart = settings.model_copy(
        update={"data_dir": settings.data_dir / "apart", "broker_url": "filesystem://"}
    )
    assert queue.submit(queue.make_app(apart), uuid.uuid4().hex)
    (file,) = (apart.data_dir / "broker" / "queue").iterdir()
    message: dict[str, Any] = json.loads(file.read_text())
    return message


def hostile_messages(own: dict[str, Any]) -> Iterator[bytes]:
    """No JSON, other JSON, and a message of the service with another value for each of its parts, and in its body."""
    yield from (b"", b"\xff", b"[" * 100_000, b"9" * 10_000)
    values: tuple[Any, ...] = (None, -1.5, "\ud800", [[]], {"__type__": "datetime"})
    bodies = (base64.b64encode(json.dumps(value).encode()).decode() for value in values)
    yield from (
        json.dumps(message).encode() for message in (*values, *(own | {"body": body} for body in bodies))
    )
    for names in ((), ("headers",), ("properties",), ("properties", "delivery_info")):
        for key in reduce(getitem, names, own):
            for value in values:
                message = deepcopy(own)
                reduce(getitem, names, message)[key] = value
                yield json.dumps(message).encode()


def test_what_others_write_into_the_broker_stops_no_worker(broker: Broker, tmp_path: Path) -> None:
    """Hostile messages, and commands of Celery's remote control."""
    catalogue = Catalogue(broker.settings.catalogue_url)
    catalogue.upgrade()
    app, log = queue.make_app(broker.settings), tmp_path / "worker.log"

    def submitted() -> str:
        job, _ = catalogue.jobs.submit("psf-build", {}, uuid.uuid4().hex, DEFAULT_OWNER)
        assert queue.submit(app, job.id)
        catalogue.jobs.mark_submitted(job.id)
        return job.id

    def done() -> bool:
        assert worker.poll() is None, log.read_text()[-3000:]
        return not broker.left() and all(job_row(catalogue, job).phase == Phase.COMPLETED for job in jobs)

    jobs = [submitted()]
    with started_worker(WORKER, broker.settings, log) as worker:
        wait_for(done, "the worker is there")
        app.control.rate_limit(queue.RUN_JOB, "1/h")
        app.control.cancel_consumer(broker_name(Queue.INTERACTIVE))
        app.control.shutdown()
        for number, text in enumerate(hostile_messages(own_message(broker.settings))):
            broker.put(text)
            if number % 20 == 0:
                jobs.append(submitted())
        wait_for(done, "the jobs are done, and nothing is put back")
        worker.send_signal(signal.SIGTERM)
        assert worker.wait(60.0) == 0
    catalogue.close()
    assert log.read_text().count("that this service did not send") > 40
