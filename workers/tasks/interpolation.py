"""The task ``psf-interpolate``: interpolates between two fitted PSFs in time; the result is a PSF with its errors."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import numpy as np

from psfcore.psf import CURVE_RADII_PX, Psf, cumulative_curve
from psfcore.scatter.interpolation import Epoch, curve_sigma, interpolated_psf, parameters_of
from workers.catalogue.tables import PsfRow
from workers.contract.requests import PsfInterpolate
from workers.intake.compatibility import of_upload
from workers.tasks.catalogue_workspace import CatalogueWorkspace
from workers.tasks.results import provenance_of, psf_result
from workers.tasks.workspace import task_of
from workers.versions import INTERPOLATED, interpolated_name

STAGE = "interpolating the PSF"


@task_of("psf-interpolate")
def psf_interpolate(workspace: CatalogueWorkspace, request: PsfInterpolate, identity: str) -> None:
    """Interpolate between two PSFs of the catalogue, and add the new PSF to it.

    Raises DataError "no-such-psf", and the errors of ``psfcore.scatter.interpolation.interpolated_psf``.
    """
    workspace.report(STAGE, 0, 2)
    ends = {
        "before": _epoch(workspace, request.before_psf_id, request.before_time),
        "after": _epoch(workspace, request.after_psf_id, request.after_time),
    }
    name, version = interpolated_name(ends["before"].psf.instrument, identity)
    # The id of the job is in the details of the row, not in the file, so that the file can be made again bit for bit.
    provenance = {"psf_id": identity, **provenance_of(workspace.job_id, request)}
    del provenance["job_id"]
    psf = interpolated_psf(
        ends["before"],
        ends["after"],
        datetime.fromisoformat(request.time),
        name=name,
        version=version,
        provenance=provenance,
        threads=workspace.threads,
    )
    workspace.report(STAGE, 1, 2)
    parents = psf.provenance["interpolated_between"]
    details = {
        "parents": {name: end["psf_id"] for name, end in zip(("before", "after"), parents, strict=True)},
        "weights": {end["psf_id"]: end["weight"] for end in parents},
        "job_id": workspace.job_id,
        "fit": _fit_of(psf, workspace.threads),
    }
    # The files of the ends do not name the variant of the channel; their rows do.
    channel = workspace.row(PsfRow, request.before_psf_id).channel
    workspace.add(
        psf_result(
            psf, identity, origin=INTERPOLATED, channel=channel, details=details, threads=workspace.threads
        )
    )


def _epoch(workspace: CatalogueWorkspace, psf_id: str, time: str) -> Epoch:
    """A PSF of the catalogue, and the time at which it holds."""
    row = workspace.row(PsfRow, psf_id)
    psf = workspace.psf_of(row)
    # The request of an upload or of a certification may give an instrument and a channel that the file does not
    # contain.
    instrument, angstrom = of_upload(row, psf.instrument, psf.wavelength_angstrom)
    psf = replace(
        psf, name=row.name, version=row.version, instrument=instrument, wavelength_angstrom=angstrom
    )
    return Epoch(psf, datetime.fromisoformat(time), {"psf_id": row.id, "file_sha256": row.file_sha256})


def _fit_of(psf: Psf, threads: int) -> dict[str, object]:
    """The parameters and the curve with their errors, in the form of the details of a fitted PSF."""
    assert psf.fitted is not None
    radii = np.array([radius for radius in CURVE_RADII_PX if radius < psf.kernel.shape[0] // 2])
    curve, sigma = cumulative_curve(psf.kernel, radii), curve_sigma(psf, radii, threads=threads)
    before, after = psf.provenance["interpolated_between"]
    return {
        "sentence": f"Interpolated to {psf.provenance['interpolated_at']} between {before['name']} "
        f"{before['version']} (weight {before['weight']:.3f}) and {after['name']} {after['version']} (weight "
        f"{after['weight']:.3f}).",
        "shape": psf.fitted.shape,
        "parameters": parameters_of(psf.fitted),
        "curve": {
            "radii_px": radii.tolist(),
            "light_beyond_pct": curve.tolist(),
            "sigma": sigma.tolist(),
        },
    }
