"""Which PSFs requests use: series whose PSFs may be interpolated, and contexts.

A certified PSF holds in its range of observation times. Between the end of one range and the start of the next, no PSF
of the series is certified. If the series says so, the PSF of such a time is interpolated between the two PSFs. A
context is a named, fixed set of PSFs: the same lookup in a context always gives the same PSF.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from sqlalchemy import Select, exists, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from psfcore.errors import DataError
from workers.catalogue.database import Queries, begins_with, several_ids_fit
from workers.catalogue.psfs import existing_psf, validity_of
from workers.catalogue.tables import (
    DefaultContextRow,
    PsfContextRow,
    PsfPinRow,
    PsfRow,
    PsfSeriesRow,
    SeriesChangeRow,
)
from workers.contract.identities import canonical_hash
from workers.contract.psf_status import Pin
from workers.contract.requests import SHORT_ID
from workers.versions import SEPARATOR, TOTAL, PsfStatus, Validity, iso

NOW = "now"  # in place of a context's name: use the PSFs that are certified now, not the owner's default context
RESERVED = (NOW, "default")
NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$"  # shorter than an id, so a name is never read as an id
_ID = re.compile(r"[0-9a-f]{64}")
_SHORT_ID = re.compile(SHORT_ID)


@dataclass(frozen=True)
class Ends:
    """The two PSFs between which a time lies.

    Attributes
    ----------
    before_time
        The end of the range of the earlier PSF, in seconds since 1970.
    after_time
        The start of the range of the later PSF, in seconds since 1970.
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
        """The variants of a channel of which a PSF is certified, or pinned by a context: their channels, such as
        174-open_2.
        """
        table: type[PsfSeriesRow | PsfPinRow] = PsfSeriesRow if context_id is None else PsfPinRow
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
                    f"expected a series of total PSFs (instrument/channel/{TOTAL}), because images are deconvolved "
                    f"with these; got {series}: name the series of the total PSFs",
                )
            if may_interpolate(session, series, owner) == interpolated:
                return
            change = {"interpolated": interpolated, "at": time.time(), "by": by, "reason": reason}
            session.add(SeriesChangeRow(owner=owner, series=series, **change))

    def ends(self, series: str, at: float, owner: str, context_id: str | None) -> Ends | None:
        """The PSFs between which a time lies, if the series may be interpolated.

        Call this only for a time for which no PSF is valid.

        Parameters
        ----------
        at
            The time, in seconds since 1970.
        context_id
            The context whose pins are searched; None: the certified PSFs are searched.

        Returns
        -------
        Ends or None
            The two PSFs. None: the series may not be interpolated, or the time is not between two ranges.
        """
        with self._database.reading() as session:
            if context_id is None:
                if not may_interpolate(session, series, owner):
                    return None
                table: type[PsfRow | PsfPinRow] = PsfRow
                rows = select(PsfRow.id, PsfRow.valid_from, PsfRow.valid_to).where(
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
        if before is None or after is None:
            return None
        (before_id, _, before_end), (after_id, after_start, _) = before, after
        if before_end is None or after_start is None or before_end > at:
            return None
        return Ends(before_id, before_end, after_id, after_start)


def may_interpolate(session: Session, series: str, owner: str) -> bool:
    """Whether the PSFs of a series may be interpolated."""
    latest = session.scalars(_changes(series, owner).limit(1)).first()
    return latest is not None and latest.interpolated


def _changes(series: str, owner: str) -> Select[SeriesChangeRow]:
    """The changes of a series, latest first."""
    query = select(SeriesChangeRow).where(SeriesChangeRow.owner == owner, SeriesChangeRow.series == series)
    return query.order_by(SeriesChangeRow.number.desc())


def _check_known(session: Session, series: str, owner: str) -> None:
    if session.get(PsfSeriesRow, (owner, series)) is None:
        raise DataError(
            "no-such-series",
            f"expected a series of which a PSF was certified, as instrument/channel/kind; got {series!r:.140}: list "
            "the series with `heliopsf psf series`, or certify a PSF first",
        )


# Contexts -------------------------------------------------------------------------------------------


class Contexts(Queries):
    """The tables of contexts."""

    def create(
        self, name: str, owner: str, by: str, *, reason: str = "", pins: Sequence[Pin] | None = None
    ) -> tuple[PsfContextRow, bool]:
        """Create a context of these pins; if ``pins`` is None, of all certified PSFs.

        The context also keeps, for each series, whether its PSFs may be interpolated now.
        Returns the context, and whether it is new. If the name exists with the same pins, that context is returned.

        Raises ``DataError``: "bad-name", "name-taken", "no-such-psf", "no-line", "nothing-to-pin", "ranges-overlap".
        """
        if not re.fullmatch(NAME, name) or name in RESERVED:
            raise DataError(
                "bad-name",
                "expected a name of up to 63 letters, digits, full stops, underscores and hyphens, other than "
                f"{' and '.join(RESERVED)}; got {ascii(name)[:80]}",
            )
        try:
            with self._database.writing.begin() as session:
                rows = _pins_of_all(session, owner) if pins is None else _pins_of(session, owner, pins)
                for row in rows:
                    row.interpolated = may_interpolate(session, row.series, owner)
                context = _context(name, owner, by, reason, rows)
                session.add_all((context, *rows))
            return context, True
        except IntegrityError:
            existing = self.find(name, owner)
            if existing is None:
                raise
            if existing.id != context.id:
                raise DataError(
                    "name-taken",
                    f"expected a name that no other context has; {name} is the context {existing.id} with other PSFs "
                    "or other series that may be interpolated, and contexts never change: choose another name",
                ) from None
            return existing, False

    def find(self, id_or_name: str, owner: str) -> PsfContextRow | None:
        """The context with this id or name, or the only one whose id begins with these digits; else None.

        Raises ``DataError`` "several-ids-fit".
        """
        of_owner = select(PsfContextRow).where(PsfContextRow.owner == owner)
        if _ID.fullmatch(id_or_name):
            return self._database.row(PsfContextRow, (owner, id_or_name))
        named = self._database.first(of_owner.where(PsfContextRow.name == id_or_name))
        if named is not None or not _SHORT_ID.fullmatch(id_or_name):
            return named
        rows = self._database.all(of_owner.where(begins_with(PsfContextRow.id, id_or_name)).limit(6))
        if len(rows) > 1:
            raise several_ids_fit(id_or_name, [row.id for row in rows])
        return rows[0] if rows else None

    def named(self, id_or_name: str, owner: str) -> PsfContextRow:
        """The context with this id or name. Raises ``DataError`` "no-such-context" or "several-ids-fit"."""
        context = self.find(id_or_name, owner)
        if context is None:
            raise DataError(
                "no-such-context",
                f"expected the id or name of a context; got {id_or_name!r}, which does not exist: list the contexts",
            )
        return context

    def pins(self, context_id: str, owner: str) -> Sequence[PsfPinRow]:
        """The pins of a context, sorted by series and time."""
        query = select(PsfPinRow).where(PsfPinRow.owner == owner, PsfPinRow.context_id == context_id)
        return self._database.all(query.order_by(PsfPinRow.series, PsfPinRow.valid_from))

    def any_pinned(self, context_id: str, series: str, owner: str) -> bool:
        """Whether a context pins a PSF of the series."""
        query = select(PsfPinRow.psf_id).where(
            PsfPinRow.owner == owner, PsfPinRow.context_id == context_id, PsfPinRow.series == series
        )
        return self._database.any(query)

    # The default --------------------------------------------------------------------------------------

    def default(self, owner: str) -> PsfContextRow | None:
        """The owner's default context; None if the owner uses the PSFs that are certified now."""
        latest = self.default_changes(owner, limit=1)
        if not latest or latest[0].context_id is None:
            return None
        return self._database.row(PsfContextRow, (owner, latest[0].context_id))

    def set_default(self, id_or_name: str | None, owner: str, by: str, reason: str = "") -> None:
        """Set an owner's default context; None: use the PSFs that are certified now.

        Raises ``DataError`` "no-such-context".
        """
        context_id = None if id_or_name is None else self.named(id_or_name, owner).id
        row = DefaultContextRow(owner=owner, context_id=context_id, at=time.time(), by=by, reason=reason)
        with self._database.writing.begin() as session:
            session.add(row)

    def default_changes(self, owner: str, limit: int = 200) -> Sequence[DefaultContextRow]:
        """The changes of an owner's default context, latest first."""
        query = select(DefaultContextRow).where(DefaultContextRow.owner == owner)
        return self._database.all(query.order_by(DefaultContextRow.number.desc()).limit(limit))

    def for_request(self, context: str | None, owner: str) -> PsfContextRow | None:
        """The context for a request that gives an id, a name, NOW or None.

        For NOW, which means no context, returns None. For None, returns the owner's default context, or None if there
        is no default.
        """
        if context is None:
            return self.default(owner)
        return None if context == NOW else self.named(context, owner)


def _pins_of_all(session: Session, owner: str) -> list[PsfPinRow]:
    query = select(PsfRow).where(PsfRow.owner == owner, PsfRow.status == PsfStatus.CERTIFIED)
    rows = session.scalars(query.order_by(PsfRow.series, PsfRow.valid_from)).all()
    if not rows:
        raise DataError(
            "nothing-to-pin",
            "expected certified PSFs to pin; no PSF is certified yet: certify one first, or name the PSFs to pin",
        )
    return [_pin(row, None) for row in rows]


def _pins_of(session: Session, owner: str, pins: Sequence[Pin]) -> list[PsfPinRow]:
    if not pins:
        raise DataError(
            "nothing-to-pin",
            "expected at least one PSF to pin; got an empty list: name PSFs, or leave out the list to pin all "
            "certified PSFs",
        )
    rows = [_pin(existing_psf(session, pin.psf_id, owner), pin.validity) for pin in pins]
    rows.sort(key=lambda pinned: (pinned.series, pinned.valid_from))
    for one, other in pairwise(rows):
        first, second = Validity(one.valid_from, one.valid_to), Validity(other.valid_from, other.valid_to)
        if one.series == other.series and first.overlaps(second):
            raise DataError(
                "ranges-overlap",
                f"expected at most one PSF of {one.series} for any time; the ranges of PSF {one.psf_id}, {first}, "
                f"and PSF {other.psf_id}, {second}, overlap: leave one out, or pin it with a narrower range "
                "(valid_from, valid_to)",
            )
    return rows


def _pin(row: PsfRow, validity: Validity | None) -> PsfPinRow:
    if row.series is None:
        raise DataError(
            "no-line",
            f"expected PSFs with an instrument; PSF {row.id} has no instrument: certify it with an instrument first",
        )
    pinned = validity or validity_of(row)
    return PsfPinRow(
        owner=row.owner,
        series=row.series,
        valid_from=pinned.start,
        valid_to=pinned.end,
        psf_id=row.id,
        version=row.version,
    )


def _context(name: str, owner: str, by: str, reason: str, pins: Sequence[PsfPinRow]) -> PsfContextRow:
    """Make the row of a context, and write the context's id into the rows of its pins."""
    content = []
    for pin in pins:
        one = [pin.series, iso(pin.valid_from), iso(pin.valid_to), pin.psf_id]
        # The word is a part of the id only where it is needed, so that all other contexts keep their ids.
        content.append([*one, "interpolated"] if pin.interpolated else one)
    identity = canonical_hash({"name": name, "pins": content})
    for pin in pins:
        pin.context_id = identity
    return PsfContextRow(
        owner=owner,
        id=identity,
        name=name,
        created_at=time.time(),
        created_by=by,
        reason=reason,
        pins=len(pins),
    )
