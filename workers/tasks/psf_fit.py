"""The task ``psf-fit``: fits the scatter to an uploaded transit; the result is a PSF with its errors and a report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from psfcore.fits.psfs import write_psf
from psfcore.scatter.fit import TransitFit, fit_transit, fitted_psf
from psfcore.scatter.fit_plot import fit_png
from psfcore.scatter.report import fit_json
from psfcore.transit.prepare import Prepared
from workers.catalogue.tables import PsfRow
from workers.contract.identities import diffraction_identity, psf_fit_identity
from workers.contract.requests import ResolvedPsfFit
from workers.tasks.context import Context
from workers.tasks.data.psfs import psf_row
from workers.tasks.data.reports import provenance_of, write_json
from workers.tasks.data.solutions import solver
from workers.tasks.transits import load_transit


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
    _save(context, request, identity, fit, prepared)
    return identity


def _save(
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
    with (
        context.store.temporary() as file,
        context.store.temporary() as picture,
        context.store.temporary() as text,
    ):
        write_psf(file, psf)
        fit_png(fit, picture)
        write_json(text, said)
        row = psf_row(
            psf,
            identity,
            context.owner,
            origin="fitted",
            file_sha256=context.store.keep(file),
            store=context.store,
            preview_sha256=context.store.keep(picture),
            details={
                "transit_id": request.transit_id,
                "diffraction_psf_id": diffraction_identity(request),
                "report_sha256": context.store.keep(text),
                "fit": {
                    key: said[key]
                    for key in (
                        "sentence",
                        "shape",
                        "parameters",
                        "curve",
                        "chi2_per_pixel",
                        "converged",
                        "limits",
                    )
                },
            },
            threads=context.settings.threads,
        )
    context.add(row)
