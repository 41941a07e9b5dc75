"""Saving reports: their provenance, their files in the store, and their row in the catalogue."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from workers.catalogue.tables import ReportRow
from workers.contract.requests import Parameters
from workers.settings import library_versions, software_version
from workers.tasks.context import Context


def provenance_of(context: Context, request: Parameters) -> dict[str, Any]:
    """The inputs, parameters and software versions with which a job makes its result. request: the resolved parameters."""
    transit_id = getattr(request, "transit_id", None)
    return {
        **({} if transit_id is None else {"transit_sha256": transit_id}),
        "parameters": request.model_dump(mode="json", exclude_none=True),
        "algorithm_version": request.algorithm_version,
        "software_version": software_version(),
        "libraries": library_versions(),
        "job_id": context.job_id,
    }


def keep_report(
    context: Context,
    identity: str,
    kind: str,
    *,
    text: Path,
    details: Mapping[str, Any],
    picture: Path | None = None,
    page: Path | None = None,
    transit_id: str | None = None,
    about_id: str | None = None,
) -> None:
    """Move the written files of a report into the store, and add a row with these details to the catalogue.

    text: the report as JSON. details: the entry "sentence" and the main figures; lists of reports show them. transit_id,
    about_id: the transit, or the PSF or product, that the report is about; reports can be listed by these ids.
    """
    file_sha256 = context.store.keep(text)
    of_page = {} if page is None else {"page_sha256": context.store.keep(page)}
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
            preview_sha256=None if picture is None else context.store.keep(picture),
            details={**details, **of_page},
        )
    )


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write indented JSON. Raises ValueError for NaN and infinity, which JSON does not have."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False), "utf-8")
