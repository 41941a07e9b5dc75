"""Finds the one PSF that meets filters or fits the header of an image. If no PSF or several PSFs fit, the error says
why.

If the PSFs of a series may be interpolated, and the time of an image is between the ranges of two PSFs, the search also
finds these two PSFs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from psfcore.errors import DataError
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.contexts import NOW
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.series import Ends
from workers.catalogue.tables import PsfContextRow, PsfRow
from workers.contract.requests import PsfInterpolate
from workers.versions import (
    TOTAL,
    PsfStatus,
    channel_of,
    instrument_of,
    interpolated_time,
    iso,
    seconds,
    series_of,
    variant_for,
)

MOST_NAMED = 20


@dataclass(frozen=True)
class Found:
    """The result of a search for one PSF."""

    wanted: PsfFilter
    context: PsfContextRow | None  # None: all PSFs were searched
    psfs: Sequence[PsfRow]  # at most MOST_NAMED + 1 PSFs
    emptied_by: str | None  # the first filter after which no PSF was left; None if PSFs were found
    ends: Ends | None = None  # the PSFs between which the PSF of an image may be interpolated

    @property
    def interpolation(self) -> PsfInterpolate | None:
        """How the PSF of the image is interpolated, at its rounded time; None if it is not interpolated."""
        ends, at = self.ends, self.wanted.valid_at
        if ends is None or at is None:
            return None
        time = interpolated_time(ends.before_time, ends.after_time, at)
        return PsfInterpolate(
            before_psf_id=ends.before_psf_id,
            before_time=iso(ends.before_time) or "",
            after_psf_id=ends.after_psf_id,
            after_time=iso(ends.after_time) or "",
            time=iso(time) or "",
        )

    def one(self) -> PsfRow:
        """The PSF. Raises ``DataError`` "no-psf-fits" or "several-psfs-fit"."""
        if len(self.psfs) == 1:
            return self.psfs[0]
        if self.psfs:
            named = [f"{psf.id} ({psf.name} {psf.version}, {psf.status})" for psf in self.psfs[:MOST_NAMED]]
            more = ", and more" if len(self.psfs) > MOST_NAMED else ""
            raise DataError(
                "several-psfs-fit",
                f"expected one PSF with {self._said()}; got {'; '.join(named)}{more}: add another filter",
            )
        raise DataError("no-psf-fits", self._why_none())

    def _why_none(self) -> str:
        given = self._given()
        before = dict(list(given.items())[: list(given).index(self.emptied_by)]) if self.emptied_by else given
        asked = f"{self.emptied_by} {given[self.emptied_by]}" if self.emptied_by else "any property"
        among = f"no PSF with {_joined(before)}" if before else "no PSF"
        between = ""
        if self.ends is not None:
            between = (
                f"; a deconvolution of the image interpolates between PSF {self.ends.before_psf_id} and PSF "
                f"{self.ends.after_psf_id}"
            )
        return f"expected one PSF with {self._said()}; {among} has {asked}{between}"

    def _said(self) -> str:
        return _joined(self._given()) or "no filter"

    def _given(self) -> dict[str, str]:
        """The given filters as text for messages, in the order in which they are applied."""
        wanted = self.wanted
        at = wanted.valid_at
        said = {
            "instrument": wanted.instrument,
            "channel": wanted.channel,
            "kind": wanted.kind,
            "name": wanted.name,
            "version": wanted.version,
            "context": None if self.context is None else self.context.name,
            "status": wanted.status,
            "valid_at": None if at is None else iso(at),
        }
        return {name: value for name, value in said.items() if value is not None}


def look(catalogue: Catalogue, wanted: PsfFilter, owner: str, context: str | None) -> Found:
    """The PSFs that meet the filters. context: an id, a name or "now"; None: the owner's default context.

    If there is no context, and the filters name no status, only certified PSFs are searched.

    Raises ``DataError`` "no-such-context".
    """
    pinned = catalogue.contexts.asked_for(context, owner)
    if pinned is not None:
        wanted = replace(wanted, context_id=pinned.id)
    elif wanted.status is None:
        wanted = replace(wanted, status=PsfStatus.CERTIFIED)
    psfs = catalogue.psfs.page(wanted, owner, limit=MOST_NAMED + 1)
    return Found(wanted, pinned, psfs, None if psfs else catalogue.psfs.emptied_by(wanted, owner))


def look_for_image(
    catalogue: Catalogue, header: Mapping[str, Any], owner: str, context: str | None, kind: str = TOTAL
) -> Found:
    """The PSFs for the instrument, channel and time of an image. header: the header summary that is stored with the upload.

    If the channel has variants, the filter and the plate scale in the header choose the variant.
    Raises ``DataError`` "no-instrument", "no-date", "no-such-context" or "several-variants-fit".
    """
    instrument, channel = _seen_as(catalogue, header, owner, context, kind)
    if instrument is None:
        raise DataError(
            "no-instrument",
            "expected DETECTOR or INSTRUME in the image's header; got neither: name the PSF in the request",
        )
    at = _observed_at(header)
    found = look(catalogue, PsfFilter(instrument, channel, kind, valid_at=at), owner, context)
    if at is None and any(not _always(psf) for psf in found.psfs):
        raise DataError(
            "no-date",
            f"expected DATE-BEG or DATE-OBS in the image's header, in the form 2024-03-01T12:00:00, because PSFs of "
            f"{series_of(instrument, channel, kind)} are valid only for some times; got {header['date_obs']!r}",
        )
    if at is None or found.psfs or kind != TOTAL:
        return found
    series = series_of(instrument, channel, kind)
    assert series is not None
    context_id = None if found.context is None else found.context.id
    return replace(found, ends=catalogue.series.ends(series, at, owner, context_id))


def picked_for_image(
    catalogue: Catalogue, header: Mapping[str, Any], owner: str, context: str | None
) -> Found | None:
    """Find the PSF for an image if the request names no PSF; None if the series of the image has no certified PSF.

    Raises the same ``DataError`` as ``look_for_image``, and "no-psf-fits" if the series has PSFs, but the context contains none of them.
    """
    instrument, channel = _seen_as(catalogue, header, owner, context, TOTAL)
    series = series_of(instrument, channel, TOTAL)
    pinned = catalogue.contexts.asked_for(context, owner)
    if series is not None and pinned is not None and catalogue.contexts.any_pinned(pinned.id, series, owner):
        return look_for_image(catalogue, header, owner, context)
    certified = series is not None and catalogue.psfs.any_certified(series, owner)
    if pinned is not None and (certified or context is not None):
        raise DataError(
            "no-psf-fits",
            f"expected context {pinned.name} to pin a PSF of {series or 'an instrument'}; it pins none: name a PSF, or "
            f"use context {NOW!r} for the PSFs that are certified now",
        )
    return look_for_image(catalogue, header, owner, context) if certified else None


def seen_through(header: Mapping[str, Any]) -> tuple[str | None, str | None]:
    """The instrument and the channel of an image. header: the header summary that is stored with the upload."""
    instrument = instrument_of(header)
    return instrument, channel_of(instrument, header["wavelnth"])


def _seen_as(
    catalogue: Catalogue, header: Mapping[str, Any], owner: str, context: str | None, kind: str
) -> tuple[str | None, str | None]:
    """The instrument and the channel of an image, with the variant of the channel to which the image belongs, if any.

    Raises ``DataError`` "no-such-context" or "several-variants-fit".
    """
    instrument, channel = seen_through(header)
    if instrument is None or channel is None:
        return instrument, channel
    pinned = catalogue.contexts.asked_for(context, owner)
    known = catalogue.series.variants(instrument, channel, kind, owner, None if pinned is None else pinned.id)
    return instrument, variant_for(header["cards"], known) or channel


def _observed_at(header: Mapping[str, Any]) -> float | None:
    try:
        return seconds(header["date_obs"] or "")
    except DataError:  # the keyword contains a text that is not a time; the caller reports a missing time
        return None


def _always(psf: PsfRow) -> bool:
    return psf.valid_from == -math.inf and psf.valid_to == math.inf


def _joined(given: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in given.items())
