"""PSFs in the catalogue: find them by their properties and validity, certify and deprecate them.

A change of status takes a lock before it reads the other PSFs of the series, and holds it until the change is written.
On PostgreSQL, this is a lock on the row of the series; on SQLite, it is the write lock of the database. If two changes
conflict, the second one therefore sees the first one and is refused.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from sqlalchemy import Select, String, cast, select
from sqlalchemy.orm import Session

from psfcore.errors import DataError
from workers.catalogue.database import Queries, insert_into, newest_first
from workers.catalogue.tables import PsfChangeRow, PsfPinRow, PsfRow, PsfSeriesRow
from workers.contract.psf_status import MOST_REASON, StatusChange
from workers.versions import (
    INTERPOLATED,
    UPLOADED,
    PsfStatus,
    Validity,
    check_transition,
    check_version,
    is_variant_of,
    series_of,
)


@dataclass(frozen=True)
class PsfFilter:
    """The filters of a search for PSFs; None: any value."""

    instrument: str | None = None
    channel: str | None = None
    kind: str | None = None
    name: str | None = None
    version: str | None = None
    context_id: str | None = None
    status: str | None = None
    valid_at: float | None = None

    @property
    def series(self) -> str | None:
        """The series, if instrument, channel and kind are all given; otherwise None."""
        whole = self.instrument and self.channel and self.kind
        return series_of(self.instrument, self.channel, self.kind or "") if whole else None


class Psfs(Queries):
    """Searches for PSFs and changes of their status."""

    def describe(self, psf_id: str, owner: str, *, tables_sha256: str, preview_sha256: str) -> None:
        """Store the hashes of the tables and of the picture that were made from a PSF's file."""
        with self._database.writing.begin() as session:
            row = session.get(PsfRow, (owner, psf_id), with_for_update=True)
            if row is not None:
                row.details = {**row.details, "tables_sha256": tables_sha256}
                row.preview_sha256 = preview_sha256

    # Searches -----------------------------------------------------------------------------------------

    def page(
        self, filters: PsfFilter, owner: str, *, limit: int, after: tuple[float, str] | None = None
    ) -> Sequence[PsfRow]:
        """A page of PSFs, newest first.

        Parameters
        ----------
        after
            (created_at, id) of the last row of the previous page; None for the first page.
        """
        return self._database.all(
            newest_first(_query(filters, owner), (PsfRow.created_at, PsfRow.id), limit, after)
        )

    def emptied_by(self, filters: PsfFilter, owner: str) -> str | None:
        """Apply the filters one by one; return the name of the first filter after which no PSF is left, or None."""
        applied = PsfFilter()
        for name, value in vars(filters).items():
            if value is not None:
                applied = replace(applied, **{name: value})
                if not self.page(applied, owner, limit=1):
                    return name.removesuffix("_id")
        return None

    def any_certified(self, series: str, owner: str) -> bool:
        """Whether the series has a certified PSF."""
        return self._database.any(_certified_of(series, owner))

    # Status -------------------------------------------------------------------------------------------

    def changes(self, psf_id: str, owner: str) -> Sequence[PsfChangeRow]:
        """The changes of a PSF's status, oldest first."""
        query = select(PsfChangeRow).where(PsfChangeRow.owner == owner, PsfChangeRow.psf_id == psf_id)
        return self._database.all(query.order_by(PsfChangeRow.number))

    def released(self, series: str, owner: str) -> Sequence[str]:
        """The versions under which PSFs of a series were certified."""
        return self._database.all(_released(series, owner))

    def change(self, psf_id: str, owner: str, change: StatusChange, by: str) -> PsfRow:
        """Change the status of a PSF.

        The request certifies a draft, changes the range of a certified PSF, deprecates a certified PSF, or names the
        successor of a deprecated PSF.

        Raises ``DataError`` and changes nothing: "no-such-psf", "no-line", "line-known", "wrong-transition",
        "not-of-this-change", "ranges-overlap", "not-to-supersede", "no-such-successor", "successor-named",
        "changed-meanwhile", and the errors of ``check_version``.
        """
        with self._database.writing.begin() as session:
            row = existing_psf(session, psf_id, owner)
            series, _ = _series(row, change)
            # Lock the series until the transaction ends. On SQLite the transaction already holds the write lock.
            line = insert_into(session, PsfSeriesRow).values(owner=owner, series=series)
            session.execute(line.on_conflict_do_nothing())
            session.get(PsfSeriesRow, (owner, series), with_for_update=True)
            row = existing_psf(session, psf_id, owner, lock=True)  # it may have been deleted meanwhile
            now, columns = _series(row, change)
            if now != series:
                raise DataError(
                    "changed-meanwhile",
                    f"another request just put PSF {psf_id} in another series: send this request again",
                )
            before = PsfStatus(row.status)
            check_transition(before, change.status)
            if change.status == PsfStatus.CERTIFIED:
                _certify(session, row, series, columns, change, by)
            else:
                _deprecate(session, row, change, by)
            return row


