"""The task ``psf-tables``: makes the tables and the picture of a PSF that has none yet, for example an uploaded PSF."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from psfcore.drawing.plots import psf_png
from psfcore.fits.psfs import read_psf
from workers.contract.requests import PsfTables
from workers.tasks.context import Context
from workers.tasks.data.psfs import keep_tables, named_psf


def psf_tables(context: Context, parameters: Mapping[str, Any]) -> str:
    """Make the tables of a PSF of the catalogue, and its picture if it is missing; returns the PSF's id."""
    request = PsfTables.model_validate(parameters)
    row = named_psf(context, request.psf_id)
    context.report("reading", 0, 3)
    psf = read_psf(context.store.verified(row.file_sha256), context.limits)
    context.report("making tables", 1, 3)
    tables_sha256 = keep_tables(psf, context.store, context.settings.threads)
    context.report("drawing", 2, 3)
    with context.store.temporary() as picture:
        preview_sha256 = row.preview_sha256
        if preview_sha256 is None or context.store.size(preview_sha256) is None:
            psf_png(psf, picture)
            preview_sha256 = context.store.keep(picture)
    context.report("drawing", 3, 3)
    context.catalogue.psfs.describe(
        row.id, context.owner, tables_sha256=tables_sha256, preview_sha256=preview_sha256
    )
    return row.id
