"""Makes a worker take messages from the queue of highest priority, only when one of its processes is idle, and only
messages that this service sent.

By default Celery and kombu do not do this. Celery and kombu serve the queues in turn and ignore their priority. With
early acknowledgement they also fetch one message more than they can start. A more urgent job would then wait for two
jobs instead of one. Celery also ends the worker for many contents of a message, and obeys its headers.
"""

from __future__ import annotations

import base64
import fcntl
import json
import logging
import os
import stat
import time
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path
from queue import Empty
from typing import Any

from celery import bootsteps
from celery.worker import state
from celery.worker.consumer import Consumer
from kombu import Connection
from kombu.exceptions import ChannelError
from kombu.transport import filesystem, redis
from kombu.utils.json import dumps
from kombu.utils.scheduling import FairCycle, priority_cycle

from psfcore.files import write_whole
from workers.broker.app import ASSIST, AWAY, RUN_JOB, check
from workers.contract.jobs import broker_name, by_urgency, queue_of_broker

log = logging.getLogger(__name__)
WAIT_S = 2.0  # time after which a broker that is away is asked again


class MostUrgentFirst(priority_cycle):
    """For Redis: orders the queues in a BRPOP command."""

    def consume(self, n: int) -> list[str]:
        """The queues to read, highest priority first."""
        return by_urgency(self.items[:n])


class _InOrder(FairCycle):
    """For the folder broker: reads the first queue that has a message."""

    def get(self, callback: Callable[..., None], **options: float | None) -> object:
        """Pass one message to the callback. Raises ``predicate`` if there is no message."""
        for queue in by_urgency(self.resources):
            try:
                return self.fun(queue, callback, **options)
            except Empty:
                continue
        raise self.predicate


def _take(read: Callable[[], Any]) -> dict[str, object] | None:
    """Read a message, and make it anew from its task, its job id and its queue.

    Returns None, and writes a line into the log, if this service did not send the message.
    """
    try:
        message = read()
        task = message["headers"]["task"]
        queue = queue_of_broker(message["properties"]["delivery_info"]["routing_key"])
        [job_id], _, _ = json.loads(base64.b64decode(message["body"]))
        if task not in (RUN_JOB, ASSIST) or uuid.UUID(job_id).hex != job_id:
            raise ValueError
    except (Empty, OSError):
        raise
    except Exception as error:  # noqa: BLE001  (whoever writes to the broker can cause any error)
        log.warning(
            "dropped a message of the broker that this service did not send (%s)", type(error).__name__
        )
        return None
    body = json.dumps([[job_id], {}, {}]).encode()
    return {
        "body": base64.b64encode(body).decode(),
        "content-type": "application/json",
        "content-encoding": "utf-8",
        "headers": {"task": task, "id": uuid.uuid4().hex},
        "properties": {
            "body_encoding": "base64",
            "delivery_tag": uuid.uuid4().hex,
            "delivery_info": {"exchange": "", "routing_key": broker_name(queue)},
        },
    }


def _sift(response: list[bytes] | None) -> tuple[bytes, str] | None:
    """For Redis: the answer to a BRPOP command; None, as after its time limit, if the message must be dropped."""
    if response is None:
        return None
    queue, text = response
    message = _take(partial(json.loads, text))
    return None if message is None else (queue, json.dumps(message))


class _FolderChannel(filesystem.Channel):
    """Writes files atomically and reads plain files only. Kombu's own channel would hang if a file is empty,
    incompletely written or a named pipe.
    """

    def get_table(self, exchange: str) -> list[filesystem.exchange_queue_t]:
        """The queues bound to an exchange; empty if the file is damaged, for example by a power failure, or no plain
        file.
        """
        if not self._exchange_file(exchange).is_file():
            return []
        try:
            return list(super().get_table(exchange))
        except (TypeError, ValueError):
            return []

    def _queue_bind(self, exchange: str, routing_key: str, pattern: str, queue: str) -> None:
        self.control_folder.mkdir(exist_ok=True)
        # For reading too: a named pipe would otherwise wait for a reader.
        with (self.control_folder / "lock").open("ab+", buffering=0) as held:
            fcntl.flock(held, fcntl.LOCK_EX)
            binding = filesystem.exchange_queue_t(routing_key or "", pattern or "", queue or "")
            bound = self.get_table(exchange)
            if binding not in bound:
                _write_whole(self._exchange_file(exchange), [binding, *bound])

    def _put(self, queue: str, payload: object, **_: object) -> None:  # type: ignore[override]  # kombu has two
        name = f"{time.monotonic_ns() // 1_000_000}_{uuid.uuid4()}.{queue}.msg"
        _write_whole(Path(self.data_folder_out) / name, payload)

    def _get(self, queue: str, timeout: float | None = None) -> dict[str, object]:
        folder = Path(self.data_folder_in)
        for name in sorted(os.listdir(folder)):
            if name.partition(".")[2] == f"{queue}.msg":
                content = _taken(folder / name)
                message = None if content is None else _take(partial(json.loads, content))
                if message is not None:
                    return message
        raise Empty

    def _reset_cycle(self) -> None:
        self._cycle = _InOrder(self._get_and_deliver, self._active_queues, Empty)