def _query(filters: PsfFilter, owner: str) -> Select[PsfRow]:
    """A query for the PSFs that meet the filters, unsorted.

    A context has few PSFs, and few PSFs are valid at one time. Therefore a subquery finds these PSFs first. The
    subquery is DISTINCT, because otherwise SQLite reads all PSFs in the order of the list until it finds the PSFs of
    the context.
    """
    query = select(PsfRow).where(PsfRow.owner == owner)
    if filters.context_id is not None:
        query = query.join(pinned := _pinned(filters, owner).subquery(), PsfRow.id == pinned.c.psf_id)
    elif filters.valid_at is not None:
        query = query.join(latest := _latest_from(filters, owner).subquery(), PsfRow.id == latest.c.psf_id)
        query = query.where(PsfRow.valid_to > filters.valid_at)
    # If the series is known, it replaces instrument, channel and kind, because the indexes begin with the series.
    whole = ("series",) if filters.series is not None else ("instrument", "channel", "kind")
    for name in (*whole, "name", "version", "status"):
        value = getattr(filters, name)
        if value is not None:
            query = query.where(getattr(PsfRow, name) == value)
    return query


def _pinned(filters: PsfFilter, owner: str) -> Select[str]:
    """Ids of the PSFs that a context pins; if a time is given, only those that are pinned for that time."""
    query = select(PsfPinRow.psf_id).where(
        PsfPinRow.owner == owner, PsfPinRow.context_id == filters.context_id
    )
    if filters.series is not None:
        query = query.where(PsfPinRow.series == filters.series)
    if filters.valid_at is not None:
        query = query.where(PsfPinRow.valid_from <= filters.valid_at, PsfPinRow.valid_to > filters.valid_at)
    return query.distinct()  # a PSF may be pinned for several ranges


def _latest_from(filters: PsfFilter, owner: str) -> Select[str]:
    """For each series, the id of the certified PSF whose range begins last before ``filters.valid_at``.

    The ranges of a series do not overlap, so no other PSF of the series can be valid at that time.
    """
    latest = (
        select(PsfRow.id)
        .where(
            PsfRow.owner == PsfSeriesRow.owner,
            PsfRow.series == PsfSeriesRow.series,
            PsfRow.status == PsfStatus.CERTIFIED,
            PsfRow.valid_from <= filters.valid_at,
        )
        .order_by(PsfRow.valid_from.desc())
        .limit(1)
        .correlate(PsfSeriesRow)
        .scalar_subquery()
    )
    query = select(latest.label("psf_id")).distinct()
    query = query.select_from(PsfSeriesRow).where(PsfSeriesRow.owner == owner)
    if filters.series is not None:
        query = query.where(PsfSeriesRow.series == filters.series)
    elif filters.instrument is not None:
        query = query.where(PsfSeriesRow.series.startswith(f"{filters.instrument}/", autoescape=True))
    return query


def _certified_of(series: str, owner: str) -> Select[PsfRow]:
    """The certified PSFs of a series."""
    return select(PsfRow).where(
        PsfRow.owner == owner, PsfRow.series == series, PsfRow.status == PsfStatus.CERTIFIED
    )


