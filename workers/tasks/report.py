"""The task ``report``: makes a report on an uploaded transit and its PSF, as JSON, HTML page and picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from psfcore.errors import module_of_extra
from psfcore.evaluation.shapes import compare_shapes_by_errors
from psfcore.psf import Psf
from psfcore.report.report import make_report, report_json
from psfcore.transit.prepare import Prepared
from psfcore.transit.transit import Kernel, Transit
from workers.contract.identities import report_identity
from workers.contract.requests import ResolvedReport
from workers.tasks.results import Finished, Means, given_psf, keep_report, provenance_of, report_made
from workers.tasks.transits import load_transit, means_of

if TYPE_CHECKING:
    from workers.tasks.context import Context

KIND = "report"
POINT_PX = 17


def report(context: Context, parameters: Mapping[str, Any]) -> str:
    """Make a report on a transit; returns its id."""
    request = ResolvedReport.model_validate(parameters)
    identity = report_identity(request)
    if report_made(context, identity):
        return identity
    psf = given_psf(context, request.psf_id)
    transit, prepared = load_transit(context, request, diffraction=None if psf is None else point())
    finished = make(request, transit, prepared, psf, means_of(context, request))
    keep_report(context, identity, KIND, finished, transit_id=request.transit_id)
    return identity


def point() -> Kernel:
    """A diffraction PSF that changes nothing (a point).

    This PSF is used with a given PSF that already contains the diffraction.
    """
    point = np.zeros((POINT_PX, POINT_PX))
    point[POINT_PX // 2, POINT_PX // 2] = 1.0
    return point


def make(
    request: ResolvedReport, transit: Transit, prepared: Prepared, psf: Psf | None, means: Means
) -> Finished:
    """Make the report that a request describes. psf: the PSF to test; None: fit one."""
    report = make_report(
        transit,
        prepared,
        psf=psf,
        dark_offsets=request.dark_offsets,
        seed=request.seed,
        threads=means.threads,
        progress=means.progress,
        solution=means.solution,
    )
    provenance = {"report_id": report_identity(request), **provenance_of(means.job_id, request)}
    said = report_json(report, provenance)
    if request.shapes:
        assert (
            report.fit is not None
        )  # a request that compares shapes names no PSF, so the transit was fitted
        shapes = compare_shapes_by_errors(report.fit.solution, seed=request.seed, progress=means.progress)
        said["shapes"] = shapes.to_json()
    return Finished(
        said,
        {
            "sentence": said["sentence"],
            "psf_id": request.psf_id,
            "held_out": report.held_out,
            "residuals": said["evaluation"]["all"],
            "not_shown": said["not_shown"],
            "limits": said["fit"]["limits"] if report.fit is not None else [],
        },
        draw=lambda path: module_of_extra("psfcore.evaluation.plots").evaluation_png(
            report.evaluation, path, title=report.how_judged, study=report.study
        ),
        page=lambda: module_of_extra("psfcore.report.page").report_page(report, provenance),
    )