def _taken(file: Path) -> bytes | None:
    """The content of a message, which is removed; None if another worker took it, or if it is no plain file.

    A named pipe is opened without waiting for a writer, because it would hold the worker for ever.
    """
    try:
        opened = os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        with os.fdopen(opened, "rb") as stream:
            if not stat.S_ISREG(os.fstat(opened).st_mode):
                return None
            content = stream.read()
        file.unlink()  # only one worker can
    except OSError:
        return None
    return content


def _write_whole(file: Path, content: object) -> None:
    """Write a file atomically. Raises ``ChannelError``."""
    try:
        write_whole(file, dumps(content))
    except OSError as error:
        raise ChannelError(f"cannot write {file}: {error}") from error


class FolderTransport(filesystem.Transport):
    """The broker of the embedded mode: kombu's folder of messages, read in the order of our queue priorities."""

    Channel = _FolderChannel

    @property
    def default_connection_params(self) -> dict[str, object]:
        """None: a folder has neither host nor port. Kombu's own version names localhost, and warns that no host was
        given.
        """
        return {}

    def drain_events(self, connection: object, timeout: float | None = None, **_: object) -> None:
        """Deliver one message. Raises ``TimeoutError`` if no message arrives in time, or at once if the worker must
        stop.

        Celery checks whether the worker must stop only between two calls of this method. Kombu's own version sleeps
        twice for a few seconds, which would delay the stop.
        """
        until = None if timeout is None else time.monotonic() + timeout
        channels: Any = self.cycle
        while True:
            # should_stop is an exit code, or None. The code 0 also means that the worker must stop.
            if state.should_stop is not None and state.should_stop is not False:
                raise TimeoutError
            try:
                channels.get(self._deliver, timeout=timeout)
                return
            except Empty:
                if until is not None and time.monotonic() >= until:
                    raise TimeoutError from None
            time.sleep(self.polling_interval)


class PatientConsumer(Consumer):
    """The part of a worker that takes messages. It waits for a broker that is away or accepts no messages.

    Celery itself ends the worker after 100 attempts.
    """

    def connect(self) -> Connection:
        """The connection, once the broker accepts messages. Raises ``WorkerShutdown`` if the worker must stop."""
        told = ""
        while self.app.conf.broker_transport is None:  # the folder of the embedded mode needs no server
            state.maybe_shutdown()
            try:
                check(self.app.conf.broker_url)
                break
            except AWAY as error:
                if str(error) != told:
                    told = str(error)
                    log.warning("waiting for the broker (%s): %s", type(error).__name__, told)
                time.sleep(WAIT_S)
        connection: Connection = super().connect()
        return connection


class TakeWhatCanStart(bootsteps.StartStopStep):
    """Keeps a worker from taking messages while all its processes are busy, and messages that this service did not
    send.

    Celery's ``worker_disable_prefetch`` does the first, but only for Redis.
    """

    requires = ("celery.worker.consumer.tasks:Tasks",)

    def start(self, consumer: Consumer) -> None:
        """Make the channel check whether the pool has an idle process, before it checks its own limit of messages;
        for Redis, also make it drop messages that this service did not send.
        """
        channel = consumer.task_consumer.channel
        if isinstance(channel, redis.Channel):
            channel.client.set_response_callback("BRPOP", _sift)
        qos = channel.qos
        within_limit = qos.can_consume
        qos.can_consume = lambda: (
            len(state.reserved_requests) < consumer.pool.num_processes and within_limit()
        )
