"""Tasks on an uploaded transit, and reading it: ``psf-fit`` fits the scatter, and its result is a PSF with its errors and a
report; ``report`` makes a report on the transit and its PSF, as JSON, HTML page and picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from psfcore.errors import DataError
from psfcore.evaluation.plot import evaluation_png
from psfcore.evaluation.shapes import compare_shapes_by_errors
from psfcore.fits.psfs import read_psf
from psfcore.report.page import page_of
from psfcore.report.report import PsfReport, make_report, report_json
from psfcore.scatter.fit import TransitFit, fit_transit, fitted_psf
from psfcore.scatter.fit_plot import fit_png
from psfcore.scatter.report import fit_json
from psfcore.transit.folder import read_prepared
from psfcore.transit.prepare import Prepared
from psfcore.transit.transit import Kernel, Transit
from workers.catalogue.tables import PsfRow, ReportRow, TransitRow
from workers.contract.identities import diffraction_identity, psf_fit_identity, report_identity
from workers.contract.requests import ResolvedOnTransit, ResolvedPsfFit, ResolvedReport
from workers.rows import row_of
from workers.tasks.context import Context
from workers.tasks.data.psfs import given_psf, keep_psf
from workers.tasks.data.reports import keep_json, keep_report, provenance_of
from workers.tasks.data.solutions import solver
from workers.tasks.psf_build import built_psf

POINT_PX = 17


def psf_fit(context: Context, parameters: Mapping[str, Any]) -> str:
    """Fit the scatter to a transit and add the PSF to the catalogue; returns the PSF's id."""
    request = ResolvedPsfFit.model_validate(parameters)
    identity = psf_fit_identity(request)
    if context.made(PsfRow, identity) is not None:
        return identity
    transit, prepared = load_transit(context, request)
    fit = fit_transit(
        transit,
        shape=request.shape,
        as_published=request.as_published,
        seed=request.seed,
        threads=context.settings.threads,
        progress=context.report,
        solution=solver(context, request),
    )
    _save_fit(context, request, identity, fit, prepared)
    return identity


def _save_fit(
    context: Context, request: ResolvedPsfFit, identity: str, fit: TransitFit, prepared: Prepared
) -> None:
    """Write the file, report and picture of the PSF into the store, and add the PSF's row to the catalogue."""
    provenance = {
        "psf_id": identity,
        "inputs_sha256": fit.transit.sha256,
        **provenance_of(context, request),
    }
    name = f"{fit.transit.instrument or 'transit'}-fitted"
    psf = fitted_psf(fit, name=name, version=f"0.1.0+{identity[:8]}", provenance=provenance)
    said = fit_json(fit) | {"prepared": prepared.to_json(), "provenance": provenance}
    shown = ("sentence", "shape", "parameters", "curve", "chi2_per_pixel", "converged", "limits")
    details = {
        "transit_id": request.transit_id,
        "diffraction_psf_id": diffraction_identity(request),
        "report_sha256": keep_json(context, said),
        "fit": {key: said[key] for key in shown},
    }
    row = keep_psf(
        context, psf, identity, origin="fitted", details=details, draw=lambda path: fit_png(fit, path)
    )
    context.add(row)


def report(context: Context, parameters: Mapping[str, Any]) -> str:
    """Make a report on a transit; returns its id."""
    request = ResolvedReport.model_validate(parameters)
    identity = report_identity(request)
    if context.made(ReportRow, identity) is not None:
        return identity
    psf = given_psf(context, request.psf_id)
    transit, prepared = load_transit(context, request, diffraction=None if psf is None else _point())
    made = make_report(
        transit,
        prepared,
        psf=psf,
        dark_offsets=request.dark_offsets,
        seed=request.seed,
        threads=context.settings.threads,
        progress=context.report,
        solution=solver(context, request),
    )
    shapes = {}
    if request.shapes:
        assert made.fit is not None  # a request that compares shapes names no PSF, so the transit was fitted
        compared = compare_shapes_by_errors(made.fit.solution, seed=request.seed, progress=context.report)
        shapes = {"shapes": compared.to_json()}
    _save_report(context, request, identity, made, shapes)
    return identity


def _point() -> Kernel:
    """A diffraction PSF that changes nothing (a point).

    This PSF is used with a given PSF that already contains the diffraction.
    """
    point = np.zeros((POINT_PX, POINT_PX))
    point[POINT_PX // 2, POINT_PX // 2] = 1.0
    return point


def _save_report(
    context: Context, request: ResolvedReport, identity: str, report: PsfReport, shapes: dict[str, Any]
) -> None:
    """Write JSON, page and picture into the store, and the row into the catalogue."""
    provenance = {"report_id": identity, **provenance_of(context, request)}
    said = report_json(report, provenance) | shapes
    keep_report(
        context,
        identity,
        "report",
        said,
        draw=lambda path: evaluation_png(
            report.evaluation, path, title=report.how_judged, study=report.study
        ),
        page=page_of(report, provenance).html(),
        transit_id=request.transit_id,
        details={
            "sentence": said["sentence"],
            "psf_id": request.psf_id,
            "held_out": report.held_out,
            "residuals": said["evaluation"]["all"],
            "not_shown": said["not_shown"],
            "limits": said["fit"]["limits"] if report.fit is not None else [],
        },
    )


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
    row = built_psf(context, request.diffraction_recipe)
    return read_psf(context.store.verified(row.file_sha256), context.limits, parts=False).kernel
