"""The task ``gap-diagnose``: diagnoses the gap of an uploaded transit; the result is a report, and a corrected PSF if
effects explain the gap.

The gap is the rms of the residuals of the images, with the expected noise subtracted in quadrature. For the
corrected PSF the fit is repeated with the effects of the answer in the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from psfcore.drawing.plots import psf_png
from psfcore.errors import DataError
from psfcore.fits.psfs import write_psf
from psfcore.gap.corrected_psf import corrected_psf
from psfcore.gap.diagnose import Diagnosis, diagnose, start_of
from psfcore.gap.effect_sources import library_sha256
from psfcore.gap.library.added import Added, added_effects, library_with
from psfcore.gap.report.page import gap_page
from psfcore.gap.report.plot import gap_png
from psfcore.gap.report.report import gap_report
from psfcore.psf import Psf
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from workers.catalogue.tables import ReportRow
from workers.contract.identities import corrected_psf_identity, diffraction_identity, gap_identity
from workers.contract.requests import ResolvedGapDiagnose
from workers.tasks.context import Context
from workers.tasks.data.psfs import given_psf, psf_row
from workers.tasks.data.reports import keep_report, provenance_of, write_json
from workers.tasks.data.solutions import solver
from workers.tasks.transits import load_transit

KIND = "gap"


def gap_diagnose(context: Context, parameters: Mapping[str, Any]) -> str:
    """Diagnose the gap of a transit; returns the report's id."""
    request = ResolvedGapDiagnose.model_validate(parameters)
    identity = gap_identity(request)
    if context.made(ReportRow, identity) is not None:
        return identity
    added = _added(context, request)
    parent = given_psf(context, request.psf_id)
    shape, start = (SOFTENED_POWER_LAW, None) if parent is None else start_of(parent)
    transit, _ = load_transit(context, request)
    found = diagnose(
        transit,
        library=library_with(added),
        shape=shape,
        start=start,
        seed=request.seed,
        coverage=request.coverage,
        threads=context.settings.threads,
        progress=context.report,
        solution=solver(context, request),
    )
    provenance = _provenance(context, request, identity, parent, added)
    corrected = None
    if request.correct and found.corrected:
        try:
            corrected = _save_psf(context, identity, found, provenance)
        except DataError as error:
            # An added effect may be defined for images but not for a point source. The diagnosis itself remains valid.
            caution = f"The corrected PSF could not be made: {error.message}"
            found = replace(found, cautions=(*found.cautions, caution))
    _save(context, request, identity, found, provenance, corrected)
    return identity


def _added(context: Context, request: ResolvedGapDiagnose) -> tuple[Added, ...]:
    """The effects that the operator added. A worker runs only the code that its own settings name, never code from a
    job.

    Raises DataError "effects-changed" if the effects have changed since the job was submitted.
    """
    if request.added_effects != context.settings.added_effects:
        raise DataError(
            "effects-changed",
            f"expected the added effects of the job ({', '.join(request.added_effects) or 'none'}); this worker has "
            f"{', '.join(context.settings.added_effects) or 'none'}: submit the job again",
        )
    added = added_effects(request.added_effects)
    here = tuple(one.sha256 for one in added)
    if here != request.added_effects_sha256:
        raise DataError(
            "effects-changed",
            f"expected added effects whose files have the hashes {_short(request.added_effects_sha256)}; this worker's "
            f"files have {_short(here)}: submit the job again",
        )
    return added


def _short(hashes: tuple[str, ...]) -> str:
    return ", ".join(one[:12] for one in hashes) or "unknown"


def _provenance(
    context: Context,
    request: ResolvedGapDiagnose,
    identity: str,
    parent: Psf | None,
    added: tuple[Added, ...],
) -> dict[str, Any]:
    started = (
        None if parent is None else {"name": parent.name, "version": parent.version, "id": request.psf_id}
    )
    return {
        "report_id": identity,
        "started_from_psf": started,
        "diffraction_psf_id": diffraction_identity(request),
        "seed": request.seed,
        "library_sha256": library_sha256(),
        "added_effects": {one.source: one.sha256 for one in added},
        **provenance_of(context, request),
    }


def _save_psf(context: Context, report_id: str, found: Diagnosis, provenance: dict[str, Any]) -> str:
    """Save the corrected PSF, its tables and its picture as a new draft; returns its id."""
    identity = corrected_psf_identity(report_id)
    parents = {"transit": provenance["transit_sha256"], "report": report_id}
    if provenance["started_from_psf"] is not None:
        parents["psf"] = provenance["started_from_psf"]["id"]
    psf = corrected_psf(
        found,
        name=f"{found.solution.transit.instrument or 'transit'}-gap-corrected",
        version=f"0.1.0+{identity[:8]}",
        provenance={"psf_id": identity, "parents": parents, **provenance},
    )
    with context.store.temporary() as file, context.store.temporary() as picture:
        write_psf(file, psf)
        psf_png(psf, picture)
        row = psf_row(
            psf,
            identity,
            context.owner,
            origin="fitted",
            file_sha256=context.store.keep(file),
            store=context.store,
            preview_sha256=context.store.keep(picture),
            details={
                "transit_id": parents["transit"],
                "parents": parents,
                "diffraction_psf_id": provenance["diffraction_psf_id"],
            },
            threads=context.settings.threads,
        )
    context.add(row)
    return identity


def _save(
    context: Context,
    request: ResolvedGapDiagnose,
    identity: str,
    found: Diagnosis,
    provenance: dict[str, Any],
    corrected: str | None,
) -> None:
    """Write JSON, HTML page and picture into the store, and add the row to the catalogue."""
    said = gap_report(found) | {"provenance": provenance | {"corrected_psf_id": corrected}}
    with (
        context.store.temporary() as text,
        context.store.temporary() as page,
        context.store.temporary() as picture,
    ):
        write_json(text, said)
        page.write_text(gap_page(found, said), "utf-8")
        picture.write_bytes(gap_png(found, said))
        keep_report(
            context,
            identity,
            KIND,
            transit_id=request.transit_id,
            text=text,
            page=page,
            picture=picture,
            details={
                **{name: said[name] for name in ("sentence", "verdict", "answer", "gap", "cautions")},
                "strongest_axis": said["where"][0]["axis"],
                "psf_id": request.psf_id,
                "corrected_psf_id": corrected,
            },
        )
