"""Checks before a job is queued: whether an image, a PSF and the options fit each other, and whether the PSF is
deprecated.

These checks use the header cards that the catalogue stores. The job repeats them, with the same functions, on the
headers of the files.

The service never chooses a deprecated PSF by itself, and a product that was made with one has a warning. A context
still uses the PSFs that it pins, even if they were deprecated later. So its results stay reproducible.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from psfcore.errors import DataError
from psfcore.fits.channel import PsfOrigin, binning_factor, check_channel
from psfcore.fits.frame import plate_scale_arcsec
from psfcore.fits.header import HeaderJson, origin_of, wavelength_angstrom
from psfcore.instruments.model import load_instrument
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ProductRow, PsfRow
from workers.contract.requests import ResolvedDeconvolve
from workers.versions import INTERPOLATED, PsfStatus, without_variant

DEPRECATED_CODE = "psf-deprecated"  # the code of the error and of the warning
SHOWN_DIGITS = 12


def check(request: ResolvedDeconvolve, psf: PsfRow | None, header: HeaderJson) -> None:
    """Raise the errors that the job would raise for the headers of its image and its PSF.

    Parameters
    ----------
    psf
        The row of the PSF; None: the PSF is not built yet.
    header
        The header summary that is stored with the image.

    Raises
    ------
    DataError
        "channel-mismatch", "plate-scale-mismatch".
    """
    cards = header["cards"]
    origin = _origin(request, psf)
    if origin is not None:
        check_channel(origin, cards, other_channel=request.other_channel)
        binning_factor(origin, cards)


def suits(psf: PsfRow | str, header: HeaderJson) -> bool:
    """Whether the channel and the pixels of an image fit a PSF.

    Parameters
    ----------
    psf
        The row of the PSF, or the name of its instrument.
    header
        The header summary that is stored with the image.
    """
    origin = PsfOrigin.of_instrument(load_instrument(psf)) if isinstance(psf, str) else _origin_of_row(psf)
    try:
        check_channel(origin, header["cards"])
        binning_factor(origin, header["cards"])
    except DataError:
        return False
    return True


def of_upload(row: PsfRow, instrument: str | None, angstrom: float | None) -> tuple[str | None, float | None]:
    """The instrument and the wavelength of a PSF: the values in its file, or else the values in the request of its
    upload.
    """
    channel = without_variant(row.channel or "")
    if angstrom is None and channel.isdecimal():
        angstrom = float(channel)
    return instrument or row.instrument, angstrom


def _origin(request: ResolvedDeconvolve, psf: PsfRow | None) -> PsfOrigin | None:
    """The known properties of the PSF of a request; None if the user's own instrument file says them."""
    if psf is None:
        recipe = request.psf_recipe
        return (
            None
            if recipe is None or recipe.instrument is None
            else PsfOrigin.of_instrument(load_instrument(recipe.instrument))
        )
    return _origin_of_row(psf)


def _origin_of_row(psf: PsfRow) -> PsfOrigin:
    if psf.origin != "uploaded":
        return PsfOrigin(
            psf.name,
            psf.instrument,
            psf.details.get("wavelength_angstrom"),
            psf.details.get("plate_scale_arcsec"),
            {},
        )
    kept = psf.details["cards"]
    named, cards = origin_of(kept)
    instrument, angstrom = of_upload(psf, named, wavelength_angstrom(kept))
    return PsfOrigin(psf.name, instrument, angstrom, plate_scale_arcsec(kept), cards)


@dataclass(frozen=True)
class Deprecation:
    """Why a PSF is deprecated, and what replaces it.

    Attributes
    ----------
    reason
        The reason that was given; empty if none was given.
    redo_with
        The certified PSF at the end of the chain of successors; None if there is none.
    """

    reason: str
    redo_with: PsfRow | None


def check_not_deprecated(catalogue: Catalogue, psf_id: str, owner: str, what: str, ways: str) -> None:
    """Raise ``DataError`` "psf-deprecated" if the PSF that the service would choose is deprecated.

    Parameters
    ----------
    what
        The name of the PSF in the message.
    ways
        Advice for the user. It may contain {psf}, which stands for the first digits of the PSF's id.
    """
    row = catalogue.get(PsfRow, psf_id, owner)
    if row is None or row.status != PsfStatus.DEPRECATED:
        return
    instead = "" if row.successor_id is None else f" (its successor is {row.successor_id[:SHOWN_DIGITS]})"
    raise DataError(
        DEPRECATED_CODE,
        f"expected a PSF that is still in use; {what} was deprecated ({_reason(catalogue, row)}){instead}: "
        + ways.format(psf=psf_id[:SHOWN_DIGITS]),
    )


def deprecated_warning(catalogue: Catalogue, psf: PsfRow) -> str | None:
    """The warning for users of a deprecated PSF, or of a PSF that was interpolated from a deprecated PSF; None for
    every other PSF.
    """
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
                f"PSF {psf.id[:SHOWN_DIGITS]} ({psf.name} {psf.version}) was interpolated from PSF "
                f"{end_id[:SHOWN_DIGITS]} ({end.name} {end.version}), which was deprecated "
                f"({_reason(catalogue, end)}); use another PSF for new products"
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
    others = [one for one in product.details["warnings"] if one["code"] != DEPRECATED_CODE]
    return {**product.details, "warnings": [*others, {"code": DEPRECATED_CODE, "message": message}]}


def _reason(catalogue: Catalogue, psf: PsfRow) -> str:
    """Why a PSF was deprecated, as words for a message."""
    reason = _last_reason(catalogue, psf)
    return f"reason: {reason}" if reason else "no reason was given"


def _last_reason(catalogue: Catalogue, psf: PsfRow) -> str:
    """The last reason that was given; empty if none was given. A later change that only names a successor may have no
    reason.
    """
    changes = catalogue.psfs.changes(psf.id, psf.owner)
    reasons = [one.reason for one in changes if one.status == PsfStatus.DEPRECATED and one.reason]
    return reasons[-1] if reasons else ""
