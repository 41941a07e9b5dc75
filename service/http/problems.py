"""Errors as RFC 9457 problem documents, and the HTTP status of each error code."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from typing import TypedDict, cast

from fastapi import FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import ErrorDetails
from sqlalchemy.exc import DatabaseError, SQLAlchemyError
from starlette.exceptions import HTTPException

from psfcore.errors import DataError
from workers import checks, logs
from workers.catalogue.database import is_away
from workers.contract.suggestions import explained
from workers.files.store import NO_ROOM, STORAGE_FULL, StoreAway, is_disk_full

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
    "equal-bulk-open": 409,
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
    "upload-locked": 423,
    "too-many-uploads": 429,
}
# Headers of every answer; a route may set others. The headers forbid browsers to guess media types, to show
# the answer in a frame, to send a referrer, to load content, and to let windows of other sites reach the answer.
SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# How the addresses start at which a browser gets no pages.
FOR_PROGRAMS = ("/v1/", "/uws", "/vo/", "/openapi.json", "/metrics", "/health")
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
        self, status: int, code: str, detail: str, *, headers: Mapping[str, str] | None = None, **more: object
    ) -> None:
        super().__init__(status, detail, dict(headers or {}))
        self.status, self.code, self.more = status, code, more


def problem(error: DataError, **more: object) -> Problem:
    """The HTTP error for a DataError, with the same code, message and fields, and the further fields in ``more``."""
    return Problem(
        STATUS_OF.get(error.code, 422), error.code, error.message, headers=None, **{**error.fields, **more}
    )


@contextmanager
def as_problems() -> Iterator[None]:
    """Turn each DataError of the ``with`` block into an HTTP error."""
    try:
        yield
    except DataError as error:
        raise problem(error) from error


Descriptions = dict[int | str, dict[str, object]]  # of answers, for OpenAPI, by status


class RouteOptions(TypedDict, total=False):
    """What several routes state in the same way."""

    status_code: int
    response_class: type[Response]
    responses: Descriptions
    openapi_extra: dict[str, object]


RESPONSES: Descriptions = {
    "4XX": {"model": ProblemDocument, "description": "The request was refused; `detail` says why."},
}
AsPage = Callable[[Request, int, str, str, Mapping[str, object]], Response]


def answer(request: Request, error: Problem, as_page: AsPage) -> Response:
    """The answer to a request that failed: a problem document, or a page if a browser asked for a page.

    Parameters
    ----------
    as_page
        Function (request, status, code, detail, fields) that makes the page.
    """
    if wants_page(request):
        page = as_page(request, error.status, error.code, error.detail, error.more)
        for name, value in (error.headers or {}).items():
            page.headers.setdefault(name, value)  # a page has its own security policy
        return page
    body = {
        "type": f"urn:heliopsf:{error.code}",
        "title": _OF_TUS.get(error.status) or HTTPStatus(error.status).phrase,
        "status": error.status,
        "detail": error.detail,
        **error.more,
    }
    return JSONResponse(body, error.status, media_type=MEDIA_TYPE, headers=error.headers)


def install(app: FastAPI, as_page: AsPage) -> None:
    """Make the application answer every error as ``answer`` does."""

    @app.exception_handler(Problem)
    async def _problem(request: Request, error: Problem) -> Response:
        if wants_page(request):
            return await run_in_threadpool(answer, request, error, as_page)
        # Without a thread of the pool: /readyz answers although all of them wait.
        return answer(request, error, as_page)

    @app.exception_handler(RequestValidationError)
    def _invalid(request: Request, error: RequestValidationError) -> Response:
        body = getattr(request.scope.get("route"), "body_field", None)
        model = None if body is None else body.field_info.annotation
        errors = []
        for one in error.errors()[:MOST_ERRORS]:
            # The location of a field of the body starts with "body", which is not part of the model.
            inside = cast(ErrorDetails, one | {"loc": one["loc"][1:]})
            [(_, message)] = explained([inside], model if one["loc"][:1] == ("body",) else None)
            errors.append({"at": "/".join(map(str, one["loc"])), "message": message})
        detail = "; ".join(f"{e['at']}: {e['message']}" for e in errors)
        if len(error.errors()) > MOST_ERRORS:
            detail += f"; and {len(error.errors()) - MOST_ERRORS} more errors"
        return answer(request, Problem(422, "invalid-request", detail, errors=errors), as_page)

    @app.exception_handler(HTTPException)
    def _http(request: Request, error: HTTPException) -> Response:
        status, path = error.status_code, request.url.path
        details = {
            404: f"expected an address of this service; nothing is at {path}: /docs lists all addresses",
            405: f"expected a method that {path} accepts; got {request.method}: /docs lists them",
        }
        detail = details.get(status, str(error.detail))
        return answer(request, Problem(status, f"http-{status}", detail, headers=error.headers), as_page)

    @app.exception_handler(SQLAlchemyError)
    @app.exception_handler(OSError)
    def _away(request: Request, error: SQLAlchemyError | OSError) -> Response:
        reply = _of_system(error)
        if reply is None:
            raise error  # it is answered as an internal error
        level = logging.WARNING if reply.headers else logging.ERROR  # Retry-After: nothing failed for good
        log.log(level, "%s: %s", "database" if isinstance(error, SQLAlchemyError) else "storage", error)
        return answer(request, reply, as_page)

    @app.exception_handler(Exception)
    def _ours(request: Request, _error: Exception) -> Response:
        # After this answer Starlette logs the traceback and passes the error on to the server, which closes the
        # connection. No middleware sets the headers of this answer, so they are set here.
        headers = {"Connection": "close", "X-Request-ID": logs.about().get("request", "")}
        detail = (
            "the service failed and logged the error; send the X-Request-ID of this answer to the operator"
        )
        return answer(
            request, Problem(500, "internal-error", detail, headers=SECURITY_HEADERS | headers), as_page
        )


def _of_system(error: SQLAlchemyError | OSError) -> Problem | None:
    """The problem for an error of the database, the disk or the file storage; None for a fault of the service."""
    soon = {"Retry-After": "5"}
    if isinstance(error, StoreAway):
        detail = "the file storage of the service does not answer; try again in a moment"
        return Problem(503, "storage-away", detail, headers=soon)
    if is_disk_full(error):
        return Problem(507, STORAGE_FULL, NO_ROOM)
    if is_away(error):
        detail = "the database of the service does not answer, or accepts no changes; try again in a moment"
        return Problem(503, "database-away", detail, headers=soon)
    if isinstance(error, DatabaseError) and checks.damaged(error):
        detail = "the database of the service is damaged; tell the operator, who must restore a copy"
        return Problem(503, "database-damaged", detail)
    return None


def wants_page(request: Request) -> bool:
    """Whether a person asked for a page: a browser accepts HTML, and addresses of the interfaces are for programs."""
    return "text/html" in request.headers.get("accept", "") and not request.url.path.startswith(FOR_PROGRAMS)
