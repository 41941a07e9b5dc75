"""The tasks ``psf-build``, which builds a PSF version from an instrument file, and ``psf-tables``, which makes the tables and the
picture of a PSF that has none yet, for example an uploaded PSF."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.images import read_plane
from psfcore.fits.psfs import read_psf
from psfcore.instruments.model import Instrument, parse_instrument
from workers.catalogue.tables import PsfRow
from workers.contract.identities import interpolated_psf_identity, recipe_of
from workers.contract.requests import PsfBuild, PsfInterpolate, PsfTables, ResolvedDeconvolve
from workers.settings import library_versions
from workers.tasks.context import Context
from workers.tasks.results import keep_psf, keep_tables, named_psf
from workers.versions import TOTAL


def psf_build(context: Context, parameters: Mapping[str, Any]) -> str:
    """Build a PSF from an instrument file and add it to the catalogue; returns the PSF's id."""
    return built_psf(context, PsfBuild.model_validate(parameters)).id


def requested_psf(context: Context, request: ResolvedDeconvolve) -> PsfRow:
    """The row of the PSF that a deconvolution names. If the catalogue does not contain this PSF, it is made first: built
    from its recipe, or interpolated between two PSFs, if the request says how.

    Raises DataError "no-such-psf", "instrument-changed" if the recipe now gives another PSF, "interpolation-changed" if
    this version interpolates in another way, and the errors of ``workers.tasks.interpolation``.
    """
    if request.psf_recipe is None and request.psf_interpolation is None:
        return named_psf(context, request.psf_id)
    made = context.made(PsfRow, request.psf_id)
    if made is not None:
        return made
    if request.psf_interpolation is not None:
        return _interpolated(context, request.psf_id, request.psf_interpolation)
    assert request.psf_recipe is not None
    row = built_psf(context, request.psf_recipe)
    if row.id != request.psf_id:
        raise DataError(
            "instrument-changed",
            f"expected PSF {request.psf_id} from the instrument file of {request.psf_recipe.instrument}; got {row.id}: the "
            "file changed after the job was submitted; submit the job again",
        )
    return row


def _interpolated(context: Context, psf_id: str, asked: PsfInterpolate) -> PsfRow:
    if interpolated_psf_identity(asked) != psf_id:
        raise DataError(
            "interpolation-changed",
            f"expected the interpolation that gave PSF {psf_id} when the job was submitted; this version interpolates in another "
            "way: submit the job again",
        )
    # A deconvolution with another PSF does not load what an interpolation needs.
    from workers.tasks.interpolation import interpolated_row

    return interpolated_row(context, asked)


def built_psf(context: Context, build: PsfBuild) -> PsfRow:
    """The row of the PSF of a recipe. If the catalogue does not contain this PSF, build it and add it."""
    recipe = recipe_of(build)
    there = context.made(PsfRow, recipe.identity)
    if there is not None:
        return there
    instrument = parse_instrument(recipe.text, recipe.name or "instrument_file")
    # A deconvolution with a PSF that is already built does not load the libraries of the diffraction and of pictures.
    from psfcore.build import build_recipe
    from psfcore.drawing.plots import psf_png

    psf = build_recipe(
        recipe,
        mount_image=_mount_image(context, build, instrument),
        threads=context.settings.threads,
        progress=lambda step, steps: context.report("building the PSF", step, steps),
    )
    return keep_psf(
        context,
        psf,
        recipe.identity,
        origin="built",
        draw=partial(psf_png, psf),
        kind=build.component or TOTAL,
        instrument_file=recipe.text.encode(),
        details={"job_id": context.job_id, "libraries": library_versions()},
    )


def _mount_image(context: Context, build: PsfBuild, instrument: Instrument) -> NDArray[np.float64] | None:
    """The pixels of the uploaded mask image that the instrument's mount names; None if the mount names none.

    Raises DataError "mask-not-named", "mask-missing".
    """
    named = None if instrument.mount is None else instrument.mount.mask_image
    if named is None and build.mask_id is None:
        return None
    if named is None:
        raise DataError(
            "mask-not-named",
            "mask_id: expected an instrument file that sets mount.mask_image; this file does not: leave mask_id out",
        )
    if build.mask_id is None:
        raise DataError(
            "mask-missing",
            f"mask_id: expected the id of the mask image {named.file}, which mount.mask_image names; got none: upload the "
            "file and give its id",
        )
    return read_plane(context.store.verified(build.mask_id), context.limits)


def psf_tables(context: Context, parameters: Mapping[str, Any]) -> str:
    """Make the tables of a PSF of the catalogue, and its picture if it is missing; returns the PSF's id."""
    request = PsfTables.model_validate(parameters)
    row = named_psf(context, request.psf_id)
    from psfcore.drawing.plots import psf_png  # matplotlib is loaded only if a picture is drawn

    context.report("reading", 0, 3)
    psf = read_psf(context.store.verified(row.file_sha256), context.settings.psf_limits)
    context.report("making tables", 1, 3)
    tables_sha256 = keep_tables(psf, context.store, context.settings.threads)
    context.report("drawing", 2, 3)
    with context.store.temporary() as picture:
        preview_sha256 = row.preview_sha256
        if preview_sha256 is None or context.store.size(preview_sha256) is None:
            psf_png(psf, picture)
            preview_sha256 = context.store.keep(picture)
    context.report("drawing", 3, 3)
    context.catalogue.psfs.describe(
        row.id, context.owner, tables_sha256=tables_sha256, preview_sha256=preview_sha256
    )
    return row.id
