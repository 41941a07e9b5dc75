"""The tasks ``psf-build``, ``psf-interpolate`` and ``psf-tables``.

The first builds a PSF version from an instrument file. The second interpolates between two fitted PSFs in time; the result
is a PSF with its errors. The third makes the tables and the picture of a PSF that has none yet, for example an uploaded PSF.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.images import read_plane
from psfcore.fits.psfs import read_psf
from psfcore.instruments.model import Instrument, parse_instrument
from psfcore.psf import Psf, cumulative_curve
from psfcore.scatter.interpolation import Epoch, curve_sigma, interpolated_psf, parameters_of
from psfcore.scatter.total_psf import CURVE_RADII_PX
from workers.catalogue.tables import PsfRow
from workers.contract.identities import interpolated_psf_identity, recipe_of
from workers.contract.requests import PsfBuild, PsfInterpolate, PsfTables, ResolvedDeconvolve
from workers.intake.compatibility import of_upload
from workers.settings import library_versions
from workers.tasks.context import Context
from workers.tasks.results import keep_psf, keep_tables, named_psf, provenance_of
from workers.versions import INTERPOLATED, TOTAL, interpolated_name

STAGE = "interpolating the PSF"


def psf_build(context: Context, parameters: Mapping[str, Any]) -> str:
    """Build a PSF from an instrument file and add it to the catalogue; returns the PSF's id."""
    return built_psf(context, PsfBuild.model_validate(parameters)).id


def requested_psf(context: Context, request: ResolvedDeconvolve) -> PsfRow:
    """The row of the PSF that a deconvolution names. If the catalogue does not contain this PSF, it is made first: built
    from its recipe, or interpolated between two PSFs, if the request says how.

    Raises DataError "no-such-psf", "instrument-changed" if the recipe now gives another PSF, "interpolation-changed" if
    this version interpolates in another way, and the errors of ``workers.tasks.psf_build``.
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


def psf_interpolate(context: Context, parameters: Mapping[str, Any]) -> str:
    """Interpolate between two PSFs of the catalogue, and add the new PSF to it; returns the PSF's id."""
    return interpolated_row(context, PsfInterpolate.model_validate(parameters)).id


def interpolated_row(context: Context, request: PsfInterpolate) -> PsfRow:
    """The row of the interpolated PSF. If the catalogue does not contain this PSF, it is made and added.

    Raises DataError "no-such-psf", and the errors of ``psfcore.scatter.interpolation.interpolated_psf``.
    """
    identity = interpolated_psf_identity(request)
    made = context.made(PsfRow, identity)
    if made is not None:
        return made
    from psfcore.drawing.plots import psf_png  # matplotlib is loaded only if a picture is drawn

    context.report(STAGE, 0, 2)
    ends = {
        "before": _epoch(context, request.before_psf_id, request.before_time),
        "after": _epoch(context, request.after_psf_id, request.after_time),
    }
    name, version = interpolated_name(ends["before"].psf.instrument, identity)
    # The id of the job is in the details of the row, not in the file, so that the file can be made again bit for bit.
    provenance = {"psf_id": identity, **provenance_of(context.job_id, request)}
    del provenance["job_id"]
    psf = interpolated_psf(
        ends["before"],
        ends["after"],
        datetime.fromisoformat(request.time),
        name=name,
        version=version,
        provenance=provenance,
        threads=context.settings.threads,
    )
    context.report(STAGE, 1, 2)
    parents = psf.provenance["interpolated_between"]
    return keep_psf(
        context,
        psf,
        identity,
        origin=INTERPOLATED,
        draw=partial(psf_png, psf),
        # The files of the ends do not name the variant of the channel; their rows do.
        channel=named_psf(context, request.before_psf_id).channel,
        details={
            "parents": {name: end["psf_id"] for name, end in zip(("before", "after"), parents, strict=True)},
            "weights": {end["psf_id"]: end["weight"] for end in parents},
            "job_id": context.job_id,
            "fit": _fit_of(psf, context.settings.threads),
        },
    )


def _epoch(context: Context, psf_id: str, time: str) -> Epoch:
    """A PSF of the catalogue, and the time at which it holds."""
    row = named_psf(context, psf_id)
    psf = read_psf(context.store.verified(row.file_sha256), context.settings.psf_limits)
    # The request of an upload or of a certification may give an instrument and a channel that the file does not contain.
    instrument, angstrom = of_upload(row, psf.instrument, psf.wavelength_angstrom)
    psf = replace(
        psf, name=row.name, version=row.version, instrument=instrument, wavelength_angstrom=angstrom
    )
    return Epoch(psf, datetime.fromisoformat(time), {"psf_id": row.id, "file_sha256": row.file_sha256})


def _fit_of(psf: Psf, threads: int) -> dict[str, Any]:
    """The parameters and the curve with their errors, in the form of the details of a fitted PSF."""
    assert psf.fitted is not None
    radii = np.array([radius for radius in CURVE_RADII_PX if radius < psf.kernel.shape[0] // 2])
    curve, sigma = cumulative_curve(psf.kernel, radii), curve_sigma(psf, radii, threads=threads)
    before, after = psf.provenance["interpolated_between"]
    return {
        "sentence": f"Interpolated to {psf.provenance['interpolated_at']} between {before['name']} {before['version']} (weight "
        f"{before['weight']:.3f}) and {after['name']} {after['version']} (weight {after['weight']:.3f}).",
        "shape": psf.fitted.shape,
        "parameters": parameters_of(psf.fitted),
        "curve": {
            "radii_px": radii.tolist(),
            "light_beyond_pct": curve.tolist(),
            "sigma": sigma.tolist(),
        },
    }
