"""Finds the one PSF that meets filters or fits the header of an image, and says why it was chosen. If no PSF or several
PSFs fit, the error says why.

If the PSFs of a series may be interpolated, and the time of an image is between the ranges of two PSFs, the search also
finds these two PSFs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from pydantic import BaseModel, Field

from psfcore.errors import DataError
from psfcore.fits.header import HeaderJson
from psfcore.instruments.psf_statements import version_text
from psfcore.instruments.unknown import SuitedPsf, agreement, unknown_instrument
from psfcore.instruments.unknown import channel_of as channel_of_image
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.contexts import NOW, Ends
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import ImageRow, PsfContextRow, PsfRow
from workers.contract.identities import instrument_of_build
from workers.contract.requests import Deconvolve, PsfInterpolate, ResolvedDeconvolve
from workers.versions import (
    TOTAL,
    UPLOADED,
    PsfStatus,
    channel_of,
    instrument_of,
    interpolated_name,
    interpolated_time,
    iso,
    seconds,
    series_of,
    variant_for,
    without_variant,
)

MOST_NAMED = 20
MOST_SEARCHED = 500


@dataclass(frozen=True)
class SearchResult:
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
        missing = f"{self.emptied_by} {given[self.emptied_by]}" if self.emptied_by else "any property"
        among = f"no PSF with {_joined(before)}" if before else "no PSF"
        between = ""
        if self.ends is not None:
            between = (
                f"; a deconvolution of the image interpolates between PSF {self.ends.before_psf_id} and PSF "
                f"{self.ends.after_psf_id}"
            )
        return f"expected one PSF with {self._said()}; {among} has {missing}{between}"

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


def look(catalogue: Catalogue, wanted: PsfFilter, owner: str, context: str | None) -> SearchResult:
    """The PSFs that meet the filters. Raises ``DataError`` "no-such-context".

    If there is no context, and the filters name no status, only certified PSFs are searched.

    Parameters
    ----------
    context
        An id, a name or "now"; None: the owner's default context.
    """
    return _look(catalogue, wanted, owner, catalogue.contexts.for_request(context, owner))


def _look(catalogue: Catalogue, wanted: PsfFilter, owner: str, pinned: PsfContextRow | None) -> SearchResult:
    if pinned is not None:
        wanted = replace(wanted, context_id=pinned.id)
    elif wanted.status is None:
        wanted = replace(wanted, status=PsfStatus.CERTIFIED)
    psfs = catalogue.psfs.page(wanted, owner, limit=MOST_NAMED + 1)
    return SearchResult(wanted, pinned, psfs, None if psfs else catalogue.psfs.emptied_by(wanted, owner))


def look_for_image(
    catalogue: Catalogue, header: HeaderJson, owner: str, context: str | None, kind: str = TOTAL
) -> SearchResult:
    """The PSFs for the instrument, channel and time of an image.

    If the channel has variants, the filter and the plate scale in the header choose the variant.

    Parameters
    ----------
    header
        The header summary that is stored with the upload.
    context
        An id, a name or "now"; None: the owner's default context.

    Raises
    ------
    DataError
        "no-instrument", "no-date", "no-such-context" or "several-variants-fit".
    """
    pinned = catalogue.contexts.for_request(context, owner)
    instrument, channel = _seen_as(catalogue, header, owner, pinned, kind)
    if instrument is None:
        raise DataError(
            "no-instrument",
            "expected DETECTOR or INSTRUME in the image's header; got neither: name the PSF in the request",
        )
    return _look_at_time_of(header, PsfFilter(instrument, channel, kind), catalogue, owner, pinned)


def _look_at_time_of(
    header: HeaderJson,
    wanted: PsfFilter,
    catalogue: Catalogue,
    owner: str,
    pinned: PsfContextRow | None,
) -> SearchResult:
    """The PSFs of a series at the time of an image. Raises ``DataError`` "no-date"."""
    try:
        at = seconds(header["date_obs"] or "")
    except DataError:  # the keyword contains a text that is not a time; a missing time is reported below
        at = None
    found = _look(catalogue, replace(wanted, valid_at=at), owner, pinned)
    if at is None and any((psf.valid_from, psf.valid_to) != (-math.inf, math.inf) for psf in found.psfs):
        raise DataError(
            "no-date",
            f"expected DATE-BEG or DATE-OBS in the image's header, in the form 2024-03-01T12:00:00, because PSFs of "
            f"{wanted.series or wanted.instrument} are valid only for some times; got {header['date_obs']!r}: "
            "name the PSF in the request",
        )
    if at is None or found.psfs or wanted.kind != TOTAL:
        return found
    series = series_of(wanted.instrument, wanted.channel, TOTAL)
    assert series is not None
    return replace(found, ends=catalogue.series.ends(series, at, owner, found.wanted.context_id))


def picked_for_image(
    catalogue: Catalogue, header: HeaderJson, owner: str, context: str | None
) -> SearchResult | None:
    """Find the PSF for an image if the request names no PSF; None if the series of the image has no certified PSF.

    Raises the same ``DataError`` as ``look_for_image``, and "no-psf-fits" if the series has PSFs, but the context
    contains none of them.
    """
    pinned = catalogue.contexts.for_request(context, owner)
    instrument, channel = _seen_as(catalogue, header, owner, pinned, TOTAL)
    series = series_of(instrument, channel, TOTAL)
    wanted = PsfFilter(instrument, channel, TOTAL)
    if series is not None and pinned is not None and catalogue.contexts.any_pinned(pinned.id, series, owner):
        return _look_at_time_of(header, wanted, catalogue, owner, pinned)
    certified = series is not None and catalogue.psfs.any_certified(series, owner)
    if pinned is not None and (certified or context is not None):
        raise DataError(
            "no-psf-fits",
            f"expected context {pinned.name} to pin a PSF of {series or 'an instrument'}; it pins none: name a PSF, or "
            f"use context {NOW!r} for the PSFs that are certified now",
        )
    return _look_at_time_of(header, wanted, catalogue, owner, pinned) if certified else None


def seen_through(header: HeaderJson) -> tuple[str | None, str | None]:
    """The instrument and the channel of an image, from the header summary that is stored with the upload."""
    instrument = instrument_of(header)
    return instrument, channel_of(instrument, header["wavelnth"])


def _seen_as(
    catalogue: Catalogue, header: HeaderJson, owner: str, pinned: PsfContextRow | None, kind: str
) -> tuple[str | None, str | None]:
    """The instrument and the channel of an image, with the variant of the channel to which the image belongs, if any.

    Raises ``DataError`` "several-variants-fit".
    """
    instrument, channel = seen_through(header)
    if instrument is None or channel is None:
        return instrument, channel
    known = catalogue.series.variants(instrument, channel, kind, owner, None if pinned is None else pinned.id)
    return instrument, variant_for(header["cards"], known) or channel


def _joined(given: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in given.items())


class ChosenPsf(BaseModel):
    """The PSF that a deconvolution would use."""

    id: str
    name: str
    version: str = Field(
        description="version of the PSF; if it is not built yet: the version that it will have"
    )
    status: str | None = Field(description="draft, certified or deprecated; null: the PSF is not built yet")
    why: str = Field(description="a sentence that says why this PSF was chosen")


def reasoned_psf(
    wanted: Deconvolve, resolved: ResolvedDeconvolve, catalogue: Catalogue, owner: str
) -> ChosenPsf:
    """The PSF that was chosen for a request, with a sentence that says why.

    Parameters
    ----------
    wanted
        The parameters of the request.
    resolved
        The same parameters after ``workers.intake.requests.resolve``.
    """
    row = catalogue.get(PsfRow, resolved.psf_id, owner)
    if row is not None:
        why = _why(wanted, resolved, row, catalogue, owner)
        return ChosenPsf(id=row.id, name=row.name, version=row.version, status=row.status, why=why)
    if resolved.psf_interpolation is not None:
        before = catalogue.get(PsfRow, resolved.psf_interpolation.before_psf_id, owner)
        assert before is not None  # resolve() has found it
        name, version = interpolated_name(before.instrument, resolved.psf_id)
        why = _why_interpolated(resolved.psf_interpolation, catalogue, owner) + "; the job makes it first."
    else:
        # resolve() has found the image and the PSF, or the recipe of the PSF
        assert resolved.psf_recipe is not None
        instrument = instrument_of_build(resolved.psf_recipe)
        name = instrument.name
        version = version_text(instrument.version, instrument.status, resolved.psf_id)
        why = _why_built(wanted, catalogue, owner) + "; the job builds it first."
    return ChosenPsf(id=resolved.psf_id, name=name, version=version, status=None, why=why)


def _why(
    wanted: Deconvolve, resolved: ResolvedDeconvolve, row: PsfRow, catalogue: Catalogue, owner: str
) -> str:
    if wanted.psf_id is not None:
        return "The request names this PSF."
    if resolved.psf_interpolation is not None:
        return _why_interpolated(resolved.psf_interpolation, catalogue, owner) + "."
    if resolved.psf_recipe is not None:
        return _why_built(wanted, catalogue, owner) + "."
    seen = f"the images of {row.series} at the time of this image"
    if resolved.context_id is None:
        return f"This PSF is certified for {seen}."
    which = "The default context" if wanted.context is None else "Context"
    return f"{which} {catalogue.contexts.named(resolved.context_id, owner).name} pins this PSF for {seen}."


def _why_interpolated(interpolation: PsfInterpolate, catalogue: Catalogue, owner: str) -> str:
    said = []
    for psf_id, until in ((interpolation.before_psf_id, "until"), (interpolation.after_psf_id, "from")):
        row = catalogue.get(PsfRow, psf_id, owner)
        named = psf_id[:12] if row is None else f"{psf_id[:12]} ({row.name} {row.version})"
        said.append(
            f"PSF {named}, which holds {until} "
            f"{interpolation.before_time if until == 'until' else interpolation.after_time}"
        )
    return f"This PSF is interpolated to {interpolation.time}, between {said[0]}, and {said[1]}"


def _why_built(wanted: Deconvolve, catalogue: Catalogue, owner: str) -> str:
    image = catalogue.get(ImageRow, wanted.image_id, owner)
    series = None if image is None else series_of(*seen_through(image.summary), TOTAL)
    return (
        f"No PSF of {series or 'this instrument'} is certified, so the PSF is built from the instrument file that "
        "heliopsf ships"
    )


def no_psf(catalogue: Catalogue, header: HeaderJson, owner: str) -> DataError:
    """The error "no-psf-for-instrument" for an image with this header summary.

    The error has these fields: `image` is the name of the telescope. `instruments` are the instruments whose PSF can
    be built, sorted by how well they agree with the image. `psfs` are PSFs of the catalogue that could fit. `ways`
    are the possible next steps. In both lists, `same` names the properties that agree with the image; `told` also
    says which properties differ.
    """
    return unknown_instrument(header, list(_candidates(catalogue, header, owner)))


def _candidates(catalogue: Catalogue, header: HeaderJson, owner: str) -> Iterator[SuitedPsf]:
    """At most MOST_NAMED PSFs of the same telescope or plate scale, newest first.

    PSFs of other channels are left out.
    """
    image_channel = channel_of_image(None, header["wavelnth"])
    found = 0
    for row in catalogue.psfs.page(PsfFilter(), owner, limit=MOST_SEARCHED):
        scale = row.details.get("plate_scale_arcsec")
        channel = None if row.channel is None else without_variant(row.channel)
        same, told = agreement(row.instrument, channel, scale, header)
        other_channel = image_channel is not None and channel is not None and channel != image_channel
        usable = row.kind in (TOTAL, UPLOADED) and row.status != PsfStatus.DEPRECATED
        if not usable or other_channel or not {"telescope", "plate_scale"} & set(same):
            continue
        yield {
            "id": row.id,
            "name": row.name,
            "version": row.version,
            "status": row.status,
            "instrument": row.instrument,
            "channel": row.channel,
            "same": same,
            "told": told,
        }
        found += 1
        if found == MOST_NAMED:
            return
