"""The task ``evaluate``: an uploaded transit in, a report on it and its PSF out, as JSON, HTML page and picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from psfcore.evaluation.plot import evaluation_png
from psfcore.report.page import page_of
from psfcore.report.report import PsfReport, make_report, report_json
from psfcore.transit.transit import Kernel
from workers.catalogue.tables import ReportRow
from workers.contract.contract import ResolvedEvaluate, evaluate_identity
from workers.tasks.context import Context
from workers.tasks.keep_report import keep_report, provenance_of, write_json
from workers.tasks.psfs import given_psf
from workers.tasks.transits import load_transit

KIND = "evaluate"
POINT_PX = 17


def evaluate(context: Context, parameters: Mapping[str, Any]) -> str:
    """Make a report on a transit; returns the report's id."""
    request = ResolvedEvaluate.model_validate(parameters)
    identity = evaluate_identity(request)
    if context.catalogue.get(ReportRow, identity, context.owner) is not None:
        return identity
    psf = given_psf(context, request.psf_id)
    transit, prepared = load_transit(context, request, diffraction=None if psf is None else _point())
    report = make_report(
        transit,
        prepared,
        psf=psf,
        dark_offsets=request.dark_offsets,
        seed=request.seed,
        threads=context.settings.threads,
        progress=context.report,
    )
    _save(context, request, identity, report)
    return identity


def _point() -> Kernel:
    """A diffraction PSF that changes nothing. A given PSF already contains the diffraction."""
    point = np.zeros((POINT_PX, POINT_PX))
    point[POINT_PX // 2, POINT_PX // 2] = 1.0
    return point


def _save(context: Context, request: ResolvedEvaluate, identity: str, report: PsfReport) -> None:
    """Write JSON, HTML page and picture into the store, and add the row to the catalogue."""
    provenance = {"report_id": identity, **provenance_of(context, request)}
    said = report_json(report, provenance)
    with (
        context.store.temporary() as text,
        context.store.temporary() as page,
        context.store.temporary() as picture,
    ):
        write_json(text, said)
        page.write_text(page_of(report, provenance).html(), "utf-8")
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
