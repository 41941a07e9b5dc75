"""Rows of the catalogue by their ids, and the error for an id that has no row."""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfcore.errors import DataError
from workers.contract.requests import FEWEST_DIGITS

if TYPE_CHECKING:
    from workers.catalogue.catalogue import Catalogue, Row

# The word of an error code, the name of the thing in messages, and what its user can do.
NAMES = {
    "image": "image",
    "transit": "transit",
    "psf": "PSF",
    "product": "product",
    "report": "report",
    "job": "job",
    "bulk": "bulk run",
    "key": "key",
}
_ADVICE = {
    "image": "upload the image first, or list your images",
    "transit": "upload the transit first, or list your transits",
    "psf": "list your PSFs with `heliopsf psf list`, or upload the PSF first",
    "product": "list your products with `heliopsf product list`",
    "job": "list your jobs with `heliopsf job list`",
    "bulk": "list your bulk runs with `heliopsf bulk list`",
}


def row_of(catalogue: Catalogue, table: type[Row], identity: str, owner: str) -> Row:
    """The owner's row with this id. Raises ``DataError`` "no-such-image", "no-such-psf", ... if there is none."""
    row = catalogue.get(table, identity, owner)
    if row is None:
        raise no_such(table.thing(), identity)
    return row


def no_such(thing: str, given: str, *, shortened: bool = False) -> DataError:
    """The error for an id that nothing of the owner has.

    Parameters
    ----------
    thing
        A key of ``NAMES``.
    given
        The id that was received.
    shortened
        Whether the first digits of an id would also have been accepted.
    """
    names = f"{NAMES[thing]}s"
    digits = f", or its first {FEWEST_DIGITS} or more digits" if shortened else ""
    advice = _ADVICE.get(thing, f"list your {names}")
    return DataError(
        f"no-such-{thing}",
        f"expected the id of one of your {names}{digits}; got {given}, which fits none of them: {advice}",
    )
