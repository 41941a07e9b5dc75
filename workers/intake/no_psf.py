"""The error for an image whose PSF is not known, with the PSFs of the catalogue that could fit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names
from psfcore.instruments.unknown import agreement_with_image, channel_of, same_as_image, unknown_instrument
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import PsfRow
from workers.versions import TOTAL, UPLOADED, PsfStatus, without_variant

MOST_NAMED = 20
MOST_SEARCHED = 500


def no_psf(catalogue: Catalogue, header: Mapping[str, Any], owner: str) -> DataError:
    """The error "no-psf-for-instrument" for an image with this header summary.

    The error has these fields: `image` is the name of the telescope. `instruments` are the instruments whose PSF can
    be built, sorted by how well they agree with the image. `psfs` are PSFs of the catalogue that could fit. `ways`
    are the possible next steps. In both lists, `same` names the properties that agree with the image; `told` also
    says which properties differ.
    """
    return unknown_instrument(header, list(_candidates(catalogue, header, owner)))


def _candidates(catalogue: Catalogue, header: Mapping[str, Any], owner: str) -> Iterator[dict[str, Any]]:
    """At most MOST_NAMED PSFs of the same telescope or plate scale, newest first.

    PSFs of other channels are left out.
    """
    wanted = channel_of(None, header["wavelnth"])
    found = 0
    for row in catalogue.psfs.page(PsfFilter(), owner, limit=MOST_SEARCHED):
        scale = row.details.get("plate_scale_arcsec")
        channel = None if row.channel is None else without_variant(row.channel)
        same = same_as_image(row.instrument, channel, scale, header)
        other_channel = wanted is not None and channel is not None and channel != wanted
        if not _usable(row) or other_channel or not {"telescope", "plate_scale"} & set(same):
            continue
        yield {
            "id": row.id,
            "name": row.name,
            "version": row.version,
            "status": row.status,
            "instrument": row.instrument,
            "channel": row.channel,
            "same": same,
            "told": agreement_with_image(same, channel, scale, header),
        }
        found += 1
        if found == MOST_NAMED:
            return


def _usable(row: PsfRow) -> bool:
    return row.kind in (TOTAL, UPLOADED) and row.status != PsfStatus.DEPRECATED


def buildable() -> tuple[str, ...]:
    """The names of the instruments whose PSF the service can build from a shipped instrument file."""
    return instrument_names()