def _released(series: str, owner: str) -> Select[str]:
    released = PsfRow.status.in_((PsfStatus.CERTIFIED, PsfStatus.DEPRECATED))
    return select(PsfRow.version).where(PsfRow.owner == owner, PsfRow.series == series, released)


def existing_psf(session: Session, psf_id: str, owner: str, *, lock: bool = False) -> PsfRow:
    """The row of a PSF. With ``lock``, the row is locked until the transaction ends. Raises ``DataError``
    "no-such-psf".
    """
    row = session.get(PsfRow, (owner, psf_id), populate_existing=lock, with_for_update=lock or None)
    if row is None:
        raise DataError(
            "no-such-psf",
            f"expected the id of a PSF in the catalogue; got {psf_id}, which is not in it: "
            "list the PSFs with `heliopsf psf list`",
        )
    return row


def _series(row: PsfRow, change: StatusChange) -> tuple[str, dict[str, str | None]]:
    """The series of a PSF, completed by the change, and the columns that form its name.

    Raises ``DataError`` "line-known" or "no-line".
    """
    draft = row.status == PsfStatus.DRAFT
    columns = {
        "instrument": row.instrument,
        "channel": row.channel,
        "kind": None if draft and row.kind == UPLOADED else row.kind,
    }
    for name, value in columns.items():
        new = getattr(change, name)
        if new is None or new == value:
            continue
        # The file may name the channel, and the request a variant of it.
        if value is not None and not (name == "channel" and draft and is_variant_of(new, value)):
            raise DataError(
                "line-known",
                f"{name}: expected {value!r}, which PSF {row.id} has and which cannot change; got {new!r}: leave it "
                "out",
            )
        columns[name] = new
    kind = columns["kind"] or row.kind
    series = series_of(columns["instrument"], columns["channel"], kind)
    if series is None:
        raise DataError(
            "no-line",
            f"expected an instrument, because the file of PSF {row.id} does not name one: give instrument, channel "
            "and kind",
        )
    return series, columns | {"kind": kind, "series": series}


def _certify(
    session: Session, row: PsfRow, series: str, columns: dict[str, str | None], change: StatusChange, by: str
) -> None:
    _refuse(change, "deprecation", successor=change.successor)
    version = row.version
    if row.status == PsfStatus.DRAFT:
        version = check_version(change.version, session.scalars(_released(series, row.owner)))
    elif change.version not in (None, row.version):
        raise DataError(
            "not-of-this-change",
            f"expected version {row.version}, because the version of a certified PSF cannot change; got "
            f"{change.version}: leave it out",
        )
    validity = change.validity or validity_of(row)
    for superseded_id in change.supersedes:
        superseded = session.get(PsfRow, (row.owner, superseded_id), with_for_update=True)
        if (
            superseded is None
            or superseded is row
            or superseded.series != series
            or superseded.status != PsfStatus.CERTIFIED
        ):
            raise DataError(
                "not-to-supersede",
                f"supersedes: expected certified PSFs of {series}; got {superseded_id}: leave it out",
            )
        _write(session, superseded, change.reason, by, status=PsfStatus.DEPRECATED, successor_id=row.id)
        _deprecate_interpolated(session, superseded, change.reason, by)
    session.flush()
    other = _overlapping(session, row, series, validity)
    if other is not None:
        raise DataError(
            "ranges-overlap",
            f"expected a range that overlaps with no certified PSF of {series}; got {validity}, which overlaps with "
            f"the range of PSF {other.id} ({other.name} {other.version}), {validity_of(other)}: deprecate that PSF, "
            "name it in `supersedes`, or change its range first",
        )
    validity_columns = {"valid_from": validity.start, "valid_to": validity.end}
    status_columns = {"status": PsfStatus.CERTIFIED, "version": version}
    _write(session, row, change.reason, by, **columns, **validity_columns, **status_columns)


