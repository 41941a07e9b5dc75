"""Logs of the service and its workers on standard error or in a file: one line for each record, as JSON or as text.

``bind`` stores the request, the job or its owner once; all later log lines of the same context then contain these
values. Headers, keys and contents of files are never logged: in a line, the secret of a key is replaced by ``***``.
"""

from __future__ import annotations

import fcntl
import json
import logging
import math
import os
import re
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workers.settings import Settings

_ABOUT: ContextVar[dict[str, str]] = ContextVar("what log lines are about", default={})  # noqa: B039 - the dictionary is never changed in place
# A client chooses its request id, so it must not contain characters that end a line or imitate another log entry.
_KEY = re.compile(r"(hpsf_[0-9a-f]{1,16}_)[\w-]+", re.ASCII | re.IGNORECASE)
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")


def bind(**about: str) -> None:
    """Add ``request``, ``job`` or ``owner`` to all later log lines of this thread or asynchronous task
    (`contextvars`).
    """
    _ABOUT.set({**_ABOUT.get(), **about})


@contextmanager
def bound(**about: str) -> Iterator[None]:
    """Add these values to all log lines that are written in the ``with`` block."""
    token = _ABOUT.set({**_ABOUT.get(), **about})
    try:
        yield
    finally:
        _ABOUT.reset(token)


def about() -> dict[str, str]:
    """The values that are now added to each log line."""
    return dict(_ABOUT.get())


def request_id(sent: str | None) -> str:
    """The id that a client sent, if it has at most 64 letters, digits, '.', '_' or '-'; otherwise a new id."""
    return sent if sent is not None and _REQUEST_ID.fullmatch(sent) else uuid.uuid4().hex


class JsonFormatter(logging.Formatter):
    """One JSON object per line, with the keys of ``extra={"fields": {...}}``."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as a line."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
            **_ABOUT.get(),
            **getattr(record, "fields", {}),
            "process": record.process,
        }
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        return _without_secrets(json.dumps(line, ensure_ascii=False, default=str))


class TextFormatter(logging.Formatter):
    """Text for a terminal: time, level, message and the bound values."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as a line, followed by its traceback, if any."""
        time = datetime.fromtimestamp(record.created, UTC).strftime("%H:%M:%S")
        parts = {**_ABOUT.get(), **getattr(record, "fields", {})}
        facts = "".join(f" {name}={value}" for name, value in parts.items())
        line = _one_line(f"{time} {record.levelname:<7} {record.getMessage()}{facts}")
        trace = f"\n{self.formatException(record.exc_info)}" if record.exc_info else ""
        return _without_secrets(f"{line}{trace}")


def _without_secrets(text: str) -> str:
    return _KEY.sub(r"\1***", text)


def _one_line(text: str) -> str:
    """The text with control characters escaped, because clients choose parts of it."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class RotatedFile(RotatingFileHandler):
    """A log file that several processes share. When it is full, it is renamed to FILE.1, FILE.1 to FILE.2, and so
    on.
    """

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record, while no other process rotates the file."""
        with Path(f"{self.baseFilename}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            old, path = self.stream, Path(self.baseFilename)
            if old is not None and not (path.exists() and os.path.samefile(path, old.fileno())):
                old.close()  # another process has rotated the file
                self.stream = self._open()
            super().emit(record)


def _tried_again(record: logging.LogRecord) -> bool:
    """Lower errors of Celery to warnings: a lost broker or a lost process is no failure of a job, which is tried
    again.
    """
    if record.levelno >= logging.ERROR:
        record.levelno, record.levelname = logging.WARNING, logging.getLevelName(logging.WARNING)
    return True


class Seldom(logging.Filter):
    """Writes at most one record of each kind in ``every_s`` seconds. The next record says how many records were left
    out.

    Two records are of the same kind if they come from the same logger and the first lines of their message templates
    are equal. The filter is for messages that clients without a key can cause; without it, these messages could fill
    the disk.
    """

    def __init__(
        self, about: Callable[[logging.LogRecord], bool] = lambda _record: True, every_s: float = 60.0
    ) -> None:
        """Limit the records that ``about`` selects to one of each kind in ``every_s`` seconds; all other records are
        written.
        """
        super().__init__()
        self._about, self._every_s = about, every_s
        self._said: dict[tuple[str, str], tuple[float, int]] = {}
        self._lock = threading.Lock()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is written."""
        if not self._about(record):
            return True
        kind = (record.name, str(record.msg).partition("\n")[0])
        now = time.monotonic()
        with self._lock:
            said_at, left_out = self._said.get(kind, (-math.inf, 0))
            if now - said_at < self._every_s:
                self._said[kind] = (said_at, left_out + 1)
                return False
            self._said[kind] = (now, 0)
        if left_out:
            record.msg = f"{record.msg} ({left_out} more such messages were left out)"
        return True


REQUESTS = "service.http.observation"  # the logger of answered requests
_SELDOM_WARNINGS = Seldom(lambda record: record.levelno < logging.ERROR)
_SELDOM_ACCEPTS = Seldom(lambda record: record.getMessage().startswith("socket.accept()"))


def _no_request(record: logging.LogRecord) -> bool:
    """False if the record is about a request that was answered without a failure of the service (status below 500);
    otherwise True.
    """
    return record.name != REQUESTS or getattr(record, "fields", {}).get("status", 500) >= 500


def configure(settings: Settings, *, verbose: bool = False) -> None:
    """Write the logs of the process to standard error, or to the file of the settings. Repeated calls change nothing.

    A person who starts a service on a terminal sees a line for each request only if ``verbose`` is true or
    HELIOPSF_LOG_FORMAT is set: these lines would hide the address of the service.
    """
    stream = sys.__stderr__ or sys.stderr
    terminal = settings.log_file is None and stream.isatty()
    form = settings.log_format or ("text" if terminal else "json")
    handler: logging.Handler = logging.StreamHandler(stream)
    if settings.log_file is not None:
        size = settings.log_file_mib * 2**20
        handler = RotatedFile(
            settings.log_file, maxBytes=size, backupCount=settings.log_files, encoding="utf-8"
        )
    if settings.log_format is None and terminal and not verbose:
        handler.addFilter(_no_request)
    handler.setFormatter(JsonFormatter() if form == "json" else TextFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    # These libraries log every request, connection and plug-in. Our own log lines contain the same, with the request
    # id. An upgrade of the database is logged in one line, see ``Schema.upgrade``.
    for chatty in ("httpx", "httpcore", "uvicorn.access", "alembic.runtime"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    # The library of Celery's processes has a logger of its own, which passes nothing on.
    logging.getLogger("multiprocessing").handlers = [handler]
    for retried in ("multiprocessing", "celery.worker.consumer.consumer", "celery.worker.request"):
        logging.getLogger(retried).addFilter(_tried_again)
    # Clients without a key can cause these: requests that are not HTTP, and more connections than the system allows.
    logging.getLogger("uvicorn.error").addFilter(_SELDOM_WARNINGS)
    logging.getLogger("asyncio").addFilter(_SELDOM_ACCEPTS)
    logging.captureWarnings(True)
