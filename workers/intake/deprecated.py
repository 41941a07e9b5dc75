"""Deprecated PSFs: the service never chooses such a PSF by itself, and a product that was made with one has a warning.

A context still uses the PSFs that it pins, even if they were deprecated later. So its results stay reproducible.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from psfcore.errors import DataError
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ProductRow, PsfRow
from workers.versions import INTERPOLATED, PsfStatus

CODE = "psf-deprecated"  # the code of the error and of the warning
SHOWN_DIGITS = 12


@dataclass(frozen=True)
class Deprecation:
    """Why a PSF is deprecated, and what replaces it.

    reason: empty if none was given. redo_with: the certified PSF at the end of the chain of successors; None if there is none.
    """

    reason: str
    redo_with: PsfRow | None


def check_not_deprecated(catalogue: Catalogue, psf_id: str, owner: str, what: str, ways: str) -> None:
    """Raise ``DataError`` "psf-deprecated" if the PSF that the service would choose is deprecated.

    what: the name of the PSF in the message. ways: advice for the user; it may contain {psf}, which stands for the
    PSF's id.
    """
    row = catalogue.get(PsfRow, psf_id, owner)
    if row is None or row.status != PsfStatus.DEPRECATED:
        return
    instead = "" if row.successor_id is None else f" (its successor is {row.successor_id[:SHOWN_DIGITS]})"
    raise DataError(
        CODE,
        f"expected a PSF that is still in use; {what} was deprecated ({_reason(catalogue, row)}){instead}: "
        + ways.format(psf=psf_id[:SHOWN_DIGITS]),
    )


def deprecated_warning(catalogue: Catalogue, psf: PsfRow) -> str | None:
    """The warning for users of a deprecated PSF, or of a PSF that was interpolated from a deprecated PSF; None for every
    other PSF."""
    if psf.status != PsfStatus.DEPRECATED:
        return _end_warning(catalogue, psf) if psf.origin == INTERPOLATED else None
    better = "another PSF" if psf.successor_id is None else f"its successor {psf.successor_id[:SHOWN_DIGITS]}"
    return (
        f"PSF {psf.id[:SHOWN_DIGITS]} ({psf.name} {psf.version}) was deprecated ({_reason(catalogue, psf)}); "
        f"use {better} for new products"
    )


def _end_warning(catalogue: Catalogue, psf: PsfRow) -> str | None:
    """The warning for users of an interpolated PSF one of whose ends is deprecated."""
    for end_id in (psf.details.get("parents") or {}).values():
        end = catalogue.get(PsfRow, end_id, psf.owner)
        if end is not None and end.status == PsfStatus.DEPRECATED:
            return (
                f"PSF {psf.id[:SHOWN_DIGITS]} ({psf.name} {psf.version}) was interpolated from PSF {end_id[:SHOWN_DIGITS]} "
                f"({end.name} {end.version}), which was deprecated ({_reason(catalogue, end)}); use another PSF for new products"
            )
    return None


def deprecation(catalogue: Catalogue, psf: PsfRow) -> Deprecation | None:
    """The deprecation of a PSF; None if it is not deprecated."""
    if psf.status != PsfStatus.DEPRECATED:
        return None
    return Deprecation(_last_reason(catalogue, psf), catalogue.affected.replacement(psf))


def details_now(catalogue: Catalogue, product: ProductRow) -> dict[str, Any]:
    """The details of a product.

    If its PSF is deprecated now, the details contain a warning, even if the product is older.
    """
    psf = catalogue.get(PsfRow, product.psf_id, product.owner)
    message = None if psf is None else deprecated_warning(catalogue, psf)
    if message is None:
        return product.details
    others = [one for one in product.details["warnings"] if one["code"] != CODE]
    return {**product.details, "warnings": [*others, {"code": CODE, "message": message}]}


def _reason(catalogue: Catalogue, psf: PsfRow) -> str:
    """Why a PSF was deprecated, as words for a message."""
    reason = _last_reason(catalogue, psf)
    return f"reason: {reason}" if reason else "no reason was given"


def _last_reason(catalogue: Catalogue, psf: PsfRow) -> str:
    """The last reason that was given; empty if none was given. A later change that only names a successor may have no reason."""
    changes = catalogue.psfs.changes(psf.id, psf.owner)
    reasons = [one.reason for one in changes if one.status == PsfStatus.DEPRECATED and one.reason]
    return reasons[-1] if reasons else ""
