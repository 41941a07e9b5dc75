"""The task ``report``: makes a report on an uploaded transit and its PSF, as JSON, HTML page and picture."""

from __future__ import annotations

import numpy as np

from psfcore.errors import module_of_extra
from psfcore.evaluation.shapes import compare_shapes_by_errors
from psfcore.report.report import make_report, report_json
from psfcore.transit.transit import Kernel
from workers.contract.requests import ResolvedReport
from workers.tasks.results import provenance_of, report_result
from workers.tasks.transits import load_transit
from workers.tasks.workspace import Workspace, task_of

KIND = "report"
POINT_PX = 17


@task_of("report")
def report(workspace: Workspace, request: ResolvedReport, identity: str) -> None:
    """Make a report on a transit."""
    psf = None if request.psf_id is None else workspace.psf(request.psf_id)
    transit, prepared = load_transit(workspace, request, diffraction=None if psf is None else _point())
    report = make_report(
        transit,
        prepared,
        psf=psf,
        dark_offsets=request.dark_offsets,
        seed=request.seed,
        threads=workspace.threads,
        progress=workspace.report,
        solution=workspace.inverter(request),
    )
    provenance = {"report_id": identity, **provenance_of(workspace.job_id, request)}
    content = report_json(report, provenance)
    if request.shapes:
        # A request that compares shapes names no PSF, so the transit was fitted.
        assert report.fit is not None
        shapes = compare_shapes_by_errors(report.fit.solution, seed=request.seed, progress=workspace.report)
        content["shapes"] = shapes.to_json()
    details = {
        "sentence": content["sentence"],
        "psf_id": request.psf_id,
        "held_out": report.held_out,
        "residuals": content["evaluation"]["all"],
        "not_shown": content["not_shown"],
        "limits": content["fit"]["limits"] if report.fit is not None else [],
    }
    workspace.add(
        report_result(
            identity,
            KIND,
            content,
            details,
            draw=lambda path: module_of_extra("psfcore.evaluation.plots").evaluation_png(
                report.evaluation, path, title=report.how_judged, study=report.study
            ),
            page=lambda: module_of_extra("psfcore.report.page").report_page(report, provenance),
            transit_id=request.transit_id,
        )
    )


def _point() -> Kernel:
    """A diffraction PSF that changes nothing (a point).

    This PSF is used with a given PSF that already contains the diffraction.
    """
    point = np.zeros((POINT_PX, POINT_PX))
    point[POINT_PX // 2, POINT_PX // 2] = 1.0
    return point
