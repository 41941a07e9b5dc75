"""The task ``psf-fit``: fits the scatter to an uploaded transit; the result is a PSF with its errors and a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfcore.errors import module_of_extra
from psfcore.psf import Psf
from psfcore.scatter.fit import TransitFit, fit_json, fit_transit, fitted_psf
from psfcore.transit.prepare import Prepared
from psfcore.transit.transit import Transit
from workers.contract.identities import diffraction_identity, psf_fit_identity
from workers.contract.requests import ResolvedPsfFit
from workers.tasks.results import Means, keep_psf, provenance_of, write_json
from workers.tasks.transits import load_transit, means_of

if TYPE_CHECKING:
    from workers.tasks.context import Context

_SHOWN = ("sentence", "shape", "parameters", "curve", "chi2_per_pixel", "converged", "limits")


@dataclass(frozen=True)
class Fitted:
    """A fit and its PSF. report: the fit as JSON."""

    fit: TransitFit
    psf: Psf
    report: dict[str, Any]

    @property
    def details(self) -> dict[str, Any]:
        """The main figures of the fit, as JSON."""
        return {key: self.report[key] for key in _SHOWN}

    def draw(self, path: Path) -> None:
        """Draw the fit into a PNG file."""
        module_of_extra("psfcore.scatter.plots").fit_png(self.fit, path)


def psf_fit(context: Context, parameters: Mapping[str, Any]) -> str:
    """Fit the scatter to a transit and add the PSF to the catalogue; returns the PSF's id."""
    from workers.catalogue.tables import PsfRow  # a command with --local needs no catalogue

    request = ResolvedPsfFit.model_validate(parameters)
    identity = psf_fit_identity(request)
    if context.made(PsfRow, identity) is not None:
        return identity
    transit, prepared = load_transit(context, request)
    fitted = fit(request, transit, prepared, means_of(context, request))
    _save(context, request, identity, fitted)
    return identity


def fit(request: ResolvedPsfFit, transit: Transit, prepared: Prepared, means: Means) -> Fitted:
    """Fit a transit as a request says."""
    found = fit_transit(
        transit,
        shape=request.shape,
        as_published=request.as_published,
        seed=request.seed,
        threads=means.threads,
        progress=means.progress,
        solution=means.solution,
    )
    identity = psf_fit_identity(request)
    provenance = {
        "psf_id": identity,
        "inputs_sha256": transit.sha256,
        **provenance_of(means.job_id, request),
    }
    name = f"{transit.instrument or 'transit'}-fitted"
    psf = fitted_psf(found, name=name, version=f"0.1.0+{identity[:8]}", provenance=provenance)
    report = fit_json(found) | {"prepared": prepared.to_json(), "provenance": provenance}
    return Fitted(found, psf, report)


def _save(context: Context, request: ResolvedPsfFit, identity: str, fitted: Fitted) -> None:
    """Write the file, report and picture of the PSF into the store, and add the PSF's row to the catalogue."""
    with context.store.temporary() as text:
        write_json(text, fitted.report)
        details = {
            "transit_id": request.transit_id,
            "diffraction_psf_id": diffraction_identity(request),
            "report_sha256": context.store.keep(text),
            "fit": fitted.details,
        }
    keep_psf(context, fitted.psf, identity, origin="fitted", draw=fitted.draw, details=details)
