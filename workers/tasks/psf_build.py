"""The task ``psf-build``: an instrument file in, a PSF version out."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.build import build_psf
from psfcore.drawing import plots
from psfcore.errors import DataError
from psfcore.fits.images import read_image
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.instruments.model import Instrument, parse_instrument
from psfcore.psf import Psf, cumulative_curve
from psfcore.tables.make import tables_of
from workers.catalogue.tables import PsfRow
from workers.contract.identities import instrument_text, psf_identity
from workers.contract.requests import PsfBuild
from workers.contract.resolved import ResolvedDeconvolve
from workers.files.store import Store
from workers.settings import library_versions, software_version
from workers.tasks.context import Context
from workers.versions.series import TOTAL, channel_of, line_of
from workers.versions.status import PsfStatus

CURVE_RADII_PX = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def psf_build(context: Context, parameters: Mapping[str, Any]) -> str:
    """Build a PSF from an instrument file and add it to the catalogue; returns its id."""
    return built_psf(context, PsfBuild.model_validate(parameters)).id


def named_psf(context: Context, psf_id: str) -> PsfRow:
    """The catalogue's row of a PSF. Raises DataError "no-such-psf"."""
    row = context.catalogue.get(PsfRow, psf_id, context.owner)
    if row is None:
        raise DataError("no-such-psf", f"the catalogue holds no PSF with id {psf_id}")
    return row


def given_psf(context: Context, psf_id: str | None) -> Psf | None:
    """The PSF that a request may name, with what its file says of its parts and errors."""
    if psf_id is None:
        return None
    return read_psf(context.store.path(named_psf(context, psf_id).file_sha256), context.limits)


def psf_of(context: Context, request: ResolvedDeconvolve) -> PsfRow:
    """The PSF that a deconvolution names; built first where only its recipe is there."""
    row = context.catalogue.get(PsfRow, request.psf_id, context.owner)
    if row is not None:
        return row
    if request.psf_recipe is None:
        raise DataError("no-such-psf", f"the catalogue holds no PSF with id {request.psf_id}")
    row = built_psf(context, request.psf_recipe)
    if row.id != request.psf_id:
        raise DataError(
            "instrument-changed",
            f"the instrument file of {request.psf_recipe.instrument} changed since the job was taken: "
            f"expected PSF {request.psf_id}, got {row.id}; submit the job again",
        )
    return row


def built_psf(context: Context, build: PsfBuild) -> PsfRow:
    """The PSF of a recipe: the one that was built before, or built now and added to the catalogue."""
    identity = psf_identity(build)
    row = context.catalogue.get(PsfRow, identity, context.owner)
    if row is not None:
        return row
    text = instrument_text(build)
    instrument = parse_instrument(text, build.instrument or "instrument_file")
    psf = build_psf(
        instrument,
        size=build.size,
        component=build.component and build.component.upper(),
        mount_image=_mount_image(context, build, instrument),
        threads=context.settings.threads,
        progress=lambda step, steps: context.report("building the PSF", step, steps),
    )
    psf = dataclasses.replace(
        psf,
        version=f"{psf.version}+{identity[:8]}",
        provenance={
            **psf.provenance,
            "psf_id": identity,
            "instrument_file_sha256": hashlib.sha256(text.encode()).hexdigest(),
            "parameters": build.model_dump(mode="json", exclude={"instrument_file"}, exclude_none=True),
            "algorithm_version": build.algorithm_version,
            "software_version": software_version(),
        },
    )
    with context.store.temporary() as path, context.store.temporary() as picture:
        write_psf(path, psf, instrument_file=text.encode())
        plots.psf_png(psf, picture)
        row = psf_row(
            psf,
            identity,
            context.owner,
            origin="built",
            file_sha256=context.store.keep(path),
            store=context.store,
            preview_sha256=context.store.keep(picture),
            kind=build.component or TOTAL,
            details={"job_id": context.job_id, "libraries": library_versions()},
            threads=context.settings.threads,
        )
    return context.catalogue.add(row)[0]


def _mount_image(context: Context, build: PsfBuild, instrument: Instrument) -> NDArray[np.float64] | None:
    """The pixels of the mask image that the instrument's mount names, which the user uploaded."""
    named = None if instrument.mount is None else instrument.mount.mask_image
    if named is None and build.mask_id is None:
        return None
    if named is None:
        raise DataError(
            "mask-not-named", "mask_id: expected an instrument file with mount.mask_image; got none"
        )
    if build.mask_id is None:
        raise DataError(
            "mask-missing",
            f"mount.mask_image: expected {named.file} to be uploaded and its id given as mask_id; got none",
        )
    return read_image(context.store.path(build.mask_id), context.limits).pixels


def psf_row(
    psf: Psf,
    identity: str,
    owner: str,
    *,
    origin: str,
    file_sha256: str,
    store: Store,
    preview_sha256: str | None,
    kind: str = TOTAL,
    details: Mapping[str, Any] | None = None,
    threads: int = 1,
) -> PsfRow:
    """The catalogue's row, a draft, of a PSF whose file is in the store, where its tables are put too.

    details: more than can be read off its kernel.
    """
    channel = channel_of(psf.instrument, psf.wavelength_angstrom)
    curve = cumulative_curve(psf.kernel, np.array(CURVE_RADII_PX, dtype=float))
    return PsfRow(
        owner=owner,
        id=identity,
        created_at=time.time(),
        name=psf.name,
        version=psf.version,
        instrument=psf.instrument,
        channel=channel,
        kind=kind,
        line=line_of(psf.instrument, channel, kind),
        status=PsfStatus.DRAFT,
        origin=origin,
        file_sha256=file_sha256,
        bytes=store.path(file_sha256).stat().st_size,
        preview_sha256=preview_sha256,
        details={
            "shape": list(psf.kernel.shape),
            "sum": float(psf.kernel.sum()),
            "plate_scale_arcsec": psf.plate_scale_arcsec,
            "wavelength_angstrom": psf.wavelength_angstrom,
            "components": sorted(psf.components),
            "cumulative_curve_pct": {str(r): float(c) for r, c in zip(CURVE_RADII_PX, curve, strict=True)},
            "provenance": psf.provenance,
            "tables_sha256": keep_tables(psf, store, threads),
            **(details or {}),
        },
    )


def keep_tables(psf: Psf, store: Store, threads: int) -> str:
    """Write the tables that questions about a PSF are answered from; returns their file's SHA-256."""
    with store.temporary() as path:
        path.write_text(json.dumps(tables_of(psf, threads=threads), separators=(",", ":"), allow_nan=False))
        return store.keep(path)
