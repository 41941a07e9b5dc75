"""Checks whether an image, a PSF and the options of a deconvolution fit each other, before the job is queued.

These checks use the header cards that the catalogue stores. The job repeats them, with the same functions, on the
headers of the files. Earlier versions did not store these cards; for files that were uploaded to such a version, only
the job makes the checks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from psfcore.errors import DataError
from psfcore.fits.channel import binning_factor, check_channel
from psfcore.fits.frame import plate_scale_arcsec
from psfcore.fits.header import origin_of, wavelength_angstrom
from psfcore.instruments.model import load_instrument
from workers.catalogue.tables import PsfRow
from workers.contract.requests import ResolvedDeconvolve
from workers.versions import without_variant


@dataclass(frozen=True)
class PsfOrigin:
    """The properties of a PSF that are known without its file. cards: see `psfcore.psf.Psf`."""

    name: str
    instrument: str | None
    wavelength_angstrom: float | None
    plate_scale_arcsec: float | None
    cards: Mapping[str, str]


def check(request: ResolvedDeconvolve, psf: PsfRow | None, header: Mapping[str, Any]) -> None:
    """Raise the errors that the job would raise for the headers of its image and its PSF.

    psf: the row of the PSF; None: the PSF is not built yet. header: the header summary that is stored with the image. Codes:
    "channel-mismatch", "plate-scale-mismatch".
    """
    cards = header["cards"]
    origin = _origin(request, psf)
    if origin is not None:
        check_channel(origin, cards, other_channel=request.other_channel)
        binning_factor(origin, cards)


def suits(psf: PsfRow | str, header: Mapping[str, Any]) -> bool:
    """Whether the channel and the pixels of an image fit a PSF. psf: its row, or the name of its instrument. header: as in
    ``check``."""
    origin = _origin_of(psf) if isinstance(psf, str) else _origin_of_row(psf)
    try:
        check_channel(origin, header["cards"])
        binning_factor(origin, header["cards"])
    except DataError:
        return False
    return True


def of_upload(row: PsfRow, instrument: str | None, angstrom: float | None) -> tuple[str | None, float | None]:
    """The instrument and the wavelength of a PSF: the values in its file, or else the values in the request of its
    upload."""
    channel = without_variant(row.channel or "")
    if angstrom is None and channel.isdecimal():
        angstrom = float(channel)
    return instrument or row.instrument, angstrom


def _origin(request: ResolvedDeconvolve, psf: PsfRow | None) -> PsfOrigin | None:
    """The known properties of the PSF of a request; None if the user's own instrument file says them."""
    if psf is None:
        recipe = request.psf_recipe
        return None if recipe is None or recipe.instrument is None else _origin_of(recipe.instrument)
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


def _origin_of(name: str) -> PsfOrigin:
    known = load_instrument(name)
    return PsfOrigin(known.name, known.name, known.wavelength_angstrom, known.detector.plate_scale_arcsec, {})