def validity_of(row: PsfRow) -> Validity:
    """The range of times for which a PSF is valid; all times if the PSF has no range."""
    if row.valid_from is None or row.valid_to is None:
        return Validity()
    return Validity(row.valid_from, row.valid_to)


def _overlapping(session: Session, row: PsfRow, series: str, validity: Validity) -> PsfRow | None:
    """The certified PSF of the series whose range overlaps with ``validity``, or None.

    The ranges of the certified PSFs do not overlap each other. So it is enough to check the PSF whose range begins last
    before ``validity`` ends.
    """
    others = _certified_of(series, row.owner).where(PsfRow.id != row.id)
    query = others.where(PsfRow.valid_from < validity.end)
    last = session.scalars(query.order_by(PsfRow.valid_from.desc()).limit(1)).first()
    return last if last is not None and validity_of(last).overlaps(validity) else None


def _deprecate(session: Session, row: PsfRow, change: StatusChange, by: str) -> None:
    _refuse(
        change,
        "certification",
        version=change.version,
        validity=change.validity,
        supersedes=change.supersedes or None,
    )
    if row.status == PsfStatus.DEPRECATED and (row.successor_id is not None or change.successor is None):
        raise DataError(
            "successor-named",
            f"expected the successor of the deprecated PSF {row.id}; got none: name a certified PSF of its series"
            if row.successor_id is None
            else f"expected a deprecated PSF without a successor; PSF {row.id} has successor {row.successor_id}, "
            "which cannot change",
        )
    if change.successor is not None:
        successor = session.get(PsfRow, (row.owner, change.successor))
        if successor is None or successor.series != row.series or successor.status != PsfStatus.CERTIFIED:
            raise DataError(
                "no-such-successor",
                f"successor: expected a certified PSF of {row.series}; got {change.successor}"
                + (
                    ""
                    if successor is None
                    else f", which is {successor.status} and of {successor.series or 'no series'}"
                ),
            )
        if successor is row:
            raise DataError("no-such-successor", f"successor: expected a PSF other than {row.id} itself")
    before = row.status
    _write(session, row, change.reason, by, status=PsfStatus.DEPRECATED, successor_id=change.successor)
    if before != PsfStatus.DEPRECATED:
        _deprecate_interpolated(session, row, change.reason, by)


def _deprecate_interpolated(session: Session, end: PsfRow, reason: str, by: str) -> None:
    """Deprecate the drafts that were interpolated between a PSF, which is deprecated now, and another PSF.

    So their products are listed as affected. A PSF that somebody certified keeps its status.
    """
    query = select(PsfRow).where(
        PsfRow.owner == end.owner,
        PsfRow.origin == INTERPOLATED,
        PsfRow.status == PsfStatus.DRAFT,
        cast(PsfRow.details, String).contains(end.id),  # the details name the ends
    )
    why = f"it was interpolated from PSF {end.id[:12]}, which is deprecated" + (
        f": {reason}" if reason else ""
    )
    for row in session.scalars(query.order_by(PsfRow.id).with_for_update()).all():
        _write(session, row, why[:MOST_REASON], by, status=PsfStatus.DEPRECATED)


def _refuse(change: StatusChange, other: str, **given: object) -> None:
    for name, value in given.items():
        if value is not None:
            raise DataError(
                "not-of-this-change",
                f"{name}: expected this field only in a {other}; got it in a change to status {change.status}: leave "
                "the field out",
            )


def _write(session: Session, row: PsfRow, reason: str, by: str, **values: object) -> None:
    """Change the row of a PSF, and add the change to the PSF's history."""
    before, version_before = row.status, row.version
    for name, value in values.items():
        setattr(row, name, value)
    session.add(
        PsfChangeRow(
            owner=row.owner,
            psf_id=row.id,
            at=time.time(),
            by=by,
            status_before=before,
            status=row.status,
            version_before=version_before,
            version=row.version,
            valid_from=row.valid_from,
            valid_to=row.valid_to,
            successor_id=row.successor_id,
            reason=reason,
        )
    )
