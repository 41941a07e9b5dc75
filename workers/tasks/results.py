"""Results of tasks: PSFs and reports in the store and in the catalogue, and the provenance that they name."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfcore.fits.psfs import read_psf, write_psf
from psfcore.psf import Psf, light_beyond_pct
from workers.contract.requests import Parameters
from workers.rows import row_of
from workers.settings import library_versions, software_version
from workers.versions import TOTAL, PsfStatus, channel_of, series_of

if TYPE_CHECKING:
    from psfcore.drawing.page import Page
    from psfcore.scatter.inversion import Inverter, Progress
    from workers.catalogue.tables import PsfRow
    from workers.files.store import Store
    from workers.tasks.context import Context

# PSFs -----------------------------------------------------------------------------------------------


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


# Reports --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Means:
    """How a result is computed. job_id: the job that its provenance names. solution: gives the solution of the transit, see
    `psfcore.scatter.inversion.Inverter`; None: it is computed."""

    job_id: str
    threads: int
    progress: Progress
    solution: Inverter | None = None


@dataclass(frozen=True)
class Finished:
    """A finished report whose files are not yet written.

    content: the report as JSON. details: the entry "sentence" and the main figures; lists of reports show them. draw: draws its
    picture into a PNG file. page: makes the report as HTML; None if it has no page.
    """

    content: dict[str, Any]
    details: dict[str, Any]
    draw: Callable[[Path], object]
    page: Callable[[], Page] | None = None


def provenance_of(job_id: str, request: Parameters) -> dict[str, Any]:
    """The inputs, parameters and software versions with which a job makes its result. request: the resolved parameters."""
    transit_id = getattr(request, "transit_id", None)
    return {
        **({} if transit_id is None else {"transit_sha256": transit_id}),
        "parameters": request.model_dump(mode="json", exclude_none=True),
        "algorithm_version": request.algorithm_version,
        "software_version": software_version(),
        "libraries": library_versions(),
        "job_id": job_id,
    }


def report_made(context: Context, identity: str) -> bool:
    """Whether an earlier job has made the report with this identity."""
    from workers.catalogue.tables import ReportRow  # a command with --local needs no catalogue

    return context.made(ReportRow, identity) is not None


def keep_report(context: Context, identity: str, kind: str, report: Finished, *, transit_id: str) -> None:
    """Write the files of a report on a transit into the store, and add its row to the catalogue."""
    with context.store.temporary() as text, context.store.temporary() as picture:
        write_json(text, report.content)
        report.draw(picture)
        add_report(
            context,
            identity,
            kind,
            text=text,
            details=report.details | ({} if report.page is None else keep_page(report.page(), context.store)),
            preview_sha256=context.store.keep(picture),
            transit_id=transit_id,
        )


def keep_page(page: Page, store: Store) -> dict[str, Any]:
    """Write the page of a report into the store, its texts and its figures; returns the details that name these files."""

    def keep(content: bytes) -> str:
        with store.temporary() as path:
            path.write_bytes(content)
            return store.keep(path)

    return {
        "page_sha256": keep(page.html.encode()),
        "page_texts_sha256": keep(json.dumps(page.texts).encode()),
        "figures_sha256": [keep(png) for png in page.figures],
    }


def add_report(
    context: Context,
    identity: str,
    kind: str,
    *,
    text: Path,
    details: dict[str, Any],
    preview_sha256: str | None = None,
    transit_id: str | None = None,
    about_id: str | None = None,
) -> None:
    """Move the written JSON of a report into the store, and add its row to the catalogue.

    details: see `Finished`. transit_id, about_id: the transit, or the PSF or product, that the report is about; reports can be
    listed by these ids.
    """
    from workers.catalogue.tables import ReportRow  # a command with --local needs no catalogue

    file_sha256 = context.store.keep(text)
    context.add(
        ReportRow(
            owner=context.owner,
            id=identity,
            created_at=time.time(),
            kind=kind,
            transit_id=transit_id,
            about_id=about_id,
            file_sha256=file_sha256,
            bytes=context.store.path(file_sha256).stat().st_size,
            preview_sha256=preview_sha256,
            details=details,
        )
    )


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write indented JSON. Raises ValueError for NaN and infinity, which JSON does not have."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False), "utf-8")
