"""Lists in pages, newest first. A cursor names a row, not an offset. Therefore new rows do not shift the pages."""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Generic, TypedDict, TypeVar

from fastapi import Depends, Query, Request
from pydantic import BaseModel, Field

from service.http.problems import Problem

Item = TypeVar("Item", bound=BaseModel)


class Page(BaseModel, Generic[Item]):
    """One page of a list."""

    items: list[Item]
    next: str | None = Field(description="address of the next page; null: this is the last page")


Row = TypeVar("Row")
Cursor = Annotated[str | None, Query(description="the cursor in `next` of the previous page")]


def place(cursor: str | None, *kinds: Callable[[str], Any]) -> tuple[Any, ...] | None:
    """The parts of a cursor, each read by one of ``kinds`` (``finite``, ``position``, ``identity``); None without a
    cursor.

    Raises ``Problem`` 422 if this service did not issue the cursor.
    """
    if cursor is None:
        return None
    try:
        parts = base64.urlsafe_b64decode(cursor.encode()).decode("ascii").split(" ")
        return tuple(kind(part) for kind, part in zip(kinds, parts, strict=True))
    except (binascii.Error, ValueError) as error:
        raise Problem(
            422,
            "bad-cursor",
            "expected the cursor in the `next` address of an earlier page; got a text that is not a cursor: repeat the "
            "request without a cursor to start at the first page",
        ) from error


def finite(part: str) -> float:
    """A finite number, such as a time. Raises ValueError."""
    if not math.isfinite(value := float(part)):
        raise ValueError(part)
    return value


def position(part: str) -> int:
    """The position of a row in its list. Raises ValueError."""
    if not part.isdecimal() or len(part) > 9:
        raise ValueError(part)
    return int(part)


def identity(part: str) -> str:
    """An id. Raises ValueError."""
    if not part.isalnum():
        raise ValueError(part)
    return part


def _place_in_time(row: Any) -> tuple[str, ...]:
    return repr(row.created_at), row.id


class RowsQuery(TypedDict):
    """Arguments of the query for the rows of a page."""

    limit: int
    after: tuple[float, str] | None


@dataclass(frozen=True)
class Listing:
    """The page of a list that a request asks for."""

    request: Request
    limit: int
    cursor: str | None = None

    @property
    def query(self) -> RowsQuery:
        """Arguments of the query for the rows: one more than the page has, which shows that there is a next page, after
        the (created_at, id) in the cursor. Raises ``Problem`` 422 if this service did not issue the cursor.
        """
        return {"limit": self.limit + 1, "after": place(self.cursor, finite, identity)}

    def following(
        self, rows: Sequence[Row], place_of: Callable[[Row], tuple[str, ...]] = _place_in_time
    ) -> str | None:
        """The address of the next page; None if the rows that ``query`` gave are the last.

        Parameters
        ----------
        rows
            The rows that ``query`` gave.
        place_of
            Function that returns the parts of the cursor that names a row.
        """
        if len(rows) <= self.limit:
            return None
        cursor = base64.urlsafe_b64encode(" ".join(place_of(rows[self.limit - 1])).encode()).decode()
        query = self.request.url.include_query_params(cursor=cursor)
        return f"{query.path}?{query.query}"

    def page(
        self,
        rows: Sequence[Row],
        view: Callable[[Row], Item],
        place_of: Callable[[Row], tuple[str, ...]] = _place_in_time,
    ) -> Page[Item]:
        """The page of the rows that ``query`` gave.

        Parameters
        ----------
        rows
            The rows that ``query`` gave.
        view
            Function that makes the item of a row.
        place_of
            Function that returns the parts of the cursor that names a row, as for ``following``.
        """
        return Page(items=[view(row) for row in rows[: self.limit]], next=self.following(rows, place_of))


async def _listing(
    request: Request,
    limit: Annotated[int, Query(ge=1, le=200, description="rows per page")] = 50,
    cursor: Cursor = None,
) -> Listing:
    return Listing(request, limit, cursor)


Paging = Annotated[Listing, Depends(_listing)]
