"""Traces of requests and jobs by OpenTelemetry, if the setting ``traces_url`` names a collector.

Without the setting, heliopsf imports nothing of OpenTelemetry, and a span costs one comparison. The trace of a job has
the job's id as its trace id, so the attempts of a job on several workers belong to one trace, which anybody finds who
knows the job.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

from psfcore.errors import module_of_extra
from workers.settings import Settings

if TYPE_CHECKING:
    from workers.trace_exporter import Sender

Attribute = str | int | float | bool
_exporter: Sender | None = None


def configure(settings: Settings, part: str) -> None:
    """Switch traces on if the settings say so.

    Parameters
    ----------
    part
        "server" or "worker".

    Raises
    ------
    psfcore.errors.MissingExtra
        The packages of the extra "traces" are missing.
    """
    global _exporter
    if settings.traces_url is not None and _exporter is None:
        _exporter = module_of_extra("workers.trace_exporter").Sender(settings.traces_url, part)


def shutdown() -> None:
    """Send the spans that wait, and switch traces off."""
    global _exporter
    if _exporter is not None:
        _exporter.shutdown()
        _exporter = None


def of_request(headers: Mapping[str, str]) -> AbstractContextManager[None]:
    """The span of a request, if traces are on. The ``headers`` may name the span of the client (``traceparent``)."""
    return nullcontext() if _exporter is None else _exporter.request(headers)


def of_job(job_id: str, kind: str) -> AbstractContextManager[None]:
    """The span of one attempt of a job, if traces are on."""
    return nullcontext() if _exporter is None else _exporter.job(job_id, kind)


def note(attributes: Mapping[str, Attribute], *, name: str | None = None, failed: str | None = None) -> None:
    """Add attributes to the current span, if traces are on.

    Parameters
    ----------
    name
        The new name of the span.
    failed
        Why the work of the span failed.
    """
    if _exporter is not None:
        _exporter.note(attributes, name=name, failed=failed)
