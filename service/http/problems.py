"""Errors as RFC 9457 problem documents, and the HTTP status of each error code."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any, cast

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import ErrorDetails
from sqlalchemy.exc import DatabaseError, InterfaceError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException

from psfcore.errors import DataError
from workers import checks, logs
from workers.contract.suggestions import explained
from workers.files.full_disk import NO_ROOM, STORAGE_FULL, is_disk_full
from workers.files.store import StoreAway

log = logging.getLogger(__name__)
MEDIA_TYPE = "application/problem+json"
MOST_ERRORS = 20  # errors of one request that an answer lists
# HTTP status of a DataError, by its code; 422 for every other code.
STATUS_OF = {
    "already-deconvolved": 409,
    "no-psf-fits": 404,
    "no-such-bulk": 404,
    "no-such-context": 404,
    "no-such-image": 404,
    "no-such-job": 404,
    "no-such-key": 404,
    "no-such-plane": 404,
    "no-such-product": 404,
    "no-such-psf": 404,
    "no-such-report": 404,
    "no-such-series": 404,
    "no-such-transit": 404,
    "file-damaged": 410,
    "file-lost": 410,
    "changed-meanwhile": 409,
    "channel-mismatch": 409,
    "cutout-not-plain": 409,
    "line-known": 409,
    "name-taken": 409,
    "no-date": 409,
    "no-helioprojective": 409,
    "no-instrument": 409,
    "no-line": 409,
    "no-psf-for-instrument": 409,
    "no-such-successor": 409,
    "not-a-draft": 409,
    "not-made-here": 409,
    "not-to-supersede": 409,
    "nothing-to-pin": 409,
    "parameters-outdated": 409,
    "parameters-unknown": 409,
    "plate-scale-mismatch": 409,
    "psf-as-image": 409,
    "psf-deprecated": 409,
    "psf-in-use": 409,
    "ranges-overlap": 409,
    "series-not-total": 409,
    "several-ids-fit": 409,
    "several-psfs-fit": 409,
    "several-variants-fit": 409,
    "successor-named": 409,
    "version-taken": 409,
    "wrong-transition": 409,
    "archive-too-large": 413,
    "too-much-memory": 413,
    "not-an-archive": 415,
}
# Headers of every answer; a route may set others. The headers forbid browsers to guess media types, to show
# the answer in a frame, to send a referrer, and to load content.
SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_OF_TUS = {460: "Checksum Mismatch"}  # a status that is not in the registry of HTTP


class ProblemDocument(BaseModel):
    """The body of the answer to a request that failed."""

    model_config = ConfigDict(extra="allow")

    type: str = Field("about:blank", description="`urn:heliopsf:` and the error code, a stable short name")
    title: str
    status: int
    detail: str = Field(description="what was expected, what was received, and what to do next")


class Problem(HTTPException):
    """An error with its HTTP status. Any endpoint may raise it. The answer is then a problem document.

    The class is an HTTPException, because FastAPI replaces other exceptions that are raised while a body is read.
    """

    def __init__(
        self, status: int, code: str, detail: str, *, headers: Mapping[str, str] | None = None, **more: Any
    ) -> None:
        super().__init__(status, detail, dict(headers or {}))
        self.status, self.code, self.more = status, code, more


def problem(error: DataError, **more: Any) -> Problem:
    """The problem for an error of the request or its data, with the fields of the error. more: further fields."""
    return Problem(STATUS_OF.get(error.code, 422), error.code, error.message, **{**error.fields, **more})


def document(
    status: int, code: str, detail: str, *, headers: Mapping[str, str] | None = None, **more: Any
) -> JSONResponse:
    """The response for a problem."""
    body = {
        "type": f"urn:heliopsf:{code}",
        "title": _OF_TUS.get(status) or HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        **more,
    }
    return JSONResponse(body, status_code=status, media_type=MEDIA_TYPE, headers=headers)


RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {"model": ProblemDocument, "description": "The request was refused; `detail` says why."},
}


AsPage = Callable[[Request, int, str, str, Mapping[str, Any]], Response]


def install(app: FastAPI, as_page: AsPage) -> None:
    """Make the application answer every error with a problem document, or with a page if a browser asked for a page.

    as_page: a function (request, status, code, detail, fields) that makes the page.
    """

    def answer(
        request: Request,
        status: int,
        code: str,
        detail: str,
        *,
        headers: Mapping[str, str] | None = None,
        **more: Any,
    ) -> Response:
        if not wants_page(request):
            return document(status, code, detail, headers=headers, **more)
        made = as_page(request, status, code, detail, more)
        for name, value in (headers or {}).items():
            made.headers.setdefault(name, value)  # a page has its own security policy
        return made

    @app.exception_handler(Problem)
    def _problem(request: Request, found: Problem) -> Response:
        return answer(request, found.status, found.code, found.detail, headers=found.headers, **found.more)

    @app.exception_handler(RequestValidationError)
    def _invalid(request: Request, error: RequestValidationError) -> Response:
        body = getattr(request.scope.get("route"), "body_field", None)
        model = None if body is None else body.field_info.annotation
        errors = []
        for found in error.errors()[:MOST_ERRORS]:
            # The location of a field of the body starts with "body", which is not part of the model.
            inside = cast(ErrorDetails, found | {"loc": found["loc"][1:]})
            [(_, message)] = explained([inside], model if found["loc"][:1] == ("body",) else None)
            errors.append({"at": "/".join(map(str, found["loc"])), "message": message})
        detail = "; ".join(f"{e['at']}: {e['message']}" for e in errors)
        if len(error.errors()) > MOST_ERRORS:
            detail += f"; and {len(error.errors()) - MOST_ERRORS} more errors"
        return answer(request, 422, "invalid-request", detail, errors=errors)

    @app.exception_handler(HTTPException)
    def _http(request: Request, error: HTTPException) -> Response:
        detail = str(error.detail)
        if error.status_code == 404:
            detail = f"expected an address of this service; nothing is at {request.url.path}: /docs lists all addresses"
        elif error.status_code == 405:
            detail = (
                f"expected a method that {request.url.path} accepts; got {request.method}: /docs lists them"
            )
        return answer(request, error.status_code, f"http-{error.status_code}", detail, headers=error.headers)

    @app.exception_handler(OperationalError)
    @app.exception_handler(InterfaceError)
    @app.exception_handler(PoolTimeoutError)
    def _database(request: Request, error: SQLAlchemyError) -> Response:
        log.error("database: %s", error)
        if is_disk_full(error):
            return answer(request, 507, STORAGE_FULL, NO_ROOM)
        return answer(
            request,
            503,
            "database-away",
            "the database of the service does not answer; try again in a moment",
            headers={"Retry-After": "5"},
        )

    @app.exception_handler(DatabaseError)
    def _damaged(request: Request, error: DatabaseError) -> Response:
        if not checks.damaged(error):
            raise error
        log.error("database: %s", error)
        return answer(
            request,
            503,
            "database-damaged",
            "the database of the service is damaged; tell the operator, who must restore a copy",
        )

    @app.exception_handler(OSError)
    def _system(request: Request, error: OSError) -> Response:
        if not is_disk_full(error):
            raise error  # it is answered as an internal error
        log.error("storage: %s", error)
        return answer(request, 507, STORAGE_FULL, NO_ROOM)

    @app.exception_handler(StoreAway)
    def _store(request: Request, error: StoreAway) -> Response:
        log.error("storage: %s", error)
        return answer(
            request,
            503,
            "storage-away",
            "the file storage of the service does not answer; try again in a moment",
            headers={"Retry-After": "5"},
        )

    @app.exception_handler(Exception)
    def _ours(request: Request, _error: Exception) -> Response:
        # After this answer Starlette logs the traceback and passes the error on to the server. No middleware sets the
        # headers of this answer, so they are set here.
        headers = {**SECURITY_HEADERS, "X-Request-ID": logs.about().get("request", "")}
        return answer(
            request,
            500,
            "internal-error",
            "the service failed and logged the error; send the X-Request-ID of this answer to the operator",
            headers=headers,
        )


def wants_page(request: Request) -> bool:
    """Whether a person asked for a page: a browser accepts HTML, and addresses of the interfaces are for programs."""
    for_programs = ("/v1/", "/uws", "/vo/", "/openapi.json", "/metrics", "/health")
    return "text/html" in request.headers.get("accept", "") and not request.url.path.startswith(for_programs)
