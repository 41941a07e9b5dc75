"""The task ``evaluate``: an uploaded transit in, a report on it and its PSF out, as JSON, page and picture."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from psfcore.errors import DataError
from psfcore.fits_io import read_psf
from psfcore.psf import Psf
from psfcore.report.psf_report import PsfReport, make_report, report_json
from psfcore.report.psf_report_page import page_of
from psfcore.transit.evaluation_plot import evaluation_png
from psfcore.transit.transit import Kernel
from workers.catalogue import PsfRow, ReportRow
from workers.context import Context
from workers.contract import ResolvedEvaluate, evaluate_identity
from workers.psf_fit_task import load_transit, write_json
from workers.settings import library_versions, software_version

KIND = "evaluate"
POINT_PX = 17


def evaluate(context: Context, parameters: Mapping[str, Any]) -> str:
    """Make a report on a transit; returns its id."""
    request = ResolvedEvaluate.model_validate(parameters)
    identity = evaluate_identity(request)
    if context.catalogue.get(ReportRow, identity, context.owner) is not None:
        return identity
    psf = _given_psf(context, request)
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


def _given_psf(context: Context, request: ResolvedEvaluate) -> Psf | None:
    """The PSF that the request names, with what its file says of its parts and errors."""
    if request.psf_id is None:
        return None
    row = context.catalogue.get(PsfRow, request.psf_id, context.owner)
    if row is None:
        raise DataError("no-such-psf", f"the catalogue holds no PSF with id {request.psf_id}")
    return read_psf(context.store.path(row.file_sha256), context.limits)


def _point() -> Kernel:
    """A diffraction that does nothing: where a PSF is given it holds the diffraction, and nothing asks for more."""
    point = np.zeros((POINT_PX, POINT_PX))
    point[POINT_PX // 2, POINT_PX // 2] = 1.0
    return point


def _save(context: Context, request: ResolvedEvaluate, identity: str, report: PsfReport) -> None:
    """JSON, page and picture into the store, the row into the catalogue."""
    provenance = {
        "report_id": identity,
        "transit_sha256": request.transit_id,
        "parameters": request.model_dump(mode="json", exclude_none=True),
        "algorithm_version": request.algorithm_version,
        "software_version": software_version(),
        "libraries": library_versions(),
        "job_id": context.job_id,
    }
    said = report_json(report, provenance)
    with (
        context.store.temporary() as text,
        context.store.temporary() as page,
        context.store.temporary() as picture,
    ):
        write_json(text, said)
        page.write_text(page_of(report, provenance).html(), "utf-8")
        evaluation_png(report.evaluation, picture, title=report.how_judged, study=report.study)
        file_sha256 = context.store.keep(text)
        row = ReportRow(
            owner=context.owner,
            id=identity,
            created_at=time.time(),
            kind=KIND,
            transit_id=request.transit_id,
            file_sha256=file_sha256,
            bytes=context.store.path(file_sha256).stat().st_size,
            preview_sha256=context.store.keep(picture),
            details={
                "sentence": said["sentence"],
                "psf_id": request.psf_id,
                "page_sha256": context.store.keep(page),
                "held_out": report.held_out,
                "residuals": said["evaluation"]["all"],
                "not_shown": said["not_shown"],
                "limits": said["fit"]["limits"] if report.fit is not None else [],
            },
        )
    context.catalogue.add(row)
