"""Errors as pages: what happened, what to do, and what was kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import Request, Response

from service.pages.parts.sentences import of_error
from service.pages.rendering import page

TITLES = {
    403: "This key does not allow that",
    404: "There is nothing here",
    410: "The file is lost",
    413: "This is too large",
    415: "The service cannot read this file",
    421: "This host name is not served",
    429: "Too many requests",
    503: "The service cannot answer now",
    507: "The disk of the service is full",
}
TITLES_OF_CODES = {
    "cross-site": "This request came from another site",
    "form-token-missing": "This form is too old",
}
# Other pages of this address would be refused too.
WITHOUT_LINKS = {421}
# The image was stored before these errors, or its page still shows it.
KEPT = "Nothing is lost: your earlier uploads are kept, and you need not send them again."


def problem_page(
    request: Request, status: int, code: str, detail: str, fields: Mapping[str, Any]
) -> Response:
    """The page of an error."""
    usual = "The service failed" if status >= 500 else "The service cannot do that"
    title = TITLES_OF_CODES.get(code) or TITLES.get(status) or usual
    kept = KEPT if status in (429, 500, 503, 507) else ""
    return page(
        request,
        "problem.html",
        status=status,
        told_status=status,
        title=title,
        detail=_told(request, code, detail, fields),
        code=code,
        kept=kept,
        linked=status not in WITHOUT_LINKS,
    )


def _told(request: Request, code: str, detail: str, fields: Mapping[str, Any]) -> str:
    if code == "http-404":
        return f"Nothing is at {request.url.path}. Choose a page above."
    if any(str(one["at"]).startswith("path/") for one in fields.get("errors", [])):
        return f"{request.url.path} is not the address of a page. Copy the whole address, or choose a page above."
    return of_error(code, detail, fields)
