"""Reading uploaded transits, shared by the tasks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfcore.errors import DataError
from psfcore.fits.psfs import read_psf
from psfcore.transit.folder import read_prepared
from psfcore.transit.prepare import Prepared
from psfcore.transit.transit import Kernel, Transit
from workers.contract.requests import ResolvedOnTransit
from workers.rows import row_of

if TYPE_CHECKING:
    from workers.tasks.context import Context


def load_transit(
    context: Context,
    request: ResolvedOnTransit,
    *,
    diffraction: Kernel | None = None,
) -> tuple[Transit, Prepared]:
    """Unpack, read and prepare the transit that a request names.

    diffraction: the diffraction PSF to use if the transit contains none; None: build it from the request's recipe.

    Raises DataError "no-such-transit", "no-known-psf", and the errors of unpacking and preparing.
    """
    from workers.catalogue.tables import TransitRow  # a command with --local needs no catalogue

    upload = row_of(context.catalogue, TransitRow, request.transit_id, context.owner)
    images = int(upload.summary["images"])
    context.report("reading", 0, images)
    with context.store.unpacked(request.transit_id, context.settings.archive_limits) as folder:
        return read_prepared(
            folder,
            context.limits,
            progress=lambda done, of: context.report("reading", done, of),
            diffraction=lambda _instrument, _shape: (
                _built_diffraction(context, request) if diffraction is None else diffraction
            ),
            noise=None if request.noise is None else request.noise.noise(),
            saturation_dn=request.saturation_dn,
        )


def _built_diffraction(
    context: Context,
    request: ResolvedOnTransit,
) -> Kernel:
    """The diffraction PSF of the transit's instrument, from the catalogue or built now.

    The PSF is not cropped to the field of view: its kernel of 2048 × 2048 px sums to 1.
    """
    if request.diffraction_recipe is None:
        raise DataError(
            "no-known-psf",
            "expected known_psf in transit.json, or an instrument whose diffraction PSF can be built; got neither: add "
            "the file of the known PSF to the transit",
        )
    from workers.tasks.psf_build import built_psf  # a command with --local needs no catalogue

    row = built_psf(context, request.diffraction_recipe)
    return read_psf(context.store.verified(row.file_sha256), context.settings.psf_limits, parts=False).kernel
