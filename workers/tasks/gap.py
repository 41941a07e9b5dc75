"""The task ``gap-diagnose``: diagnoses the gap of an uploaded transit; the result is a report, and a corrected PSF if
effects explain the gap.

The gap is the rms of the residuals of the images, with the expected noise subtracted in quadrature. For the
corrected PSF the fit is repeated with the effects of the answer in the model.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from psfcore.errors import DataError, module_of_extra
from psfcore.gap.corrected_psf import corrected_psf
from psfcore.gap.diagnose import Diagnosis, diagnose, start_of
from psfcore.gap.effect_sources import library_sha256
from psfcore.gap.field_terms import held_out_gaps
from psfcore.gap.library.registry import Added, added_effects, library_with
from psfcore.gap.report.report import gap_report
from psfcore.psf import Psf
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from workers.contract.identities import corrected_psf_identity, diffraction_identity
from workers.contract.requests import ResolvedGapDiagnose
from workers.tasks.results import provenance_of, psf_result, report_result
from workers.tasks.transits import load_transit
from workers.tasks.workspace import Workspace, task_of

KIND = "gap"
_SHOWN = ("sentence", "lines", "verdict", "answer", "gap", "cautions")


@task_of("gap-diagnose")
def gap_diagnose(workspace: Workspace, request: ResolvedGapDiagnose, identity: str) -> None:
    """Diagnose the gap of a transit, and add the report. If the request asks for it and effects were found, the
    corrected PSF is another result.
    """
    added = _added(workspace, request)
    parent = None if request.psf_id is None else workspace.psf(request.psf_id)
    transit, _ = load_transit(workspace, request)
    shape, start = (SOFTENED_POWER_LAW, None) if parent is None else start_of(parent)
    found = diagnose(
        transit,
        library=library_with(added),
        shape=shape,
        start=start,
        seed=request.seed,
        coverage=request.coverage,
        threads=workspace.threads,
        progress=workspace.report,
        solution=workspace.inverter(request),
    )
    provenance = {"report_id": identity, **_provenance(request, parent, added, workspace.job_id)}
    corrected_id, gaps, refit = None, None, found.corrected
    if request.correct and refit is not None:
        try:
            corrected = _corrected(found, provenance)
        except DataError as error:
            # An added effect may be defined for images but not for a point source. The diagnosis itself remains valid.
            caution = f"The corrected PSF could not be made: {error.message}"
            found = replace(found, cautions=(*found.cautions, caution))
        else:
            corrected_id = corrected.provenance["psf_id"]
            if corrected.field_terms:
                gaps = held_out_gaps(
                    found.solution, found.model, refit, seed=request.seed, progress=workspace.report
                )
            parents = corrected.provenance["parents"]
            details = {
                "transit_id": parents["transit"],
                "parents": parents,
                "diffraction_psf_id": corrected.provenance["diffraction_psf_id"],
            }
            workspace.add(
                psf_result(
                    corrected, corrected_id, origin="fitted", details=details, threads=workspace.threads
                )
            )
    content = gap_report(found)
    content["provenance"] = provenance | {"corrected_psf_id": corrected_id}
    if gaps is not None:
        content["psf"]["held_out_with_terms"] = gaps.to_json()
    workspace.add(
        report_result(
            identity,
            KIND,
            content,
            {
                **{name: value for name, value in content.items() if name in _SHOWN},
                "strongest_axis": content["where"][0]["axis"],
                "psf_id": request.psf_id,
                "corrected_psf_id": corrected_id,
            },
            draw=lambda path: path.write_bytes(
                module_of_extra("psfcore.gap.report.plot").gap_png(found, content)
            ),
            page=lambda: module_of_extra("psfcore.gap.report.page").gap_page(found, content),
            transit_id=request.transit_id,
        )
    )


def _added(workspace: Workspace, request: ResolvedGapDiagnose) -> tuple[Added, ...]:
    """The effects that the operator added. A worker runs only the code that its own settings name, never code from a
    job.

    Raises DataError "effects-changed" if the effects have changed since the job was submitted.
    """
    if request.added_effects != workspace.settings.added_effects:
        raise DataError(
            "effects-changed",
            f"expected the added effects of the job ({', '.join(request.added_effects) or 'none'}); this worker has "
            f"{', '.join(workspace.settings.added_effects) or 'none'}: submit the job again",
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
    request: ResolvedGapDiagnose, parent: Psf | None, added: tuple[Added, ...], job_id: str
) -> dict[str, object]:
    started = (
        None if parent is None else {"name": parent.name, "version": parent.version, "id": request.psf_id}
    )
    return {
        "started_from_psf": started,
        "diffraction_psf_id": diffraction_identity(request),
        "seed": request.seed,
        "library_sha256": library_sha256(),
        "added_effects": {one.source: one.sha256 for one in added},
        **provenance_of(job_id, request),
    }


def _corrected(found: Diagnosis, provenance: dict[str, Any]) -> Psf:
    report_id = provenance["report_id"]
    identity = corrected_psf_identity(report_id)
    parents = {"transit": provenance["transit_sha256"], "report": report_id}
    if provenance["started_from_psf"] is not None:
        parents["psf"] = provenance["started_from_psf"]["id"]
    return corrected_psf(
        found,
        name=f"{found.solution.transit.instrument or 'transit'}-gap-corrected",
        version=f"0.1.0+{identity[:8]}",
        provenance={"psf_id": identity, "parents": parents, **provenance},
    )
