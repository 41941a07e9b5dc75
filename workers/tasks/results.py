"""Results of tasks: PSFs and reports, and the provenance that they name."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from psfcore.errors import module_of_extra
from psfcore.fits.psfs import write_psf
from psfcore.psf import Psf, field_map, light_beyond_pct
from workers.contract.kinds import ResultType
from workers.contract.requests import Parameters
from workers.settings import library_versions, software_version
from workers.tasks.workspace import Result
from workers.versions import TOTAL, PsfStatus, channel_of, series_of

if TYPE_CHECKING:
    from psfcore.drawing.page import Page

Write = Callable[[Path], object]


def psf_result(
    psf: Psf,
    identity: str,
    *,
    origin: str,
    details: Mapping[str, object],
    threads: int,
    draw: Write | None = None,
    kind: str = TOTAL,
    channel: str | None = None,
    write: Write | None = None,
    report: Mapping[str, object] | None = None,
) -> Result:
    """A draft PSF.

    Parameters
    ----------
    write
        Function that writes the file of the PSF; None: `write_psf`.
    draw
        Function that draws the picture of the PSF into a PNG file; None: the picture shows the PSF and its curves.
    channel
        Channel of the PSF; None: the channel that the PSF states.
    details
        Further entries of the details of the PSF.
    report
        Report of the fit, as JSON.
    threads
        Number of threads for the tables of the PSF.
    """
    channel = channel or channel_of(psf.instrument, psf.wavelength_angstrom)
    return Result(
        ResultType.PSF,
        identity,
        {
            "shape": list(psf.kernel.shape),
            "sum": float(psf.kernel.sum()),
            "plate_scale_arcsec": psf.plate_scale_arcsec,
            "wavelength_angstrom": psf.wavelength_angstrom,
            "components": sorted(psf.components),
            **({"field": field_map(psf)} if psf.field_terms else {}),
            "cumulative_curve_pct": light_beyond_pct(psf.kernel),
            "provenance": psf.provenance,
            **details,
        },
        {
            "file": write or partial(write_psf, psf=psf),
            "preview": draw or (lambda path: module_of_extra("psfcore.drawing.plots").psf_png(psf, path)),
            "tables": partial(write_tables, psf=psf, threads=threads),
            **({} if report is None else {"report": partial(write_json, content=report)}),
        },
        {
            "name": psf.name,
            "version": psf.version,
            "instrument": psf.instrument,
            "channel": channel,
            "kind": kind,
            "series": series_of(psf.instrument, channel, kind),
            "status": PsfStatus.DRAFT,
            "origin": origin,
        },
    )


def write_tables(path: Path, *, psf: Psf, threads: int) -> None:
    """Write the tables from which the service answers queries about a PSF."""
    # A deconvolution makes no tables, and does not load the libraries for them.
    from psfcore.tables.make import tables_of

    path.write_text(json.dumps(tables_of(psf, threads=threads), separators=(",", ":"), allow_nan=False))


def report_result(
    identity: str,
    kind: str,
    content: Mapping[str, object],
    details: Mapping[str, object],
    *,
    draw: Write | None = None,
    page: Callable[[], Page] | None = None,
    transit_id: str | None = None,
    about_id: str | None = None,
) -> Result:
    """A report.

    Parameters
    ----------
    content
        JSON of the report.
    details
        The entry "sentence" and the main figures; lists of reports show them.
    draw, page
        Functions that make the picture (PNG) and the page (HTML) of the report.
    transit_id, about_id
        Id of the transit, or of the PSF or product, that the report describes.
    """
    files: dict[str, Write] = {"file": partial(write_json, content=content)}
    if draw is not None:
        files["preview"] = draw
    columns = {"kind": kind, "transit_id": transit_id, "about_id": about_id}
    if page is None:
        return Result(ResultType.REPORT, identity, details, files, columns)
    drawn = cache(page)
    files["html"] = lambda path: path.write_text(drawn().html, "utf-8")
    files["texts"] = lambda path: path.write_text(json.dumps(drawn().texts), "utf-8")
    return Result(ResultType.REPORT, identity, details, files, columns, lambda: drawn().figures)


def provenance_of(job_id: str, request: Parameters) -> dict[str, object]:
    """The inputs, parameters and software versions with which a job makes its result. ``request`` contains the resolved
    parameters.
    """
    transit_id = getattr(request, "transit_id", None)
    return {
        **({} if transit_id is None else {"transit_sha256": transit_id}),
        "parameters": request.model_dump(mode="json", exclude_none=True),
        "algorithm_version": request.algorithm_version,
        "software_version": software_version(),
        "libraries": library_versions(),
        "job_id": job_id,
    }


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write indented JSON. Raises ValueError for NaN and infinity, which JSON does not have."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False), "utf-8")
