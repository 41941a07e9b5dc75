"""The task ``psf-tables``: makes the tables and the picture of a PSF that has none yet, for example an uploaded PSF."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from psfcore.errors import module_of_extra
from workers.catalogue.tables import PsfRow
from workers.contract.requests import PsfTables
from workers.tasks.catalogue_workspace import CatalogueWorkspace
from workers.tasks.results import write_tables


def psf_tables(workspace: CatalogueWorkspace, parameters: Mapping[str, object]) -> str:
    """Make the tables of a PSF of the catalogue, and its picture if it is missing; returns the PSF's id."""
    row = workspace.row(PsfRow, PsfTables.model_validate(parameters).psf_id)
    workspace.report("reading", 0, 3)
    psf = workspace.psf_of(row)
    workspace.report("making tables", 1, 3)
    write = partial(write_tables, psf=psf, threads=workspace.threads)
    tables_sha256, _ = workspace.write(write)
    workspace.report("drawing", 2, 3)
    preview_sha256 = row.preview_sha256
    if preview_sha256 is None or workspace.store.size(preview_sha256) is None:
        draw = module_of_extra("psfcore.drawing.plots").psf_png
        preview_sha256, _ = workspace.write(partial(draw, psf))
    workspace.report("drawing", 3, 3)
    workspace.catalogue.psfs.describe(
        row.id, workspace.owner, tables_sha256=tables_sha256, preview_sha256=preview_sha256
    )
    return row.id
