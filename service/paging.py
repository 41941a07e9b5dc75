"""Lists a page at a time, newest first, by a cursor that is a place in the order and no offset."""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Generic, Protocol, TypeVar

from fastapi import Query, Request
from pydantic import BaseModel, Field

from service.problems import Problem

Item = TypeVar("Item", bound=BaseModel)


class Page(BaseModel, Generic[Item]):
    """Part of a list."""

    items: list[Item]
    next: str | None = Field(description="address of the next page; null on the last")


class _Ordered(Protocol):
    created_at: Any
    id: Any


Row = TypeVar("Row", bound=_Ordered)
Limit = Annotated[int, Query(ge=1, le=200, description="rows a page")]
Cursor = Annotated[str | None, Query(description="from the `next` of the page before")]


def position(cursor: str | None) -> tuple[float, str] | None:
    """The (created_at, id) in a cursor; ``Problem`` 422 where it is none of ours."""
    if cursor is None:
        return None
    try:
        created_at, _, identity = base64.urlsafe_b64decode(cursor.encode()).decode("ascii").partition(" ")
        at = (float(created_at), identity)
    except (binascii.Error, ValueError) as error:
        raise _no_cursor() from error
    if not math.isfinite(at[0]) or not at[1].isalnum():
        raise _no_cursor()
    return at


def _no_cursor() -> Problem:
    return Problem(422, "bad-cursor", "expected the cursor of an earlier page's `next`")


def page(request: Request, rows: Sequence[Row], limit: int, view: Callable[[Row], Item]) -> Page[Item]:
    """The page for ``limit + 1`` rows that were asked for: one more than is shown tells of a next page."""
    following = None
    if len(rows) > limit:
        last = rows[limit - 1]
        cursor = base64.urlsafe_b64encode(f"{last.created_at!r} {last.id}".encode()).decode()
        query = request.url.include_query_params(cursor=cursor)
        following = f"{query.path}?{query.query}"
    return Page(items=[view(row) for row in rows[:limit]], next=following)
