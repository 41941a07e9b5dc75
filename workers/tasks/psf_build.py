"""The task ``psf-build``: builds a PSF version from an instrument file."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.images import read_plane
from psfcore.fits.psfs import write_psf
from psfcore.instruments.model import Instrument, parse_instrument
from psfcore.psf import Psf
from workers.catalogue.tables import ImageRow, PsfRow
from workers.contract.identities import interpolated_psf_identity, recipe_of
from workers.contract.requests import PsfBuild, PsfInterpolate, ResolvedDeconvolve
from workers.settings import library_versions
from workers.tasks.context import Context
from workers.tasks.data.psfs import is_total_alone, named_psf, psf_row
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
    with _compiling_beside(context, request) if context.compile_beside else nullcontext():
        row = built_psf(context, request.psf_recipe, whole=not context.total_psfs)
    if row.id != request.psf_id:
        raise DataError(
            "instrument-changed",
            f"expected PSF {request.psf_id} from the instrument file of {request.psf_recipe.instrument}; got {row.id}: the "
            "file changed after the job was submitted; submit the job again",
        )
    return row


def _compiling_beside(context: Context, request: ResolvedDeconvolve) -> AbstractContextManager[None]:
    upload = context.catalogue.get(ImageRow, request.image_id, context.owner)
    if upload is None:  # the task raises the error when it loads the image
        return nullcontext()
    # A job that builds no PSF does not load the kernels here.
    from psfcore.deconvolve.kernels import compiling_beside

    ny, nx = upload.summary["shape"]
    return compiling_beside(request.method.name, (ny, nx))


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


def built_psf(context: Context, build: PsfBuild, *, whole: bool = True) -> PsfRow:
    """The row of the PSF of a recipe. If the catalogue does not contain this PSF, build it and add it.

    whole: False: without components, tables and picture, for a deconvolution. If the whole PSF is asked for later, it is
    built then, and its files replace those of the total PSF.
    """
    recipe = recipe_of(build)
    identity = recipe.identity
    there = context.made(PsfRow, identity)
    if there is not None and not (whole and is_total_alone(there)):
        return there
    instrument = parse_instrument(recipe.text, recipe.name or "instrument_file")
    # A deconvolution with a PSF that is already built does not load the libraries of the diffraction.
    from psfcore.build import build_recipe

    psf = build_recipe(
        recipe,
        parts=whole,
        mount_image=_mount_image(context, build, instrument),
        threads=context.settings.threads,
        progress=lambda step, steps: context.report("building the PSF", step, steps),
    )
    with context.store.temporary() as path:
        write_psf(path, psf, instrument_file=recipe.text.encode())
        row = psf_row(
            psf,
            identity,
            context.owner,
            origin="built",
            file_sha256=context.store.keep(path),
            store=context.store,
            preview_sha256=_picture(context, psf) if whole else None,
            kind=build.component or TOTAL,
            details={"job_id": context.job_id, "libraries": library_versions()},
            threads=context.settings.threads,
            whole=whole,
        )
    return context.add(row) if there is None else context.catalogue.refile(row)


def _picture(context: Context, psf: Psf) -> str:
    """Draw a PSF into the store; returns the SHA-256 of the picture."""
    from psfcore.drawing import plots  # matplotlib is loaded only if a picture is drawn

    with context.store.temporary() as picture:
        plots.psf_png(psf, picture)
        return context.store.keep(picture)


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
