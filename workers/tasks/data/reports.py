"""Saving reports: their provenance, their files in the store, and their row in the catalogue."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
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
    content: Mapping[str, Any],
    *,
    details: Mapping[str, Any],
    draw: Callable[[Path], object] | None = None,
    page: str | None = None,
    transit_id: str | None = None,
    about_id: str | None = None,
) -> None:
    """Write the files of a report into the store, and add a row with these details to the catalogue.

    content: the report as JSON. details: the entry "sentence" and the main figures; lists of reports show them. draw:
    draws the picture of the report. page: the report as HTML. transit_id, about_id: the transit, or the PSF or product,
    that the report is about; reports can be listed by these ids.
    Raises ValueError as ``keep_json``.
    """
    store = context.store
    with store.temporary() as picture, store.temporary() as html:
        if draw is not None:
            draw(picture)
        if page is not None:
            html.write_text(page, "utf-8")
            details = {**details, "page_sha256": store.keep(html)}
        file_sha256 = keep_json(context, content)
        context.add(
            ReportRow(
                owner=context.owner,
                id=identity,
                created_at=time.time(),
                kind=kind,
                transit_id=transit_id,
                about_id=about_id,
                file_sha256=file_sha256,
                bytes=store.path(file_sha256).stat().st_size,
                preview_sha256=None if draw is None else store.keep(picture),
                details=dict(details),
            )
        )


def keep_json(context: Context, content: Mapping[str, Any]) -> str:
    """Write indented JSON into the store; returns the SHA-256 of the file. Raises ValueError for NaN and infinity, which
    JSON does not have."""
    with context.store.temporary() as text:
        text.write_text(json.dumps(content, indent=1, allow_nan=False), "utf-8")
        return context.store.keep(text)
