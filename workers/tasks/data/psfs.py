"""Reading PSFs of the catalogue and adding new ones to it, shared by the tasks."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from psfcore.fits.psfs import read_psf
from psfcore.psf import Psf, cumulative_curve
from workers.catalogue.tables import PsfRow
from workers.files.store import Store
from workers.rows import row_of
from workers.tasks.context import Context
from workers.versions import TOTAL, PsfStatus, channel_of, series_of

_TOTAL_ALONE = "total_alone"  # an entry of the details of a row
CURVE_RADII_PX = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def named_psf(context: Context, psf_id: str) -> PsfRow:
    """The catalogue's row of a PSF. Raises DataError "no-such-psf"."""
    return row_of(context.catalogue, PsfRow, psf_id, context.owner)


def given_psf(context: Context, psf_id: str | None) -> Psf | None:
    """The PSF that a request names, with its components and errors; None if the request names no PSF.

    Raises DataError "no-such-psf".
    """
    if psf_id is None:
        return None
    return read_psf(context.store.verified(named_psf(context, psf_id).file_sha256), context.limits)


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
    whole: bool = True,
) -> PsfRow:
    """The catalogue's row of a draft PSF whose file is in the store. Writes the PSF's tables into the store too.

    details: further entries for the details of the row. whole: False if the file holds the total PSF alone, although the
    PSF has components; no tables are made then.
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
        series=series_of(psf.instrument, channel, kind),
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
            **({"tables_sha256": keep_tables(psf, store, threads)} if whole else {_TOTAL_ALONE: True}),
            **(details or {}),
        },
    )


def is_total_alone(row: PsfRow) -> bool:
    """Whether the file of a PSF was written without the components that the PSF has."""
    return bool(row.details.get(_TOTAL_ALONE))


def keep_tables(psf: Psf, store: Store, threads: int) -> str:
    """Write the tables from which the service answers queries about a PSF; returns the SHA-256 of their file."""
    # A deconvolution makes no tables, and does not load the libraries for them.
    from psfcore.tables.make import tables_of

    with store.temporary() as path:
        path.write_text(json.dumps(tables_of(psf, threads=threads), separators=(",", ":"), allow_nan=False))
        return store.keep(path)
