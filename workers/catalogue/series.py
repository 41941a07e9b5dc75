"""Series whose PSFs may be interpolated, and the two PSFs between which a time lies.

A certified PSF holds in its range of observation times. Between the end of one range and the start of the next, no PSF of
the series is certified. If the series says so, the PSF of such a time is interpolated between the two PSFs.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, exists, select
from sqlalchemy.orm import Session

from psfcore.errors import DataError
from workers.catalogue.database import Queries
from workers.catalogue.tables import PsfPinRow, PsfRow, PsfSeriesRow, SeriesChangeRow
from workers.versions import SEPARATOR, TOTAL, PsfStatus


@dataclass(frozen=True)
class Ends:
    """The two PSFs between which a time lies.

    before_time: the end of the range of the earlier PSF. after_time: the start of the range of the later PSF. Both in
    seconds since 1970.
    """

    before_psf_id: str
    before_time: float
    after_psf_id: str
    after_time: float


class Series(Queries):
    """Series of which a PSF was certified."""

    def all(self, owner: str) -> dict[str, bool]:
        """All series of which a PSF was certified, sorted by name: whether the PSFs of each may be interpolated."""
        latest = (
            select(SeriesChangeRow.interpolated)
            .where(SeriesChangeRow.owner == PsfSeriesRow.owner, SeriesChangeRow.series == PsfSeriesRow.series)
            .order_by(SeriesChangeRow.number.desc())
            .limit(1)
            .scalar_subquery()
        )
        query = select(PsfSeriesRow.series, latest).where(PsfSeriesRow.owner == owner)
        query = query.order_by(PsfSeriesRow.series)
        return {series: bool(allowed) for series, allowed in self._database.lines(query)}

    def variants(
        self, instrument: str, channel: str, kind: str, owner: str, context_id: str | None
    ) -> list[str]:
        """The variants of a channel of which a PSF is certified, or pinned by a context: their channels, such as 174-open_2."""
        table: Any = PsfSeriesRow if context_id is None else PsfPinRow
        start, end = f"{instrument}/{channel}{SEPARATOR}", f"/{kind}"
        certified = exists().where(
            PsfRow.owner == PsfSeriesRow.owner,
            PsfRow.series == PsfSeriesRow.series,
            PsfRow.status == PsfStatus.CERTIFIED,
        )
        query = select(table.series).where(
            table.owner == owner,
            certified if context_id is None else PsfPinRow.context_id == context_id,
            table.series.startswith(start, autoescape=True),
            table.series.endswith(end, autoescape=True),
        )
        return sorted(series.split("/")[1] for series in self._database.all(query.distinct()))

    def changes(self, series: str, owner: str, limit: int = 200) -> Sequence[SeriesChangeRow]:
        """The changes of a series, latest first. Raises ``DataError`` "no-such-series"."""
        with self._database.reading() as session:
            _check_known(session, series, owner)
            return session.scalars(_changes(series, owner).limit(limit)).all()

    def set_interpolated(
        self, series: str, owner: str, interpolated: bool, by: str, reason: str = ""
    ) -> None:
        """Say whether the PSFs of a series may be interpolated. If this changes nothing, no change is recorded.

        Raises ``DataError`` "no-such-series" or "series-not-total".
        """
        with self._database.writing.begin() as session:
            _check_known(session, series, owner)
            if series.rpartition("/")[2] != TOTAL:
                raise DataError(
                    "series-not-total",
                    f"expected a series of total PSFs (instrument/channel/{TOTAL}), because images are deconvolved with these; "
                    f"got {series}: name the series of the total PSFs",
                )
            if may_interpolate(session, series, owner) == interpolated:
                return
            change = {"interpolated": interpolated, "at": time.time(), "by": by, "reason": reason}
            session.add(SeriesChangeRow(owner=owner, series=series, **change))

    def ends(self, series: str, at: float, owner: str, context_id: str | None) -> Ends | None:
        """The PSFs between which a time lies, if the series may be interpolated.

        context_id: search the pins of this context instead of the certified PSFs. None: the series may not be
        interpolated, or the time is not between two ranges. Call this only for a time for which no PSF is valid.
        """
        with self._database.reading() as session:
            if context_id is None:
                if not may_interpolate(session, series, owner):
                    return None
                table: Any = PsfRow
                rows: Any = select(PsfRow.id, PsfRow.valid_from, PsfRow.valid_to).where(
                    PsfRow.status == PsfStatus.CERTIFIED
                )
            else:
                table = PsfPinRow
                rows = select(PsfPinRow.psf_id, PsfPinRow.valid_from, PsfPinRow.valid_to).where(
                    PsfPinRow.context_id == context_id, PsfPinRow.interpolated
                )
            rows = rows.where(table.owner == owner, table.series == series)
            starts = table.valid_from
            before = session.execute(rows.where(starts <= at).order_by(starts.desc()).limit(1)).first()
            after = session.execute(rows.where(starts > at).order_by(starts).limit(1)).first()
        if before is None or after is None or before[2] > at:
            return None
        return Ends(before[0], before[2], after[0], after[1])


def may_interpolate(session: Session, series: str, owner: str) -> bool:
    """Whether the PSFs of a series may be interpolated."""
    latest = session.scalars(_changes(series, owner).limit(1)).first()
    return latest is not None and latest.interpolated


def _changes(series: str, owner: str) -> Select[Any]:
    """The changes of a series, latest first."""
    query = select(SeriesChangeRow).where(SeriesChangeRow.owner == owner, SeriesChangeRow.series == series)
    return query.order_by(SeriesChangeRow.number.desc())


def _check_known(session: Session, series: str, owner: str) -> None:
    if session.get(PsfSeriesRow, (owner, series)) is None:
        raise DataError(
            "no-such-series",
            f"expected a series of which a PSF was certified, as instrument/channel/kind; got {series!r:.140}: list the series "
            "with `heliopsf psf series`, or certify a PSF first",
        )
