"""Logs of the service and its workers: one line a record on standard error, as JSON or for a reader.

What a line is about (the request, the job, its owner) is bound once, where it is known, and is on every line
that is written while it is bound. Headers, tokens and contents of files are never logged.
"""

from __future__ import annotations

import json
import logging
import re
import sys
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workers.settings import Settings

_ABOUT: ContextVar[dict[str, str]] = ContextVar("what log lines are about", default={})  # noqa: B039 - never changed in place
# What goes on a line as it came from outside: nothing that could end the line or stand for another.
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")


def bind(**about: str) -> None:
    """Lines of this context are about these from now on: ``request``, ``job``, ``owner``."""
    _ABOUT.set({**_ABOUT.get(), **about})


@contextmanager
def bound(**about: str) -> Iterator[None]:
    """Lines written in the block are about these."""
    token = _ABOUT.set({**_ABOUT.get(), **about})
    try:
        yield
    finally:
        _ABOUT.reset(token)


def about() -> dict[str, str]:
    """What lines are about here and now."""
    return dict(_ABOUT.get())


def request_id(sent: str | None) -> str:
    """The id that a client sent, where it is a plain short word; a new one otherwise."""
    return sent if sent is not None and _REQUEST_ID.fullmatch(sent) else uuid.uuid4().hex


class JsonFormatter(logging.Formatter):
    """One JSON object a line; ``extra={"fields": {...}}`` of a call are keys of it."""

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
        return json.dumps(line, ensure_ascii=False, default=str)


class TextFormatter(logging.Formatter):
    """For a reader at a terminal: time, level, message, and what it is about."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as a line, with the traceback below where there is one."""
        time = datetime.fromtimestamp(record.created, UTC).strftime("%H:%M:%S")
        parts = {**_ABOUT.get(), **getattr(record, "fields", {})}
        facts = "".join(f" {name}={value}" for name, value in parts.items())
        line = _one_line(f"{time} {record.levelname:<7} {record.getMessage()}{facts}")
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


def _one_line(text: str) -> str:
    """The text without what would end its line or steer a terminal; some of it came from outside."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def configure(settings: Settings) -> None:
    """Write the process's logs to standard error; calling it again changes nothing."""
    stream = sys.__stderr__ or sys.stderr
    form = settings.log_format or ("text" if stream.isatty() else "json")
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonFormatter() if form == "json" else TextFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    # Their news are of single requests, connections and plug-ins; ours says the same with the request's id.
    for chatty in ("httpx", "httpcore", "uvicorn.access", "alembic.runtime.plugins"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    logging.captureWarnings(True)
