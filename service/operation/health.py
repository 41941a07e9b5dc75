"""Is the service up, and can it do its work? ``/healthz`` and ``/readyz``."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import BaseModel, Field

from service.http import problems
from service.http.state import Shared
from workers import checks
from workers.settings import software_version

router = APIRouter(tags=["operation"])
NOT_READY = {"model": problems.ProblemDocument, "description": "Something is away; `parts` says what."}


class Health(BaseModel):
    """The process answers, and so does its database."""

    status: str
    version: str


class Readiness(BaseModel):
    """All that the service stands on answers."""

    status: str
    parts: dict[str, str] = Field(description="database, storage, and broker or embedded worker: `ok` each")


@router.get("/healthz", summary="Is the service up?", responses=problems.RESPONSES)
def healthz(state: Shared) -> Health:
    """200 where the process, its reconciler and its database are up; 503 where one is not."""
    state.catalogue.ping()
    if not state.reconciler.alive:
        raise problems.Problem(
            503, "reconciler-stopped", "queued jobs are not submitted; restart the service"
        )
    return Health(status="ok", version=software_version())


@router.get("/readyz", summary="Can the service do its work?", responses={503: NOT_READY})
def readyz(state: Shared) -> Readiness:
    """200 where database, storage, and broker (or the embedded worker) answer; else 503 that says which does not."""
    parts = {}
    for name, check in checks.needed(state.settings, state.catalogue, state.store).items():
        try:
            check()
            parts[name] = "ok"
        except checks.Unusable as fault:
            parts[name] = str(fault)
    if not state.reconciler.alive:
        parts["reconciler"] = "queued jobs are not submitted; restart the service"
    away = {name: found for name, found in parts.items() if found != "ok"}
    if away:
        raise problems.Problem(503, "not-ready", "; ".join(away.values()), parts=parts)
    return Readiness(status="ready", parts=parts)
