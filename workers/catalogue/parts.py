"""Parts of jobs that several workers share. A worker takes a part by compare-and-set, and then has a lease for it."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, and_, or_, select, update

from workers.catalogue.database import Queries
from workers.catalogue.tables import PartRow


@dataclass(frozen=True)
class Part:
    """A worker's right to work on a part of a job.

    A worker that has lost this right can still store its result, if no other worker has stored a result of the part.
    """

    owner: str
    request_key: str
    number: int
    token: str


class Parts(Queries):
    """The table of parts."""

    def open(self, owner: str, request_key: str, count: int) -> None:
        """Create the parts 0 to ``count`` - 1, except those that exist."""
        with self._database.writing.begin() as session:
            there = set(session.scalars(select(PartRow.number).where(*_of(owner, request_key))))
            missing = [number for number in range(count) if number not in there]
            session.add_all(PartRow(owner=owner, request_key=request_key, number=one) for one in missing)

    def take(self, owner: str, request_key: str, lease_s: float) -> Part | None:
        """Take an open part, or a part whose worker has been silent for ``lease_s`` seconds; None if there is no such part."""
        # A heartbeat in the future was sent before the database's clock was set back; it counts as a heartbeat of now.
        now = self._database.now
        of_job = _of(owner, request_key)
        self._set([*of_job, PartRow.heartbeat_at > now + lease_s], heartbeat_at=now)
        silent = PartRow.heartbeat_at < now - lease_s
        free = [*of_job, PartRow.result.is_(None), or_(PartRow.token.is_(None), silent)]
        lowest = select(PartRow.number).where(*free).order_by(PartRow.number)
        while (number := self._database.first(lowest)) is not None:
            part = Part(owner, request_key, number, uuid.uuid4().hex)
            if self._set([*free, PartRow.number == number], token=part.token, heartbeat_at=now):
                return part
        return None

    def heartbeat(self, part: Part) -> bool:
        """Renew the lease. Returns False if another worker took the part or the part is done."""
        return self._set(_holding(part), heartbeat_at=self._database.now)

    def finish(self, part: Part, result: dict[str, Any]) -> bool:
        """Store the result of a part. Returns False if the part already has a result.

        The first result is kept, even if the worker has lost the part, because every worker computes the same result.
        """
        return self._set(_undone(part), result=result, token=None)

    def release(self, part: Part) -> None:
        """Release a part without a result."""
        self._set(_holding(part), token=None)

    def results(self, owner: str, request_key: str) -> list[dict[str, Any]]:
        """Results of the parts that are done, sorted by number."""
        done = select(PartRow.result).where(*_of(owner, request_key), PartRow.result.is_not(None))
        return [dict(one) for one in self._database.all(done.order_by(PartRow.number)) if one]

    def _set(self, conditions: Sequence[Any], **values: Any) -> bool:
        return bool(self._database.change(update(PartRow).where(and_(*conditions)).values(**values)))


def _of(owner: str, request_key: str) -> list[ColumnElement[bool]]:
    return [PartRow.owner == owner, PartRow.request_key == request_key]


def _undone(part: Part) -> list[Any]:
    this = [*_of(part.owner, part.request_key), PartRow.number == part.number]
    return [*this, PartRow.result.is_(None)]


def _holding(part: Part) -> list[Any]:
    return [*_undone(part), PartRow.token == part.token]
