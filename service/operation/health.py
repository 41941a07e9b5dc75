"""``/healthz`` (is the service up?) and ``/readyz`` (can it do its work?)."""

from __future__ import annotations

from collections.abc import Mapping

from fastapi import APIRouter
from pydantic import BaseModel, Field

from service.http import problems
from service.http.state import Shared, State
from workers import checks
from workers.settings import software_version

OK = "ok"
router = APIRouter(tags=["operation"])
NOT_READY = {
    "model": problems.ProblemDocument,
    "description": "A part does not answer; `parts` says which part.",
}


class Health(BaseModel):
    """The process and its database answer."""

    status: str
    version: str


class Readiness(BaseModel):
    """All parts that the service needs answer."""

    status: str
    parts: dict[str, str] = Field(
        description="state of the database, of the storage, and of the broker or embedded worker; `ok`: the part answers"
    )


@router.get("/healthz", summary="Is the service up?", responses=problems.RESPONSES)
def healthz(state: Shared) -> Health:
    """200: process, reconciler and database work. 503: one of them does not work."""
    state.catalogue.ping()
    if not state.reconciler.alive:
        raise problems.Problem(
            503,
            "reconciler-stopped",
            "the reconciler stopped, so queued jobs are not submitted; restart the service",
        )
    return Health(status="ok", version=software_version())


@router.get("/readyz", summary="Can the service do its work?", responses={503: NOT_READY})
def readyz(state: Shared) -> Readiness:
    """200: database, storage, and broker (or embedded worker) answer. 503: one of them does not answer; `parts` says which one."""
    parts = states(state)
    away = faults(parts)
    if away:
        raise problems.Problem(503, "not-ready", "; ".join(away), parts=parts)
    return Readiness(status="ready", parts=parts)


def states(state: State) -> dict[str, str]:
    """The state of each part that the service needs, by its name: "ok", or what is wrong."""
    parts = {}
    for name, check in checks.needed(state.settings, state.catalogue, state.store).items():
        try:
            check()
            parts[name] = OK
        except checks.Unusable as fault:
            parts[name] = str(fault)
    if not state.reconciler.alive:
        parts["reconciler"] = "the reconciler stopped, so queued jobs are not submitted; restart the service"
    return parts


def faults(parts: Mapping[str, str]) -> list[str]:
    """What is wrong with the parts that do not answer."""
    return [found for found in parts.values() if found != OK]
