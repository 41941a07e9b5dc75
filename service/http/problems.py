"""Errors as RFC 9457 problem documents."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.exc import InterfaceError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException

from workers import logs
from workers.files.store import StoreAway

log = logging.getLogger(__name__)
MEDIA_TYPE = "application/problem+json"
# On every answer, unless a route has its own: nothing is guessed, framed, told to others, or loaded by a page.
SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class ProblemDocument(BaseModel):
    """An error, as the service answers it."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(
        "about:blank", description="kind of problem, a stable short name behind `urn:heliopsf:`"
    )
    title: str
    status: int
    detail: str = Field(description="what was expected and what came")


class Problem(Exception):
    """Raised by any endpoint; answered as a problem document."""

    def __init__(
        self, status: int, code: str, detail: str, *, headers: Mapping[str, str] | None = None, **more: Any
    ) -> None:
        super().__init__(detail)
        self.status, self.code, self.detail, self.more = status, code, detail, more
        self.headers = dict(headers or {})


def answer(
    status: int, code: str, detail: str, *, headers: Mapping[str, str] | None = None, **more: Any
) -> JSONResponse:
    """The response for a problem."""
    body = {
        "type": f"urn:heliopsf:{code}",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        **more,
    }
    return JSONResponse(body, status_code=status, media_type=MEDIA_TYPE, headers=headers)


RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {"model": ProblemDocument, "description": "The request cannot be done; `detail` says why."},
}


def install(app: FastAPI) -> None:
    """Answer every error of the application with a problem document."""

    @app.exception_handler(Problem)
    def _problem(_request: Request, problem: Problem) -> JSONResponse:
        return answer(problem.status, problem.code, problem.detail, headers=problem.headers, **problem.more)

    @app.exception_handler(RequestValidationError)
    def _invalid(_request: Request, error: RequestValidationError) -> JSONResponse:
        errors = [{"at": "/".join(map(str, e["loc"])), "message": e["msg"]} for e in error.errors()]
        detail = "; ".join(f"{e['at']}: {e['message']}" for e in errors)
        return answer(422, "invalid-request", detail, errors=errors)

    @app.exception_handler(HTTPException)
    def _http(request: Request, error: HTTPException) -> JSONResponse:
        detail = str(error.detail)
        if error.status_code == 404:
            detail = f"nothing is at {request.url.path}"
        elif error.status_code == 405:
            detail = f"{request.url.path} does not take {request.method}"
        problem = answer(error.status_code, f"http-{error.status_code}", detail)
        problem.headers.update(error.headers or {})
        return problem

    @app.exception_handler(OperationalError)
    @app.exception_handler(InterfaceError)
    @app.exception_handler(PoolTimeoutError)
    def _database(_request: Request, error: SQLAlchemyError) -> JSONResponse:
        log.error("database: %s", error)
        problem = answer(503, "database-away", "the database does not answer; try again in a moment")
        problem.headers["Retry-After"] = "5"
        return problem

    @app.exception_handler(StoreAway)
    def _store(_request: Request, error: StoreAway) -> JSONResponse:
        log.error("storage: %s", error)
        return answer(
            503,
            "storage-away",
            "the storage of files does not answer; try again in a moment",
            headers={"Retry-After": "5"},
        )

    @app.exception_handler(Exception)
    def _ours(_request: Request, _error: Exception) -> JSONResponse:
        # Starlette logs the traceback and passes the error on to the server after this answer.
        # This answer goes past all that sets headers.
        headers = {**SECURITY_HEADERS, "X-Request-ID": logs.about().get("request", "")}
        return answer(500, "internal-error", "the service failed; the error is in its log", headers=headers)
