"""The task ``report``: makes a report on an uploaded transit and its PSF, as JSON, HTML page and picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from psfcore.evaluation.plot import evaluation_png
from psfcore.evaluation.shapes import compare_shapes_by_errors
from psfcore.report.page import report_page
from psfcore.report.report import PsfReport, make_report, report_json
from psfcore.transit.transit import Kernel
from workers.catalogue.tables import ReportRow
from workers.contract.identities import report_identity
from workers.contract.requests import ResolvedReport
from workers.tasks.context import Context
from workers.tasks.data.psfs import given_psf
from workers.tasks.data.reports import keep_report, provenance_of, write_json
from workers.tasks.data.solutions import solver
from workers.tasks.transits import load_transit

KIND = "report"
POINT_PX = 17


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
    shapes = _shapes(context, request, made) if request.shapes else None
    _save(context, request, identity, made, shapes)
    return identity


def _point() -> Kernel:
    """A diffraction PSF that changes nothing (a point).

    This PSF is used with a given PSF that already contains the diffraction.
    """
    point = np.zeros((POINT_PX, POINT_PX))
    point[POINT_PX // 2, POINT_PX // 2] = 1.0
    return point


def _shapes(context: Context, request: ResolvedReport, report: PsfReport) -> dict[str, Any]:
    """The comparison of the scatter shapes by their residuals on held-out images."""
    assert report.fit is not None  # a request that compares shapes names no PSF, so the transit was fitted
    return compare_shapes_by_errors(report.fit.solution, seed=request.seed, progress=context.report).to_json()


def _save(
    context: Context,
    request: ResolvedReport,
    identity: str,
    report: PsfReport,
    shapes: dict[str, Any] | None,
) -> None:
    """Write JSON, page and picture into the store, and the row into the catalogue."""
    provenance = {"report_id": identity, **provenance_of(context, request)}
    said = report_json(report, provenance)
    if shapes is not None:
        said["shapes"] = shapes
    with (
        context.store.temporary() as text,
        context.store.temporary() as page,
        context.store.temporary() as picture,
    ):
        write_json(text, said)
        page.write_text(report_page(report, provenance), "utf-8")
        evaluation_png(report.evaluation, picture, title=report.how_judged, study=report.study)
        keep_report(
            context,
            identity,
            KIND,
            transit_id=request.transit_id,
            text=text,
            page=page,
            picture=picture,
            details={
                "sentence": said["sentence"],
                "psf_id": request.psf_id,
                "held_out": report.held_out,
                "residuals": said["evaluation"]["all"],
                "not_shown": said["not_shown"],
                "limits": said["fit"]["limits"] if report.fit is not None else [],
            },
        )
