"""Phases of a job, and the error with which a job fails."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel

from psfcore.errors import DataError


class Phase(StrEnum):
    """Phases of a job, by their IVOA UWS names.

    A job submitted to ``/v1/jobs`` starts QUEUED. A job created by a UWS client starts PENDING: its parameters can
    be changed until the client starts it.
    """

    PENDING = "PENDING"
    QUEUED = "QUEUED"
    EXECUTING = "EXECUTING"
    COMPLETED = "COMPLETED"
    ERROR = "ERROR"
    ABORTED = "ABORTED"

    @property
    def ended(self) -> bool:
        """True for the final phases: COMPLETED, ERROR and ABORTED."""
        return self in ENDED


ENDED = frozenset({Phase.COMPLETED, Phase.ERROR, Phase.ABORTED})
# An identical request gets the existing job while that job is in one of these phases.
LIVE = frozenset({Phase.QUEUED, Phase.EXECUTING, Phase.COMPLETED})


class Fault(StrEnum):
    """The cause of an error: the user's data or request, a temporary failure, or the software itself."""

    USER = "user"
    TRANSIENT = "transient"
    INTERNAL = "internal"


class JobError(BaseModel):
    """Why a job failed."""

    fault: Fault
    code: str
    message: str

    @classmethod
    def of(cls, error: DataError) -> JobError:
        """The error of a job whose request or data is wrong."""
        return cls(fault=Fault.USER, code=error.code, message=error.message)
