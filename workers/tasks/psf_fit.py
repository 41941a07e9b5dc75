"""The task ``psf-fit``: fits the scatter to an uploaded transit; the result is a PSF with its errors and a report."""

from __future__ import annotations

from psfcore.errors import module_of_extra
from psfcore.gap.field_fit import fit_field
from psfcore.scatter.fit import fit_json, fit_transit, fitted_psf
from workers.contract.identities import diffraction_identity
from workers.contract.requests import ResolvedPsfFit
from workers.tasks.results import provenance_of, psf_result
from workers.tasks.transits import load_transit
from workers.tasks.workspace import Workspace, task_of

_SHOWN = ("sentence", "shape", "parameters", "curve", "chi2_per_pixel", "converged", "limits", "field")


@task_of("psf-fit")
def psf_fit(workspace: Workspace, request: ResolvedPsfFit, identity: str) -> None:
    """Fit the scatter to a transit, and add the fitted PSF."""
    transit, prepared = load_transit(workspace, request)
    fit = fit_transit(
        transit,
        shape=request.shape,
        as_published=request.as_published,
        seed=request.seed,
        threads=workspace.threads,
        progress=workspace.report,
        solution=workspace.inverter(request),
    )
    provenance = {
        "psf_id": identity,
        "inputs_sha256": transit.sha256,
        **provenance_of(workspace.job_id, request),
    }
    name = f"{transit.instrument or 'transit'}-fitted"
    version = f"0.1.0+{identity[:8]}"
    report = fit_json(fit) | {"prepared": prepared.to_json(), "provenance": provenance}
    if request.field:
        field = fit_field(fit.solution, seed=request.seed, progress=workspace.report)
        psf = field.psf(name, version, provenance)
        report["field"] = field.to_json()
    else:
        psf = fitted_psf(fit, name=name, version=version, provenance=provenance)
    details = {
        "transit_id": request.transit_id,
        "diffraction_psf_id": diffraction_identity(request),
        "fit": {key: report[key] for key in _SHOWN if key in report},
    }
    workspace.add(
        psf_result(
            psf,
            identity,
            origin="fitted",
            draw=lambda path: module_of_extra("psfcore.scatter.plots").fit_png(fit, path),
            report=report,
            details=details,
            threads=workspace.threads,
        )
    )
