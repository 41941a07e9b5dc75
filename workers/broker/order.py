"""How a worker takes messages: from the most urgent queue that has one, and none before a process is free for it.

Celery and kombu do neither by themselves. They take from queues in turn, so that a thousand messages of one queue stand
before the second of another; and with early acknowledgement a message more than can be started, behind which
whatever is more urgent then waits for two jobs instead of one.
"""

from __future__ import annotations

import fcntl
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from queue import Empty
from typing import Any

from celery import bootsteps
from celery.worker import state
from kombu.exceptions import ChannelError
from kombu.transport import filesystem
from kombu.utils.json import dumps
from kombu.utils.scheduling import FairCycle, priority_cycle

from psfcore.whole_files import write_whole
from workers.contract.queues import by_urgency


class MostUrgentFirst(priority_cycle):
    """For Redis: the order in which one BRPOP names the queues."""

    def consume(self, n: int) -> list[str]:
        """The queues to ask."""
        return by_urgency(self.items[:n])


class _InOrder(FairCycle):
    """For the folder: each time from the first queue that has a message."""

    def get(self, callback: Callable[..., Any], **options: Any) -> Any:
        """One message to the callback; what ``predicate`` says where there is none."""
        for queue in by_urgency(self.resources):
            try:
                return self.fun(queue, callback, **options)
            except Empty:
                continue
        raise self.predicate


class _FolderChannel(filesystem.Channel):
    """Writes whole files or none: kombu's own would stop for ever at one that is empty, or was read too early."""

    def get_table(self, exchange: str) -> list[Any]:
        """The queues bound to an exchange; none of a file that was cut when the power went."""
        try:
            return list(super().get_table(exchange))
        except ValueError:
            return []

    def _queue_bind(self, exchange: str, routing_key: str, pattern: str, queue: str) -> None:
        self.control_folder.mkdir(exist_ok=True)
        with (self.control_folder / "lock").open("w") as held:
            fcntl.flock(held, fcntl.LOCK_EX)
            binding = filesystem.exchange_queue_t(routing_key or "", pattern or "", queue or "")
            bound = self.get_table(exchange)
            if binding not in bound:
                _write_whole(self._exchange_file(exchange), [binding, *bound])

    def _put(self, queue: str, payload: Any, **_: Any) -> None:  # type: ignore[override]  # kombu has two
        name = f"{time.monotonic_ns() // 1_000_000}_{uuid.uuid4()}.{queue}.msg"
        _write_whole(Path(self.data_folder_out) / name, payload)

    def _reset_cycle(self) -> None:
        self._cycle = _InOrder(self._get_and_deliver, self._active_queues, Empty)


def _write_whole(file: Path, content: Any) -> None:
    """Write a file that nobody sees before all of it is there. Raises ``ChannelError``."""
    try:
        write_whole(file, dumps(content))
    except OSError as error:
        raise ChannelError(f"cannot write {file}: {error}") from error


class FolderTransport(filesystem.Transport):
    """The broker of the embedded mode: kombu's folder of messages, its queues in our order."""

    Channel = _FolderChannel

    def drain_events(self, connection: Any, timeout: float | None = None, **_: Any) -> None:
        """One message, or ``TimeoutError``; at once where the worker was told to stop.

        Kombu's own would sleep on for seconds, twice: Celery looks at what it was told between two calls alone.
        """
        until = None if timeout is None else time.monotonic() + timeout
        channels: Any = self.cycle
        while True:
            # What it is to stop with is an exit code, so that 0 is a yes.
            if state.should_stop is not None and state.should_stop is not False:
                raise TimeoutError
            try:
                channels.get(self._deliver, timeout=timeout)
                return
            except Empty:
                if until is not None and time.monotonic() >= until:
                    raise TimeoutError from None
            time.sleep(self.polling_interval)


class TakeWhatCanStart(bootsteps.StartStopStep):
    """Lets a worker take no message while all its processes are at work.

    As Celery's ``worker_disable_prefetch`` does it, which knows Redis alone.
    """

    requires = ("celery.worker.consumer.tasks:Tasks",)

    def start(self, consumer: Any) -> None:
        """Ask the pool before the limit of messages."""
        qos = consumer.task_consumer.channel.qos
        within_limit = qos.can_consume
        qos.can_consume = lambda: (
            len(state.reserved_requests) < consumer.pool.num_processes and within_limit()
        )
