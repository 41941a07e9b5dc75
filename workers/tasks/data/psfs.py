"""Reading PSFs of the catalogue and adding new ones to it, shared by the tasks."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfcore.fits.psfs import read_psf, write_psf
from psfcore.psf import Psf, light_beyond_pct
from workers.rows import row_of
from workers.versions import TOTAL, PsfStatus, channel_of, series_of

if TYPE_CHECKING:
    from workers.catalogue.tables import PsfRow
    from workers.files.store import Store
    from workers.tasks.context import Context


def named_psf(context: Context, psf_id: str) -> PsfRow:
    """The catalogue's row of a PSF. Raises DataError "no-such-psf"."""
    from workers.catalogue.tables import PsfRow  # a command with --local needs no catalogue

    return row_of(context.catalogue, PsfRow, psf_id, context.owner)


def given_psf(context: Context, psf_id: str | None) -> Psf | None:
    """The PSF that a request names, with its components and errors; None if the request names no PSF.

    Raises DataError "no-such-psf".
    """
    if psf_id is None:
        return None
    return read_psf(
        context.store.verified(named_psf(context, psf_id).file_sha256), context.settings.psf_limits
    )


def keep_psf(
    context: Context,
    psf: Psf,
    identity: str,
    *,
    origin: str,
    draw: Callable[[Path], object],
    kind: str = TOTAL,
    channel: str | None = None,
    instrument_file: bytes | None = None,
    details: Mapping[str, Any],
) -> PsfRow:
    """Write a draft PSF, its picture and its tables into the store, and add its row to the catalogue.

    draw: draws the picture into a PNG file. channel: None: as the PSF says. details: further entries for the details of the row.
    """
    from workers.catalogue.tables import PsfRow  # a command with --local needs no catalogue

    store = context.store
    with store.temporary() as file, store.temporary() as picture:
        write_psf(file, psf, instrument_file=instrument_file)
        draw(picture)
        file_sha256, preview_sha256 = store.keep(file), store.keep(picture)
    channel = channel or channel_of(psf.instrument, psf.wavelength_angstrom)
    row = PsfRow(
        owner=context.owner,
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
            "cumulative_curve_pct": light_beyond_pct(psf.kernel),
            "provenance": psf.provenance,
            "tables_sha256": keep_tables(psf, store, context.settings.threads),
            **details,
        },
    )
    return context.add(row)


def keep_tables(psf: Psf, store: Store, threads: int) -> str:
    """Write the tables from which the service answers queries about a PSF; returns the SHA-256 of their file."""
    # A deconvolution makes no tables, and does not load the libraries for them.
    from psfcore.tables.make import tables_of

    with store.temporary() as path:
        path.write_text(json.dumps(tables_of(psf, threads=threads), separators=(",", ":"), allow_nan=False))
        return store.keep(path)
