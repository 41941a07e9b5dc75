"""Completes shortened ids in the addresses of requests: the first digits of an id stand for the id, if no other id begins with them."""

from __future__ import annotations

import re

from fastapi import Request

from service.http.problems import problem
from service.http.state import State
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.catalogue import ListedRow
from workers.catalogue.database import several_ids_fit
from workers.catalogue.tables import ImageRow, JobRow, ProductRow, PsfRow, ReportRow, TransitRow
from workers.contract.short_ids import SHORT_ID
from workers.rows import no_such

# The parts of addresses that are ids: the table, the name of the thing, and the digits of a whole id.
IDS: dict[str, tuple[type[ListedRow], str, int]] = {
    "image_id": (ImageRow, "image", 64),
    "transit_id": (TransitRow, "transit", 64),
    "psf_id": (PsfRow, "psf", 64),
    "other_id": (PsfRow, "psf", 64),
    "product_id": (ProductRow, "product", 64),
    "report_id": (ReportRow, "report", 64),
    "job_id": (JobRow, "job", 32),
    "bulk_id": (BulkRow, "bulk", 32),
}
_SHORT = re.compile(SHORT_ID)


def complete(request: Request, state: State, owner: str) -> None:
    """Replace each shortened id in the path of the request by the whole id.

    Raises ``Problem`` 404 if the owner has nothing whose id begins with these digits, and 409 with the candidates if the
    owner has several.
    """
    path = request.scope["path_params"]
    for part, text in path.items():
        if part not in IDS or not _SHORT.fullmatch(text):
            continue
        table, thing, digits = IDS[part]
        if len(text) >= digits:
            continue
        found = state.catalogue.ids_from(table, text, owner)
        if not found:
            raise problem(no_such(thing, text, shortened=True))
        if len(found) > 1:
            raise problem(several_ids_fit(text, found), candidates=found)
        path[part] = found[0]
