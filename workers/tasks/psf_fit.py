"""The task ``psf-fit``: an uploaded transit in, a PSF version with its errors and its report out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from psfcore.errors import DataError
from psfcore.fits.fits_io import read_psf, write_psf
from psfcore.noise import Noise
from psfcore.scatter.fit import TransitFit, fit_transit, psf_of, report
from psfcore.scatter.fit_plot import fit_png
from psfcore.transit.folder import read_prepared
from psfcore.transit.prepare import Prepared
from psfcore.transit.transit import Kernel, Transit
from workers.catalogue.tables import PsfRow, TransitRow
from workers.contract.contract import (
    ResolvedOnTransit,
    ResolvedPsfFit,
    diffraction_identity,
    psf_fit_identity,
)
from workers.tasks.context import Context
from workers.tasks.keep_report import provenance_of, write_json
from workers.tasks.psf_build import built_psf, psf_row


def psf_fit(context: Context, parameters: Mapping[str, Any]) -> str:
    """Fit a transit and add the PSF to the catalogue; returns its id."""
    request = ResolvedPsfFit.model_validate(parameters)
    identity = psf_fit_identity(request)
    if context.catalogue.get(PsfRow, identity, context.owner) is not None:
        return identity
    transit, prepared = load_transit(context, request)
    fit = fit_transit(
        transit,
        shape=request.shape,
        as_published=request.as_published,
        seed=request.seed,
        threads=context.settings.threads,
        progress=context.report,
    )
    _save(context, request, identity, fit, prepared)
    return identity


def load_transit(
    context: Context,
    request: ResolvedOnTransit,
    *,
    diffraction: Kernel | None = None,
) -> tuple[Transit, Prepared]:
    """The transit of a request, unpacked, read and prepared.

    diffraction: where the transit brings none; none: built as the request says.
    """
    upload = context.catalogue.get(TransitRow, request.transit_id, context.owner)
    if upload is None:
        raise DataError("no-such-transit", f"no transit was uploaded with id {request.transit_id}")
    images = int(upload.summary["images"])
    context.report("reading", 0, images)
    with context.store.unpacked(request.transit_id, context.settings.archive_limits) as folder:
        return read_prepared(
            folder,
            context.limits,
            progress=lambda done, of: context.report("reading", done, of),
            diffraction=lambda _instrument, _shape: (
                _built_diffraction(context, request) if diffraction is None else diffraction
            ),
            noise=None if request.noise is None else Noise(**request.noise.model_dump()),
            saturation_dn=request.saturation_dn,
        )


def _built_diffraction(
    context: Context,
    request: ResolvedOnTransit,
) -> Kernel:
    """The diffraction of the transit's instrument, built now or before; cut to nothing, it sums to 1 on 2048 px."""
    if request.diffraction_recipe is None:
        raise DataError("no-known-psf", "expected known_psf in transit.json; got none")
    row = built_psf(context, request.diffraction_recipe)
    return read_psf(context.store.path(row.file_sha256), context.limits, parts=False).kernel


def _save(
    context: Context, request: ResolvedPsfFit, identity: str, fit: TransitFit, prepared: Prepared
) -> None:
    """The PSF's file, its report and its picture into the store, its row into the catalogue."""
    provenance = {
        "psf_id": identity,
        "inputs_sha256": fit.transit.sha256,
        **provenance_of(context, request),
    }
    name = f"{fit.transit.instrument or 'transit'}-fitted"
    psf = psf_of(fit, name=name, version=f"0.1.0+{identity[:8]}", provenance=provenance)
    said = report(fit) | {"prepared": prepared.to_json(), "provenance": provenance}
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
    context.catalogue.add(row)
