"""Lists of products and PSFs with the columns of ObsCore, as VOTable or JSON: ``/vo/products`` and ``/vo/psfs``.

The name of a product or PSF for VO clients is ``urn:heliopsf:product:ID`` or ``urn:heliopsf:psf:ID``. The names are in
lists, DataLink tables and provenance. A request may also give the bare id; if a product and a PSF had the same id, the
bare id would mean the product.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse

from psfcore.errors import DataError
from psfcore.fits.frame import plate_scale_arcsec
from psfcore.instruments.psf_statements import title
from service.http.callers import Caller, Reading
from service.http.paging import Listing, Row
from service.http.problems import Descriptions, Problem, RouteOptions
from service.http.state import Shared, State
from service.vo.parameters import (
    JSON,
    JSON_TYPE,
    VOTABLE,
    VOTABLE_TYPE,
    Fields,
    PlainErrors,
    base_url,
    format_of,
    integer,
    one,
    query,
)
from service.vo.votables import PRODUCTS, PSFS, Input, Service, Table, error_document, table_document
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow
from workers.lineage import NAMES
from workers.versions import iso, seconds

PRODUCT, PSF = "product", "psf"
TABLES_OF_NAMES: dict[str, type[Any]] = {PRODUCT: ProductRow, PSF: PsfRow}
NAME = re.compile(rf"(?:{NAMES}({PRODUCT}|{PSF}):)?([0-9a-f]{{64}})")
LINKS_TYPE = f"{VOTABLE_TYPE};content=datalink"
LINKS_STANDARD = "ivo://ivoa.net/std/DataLink#links-1.1"
USUAL, MOST = 1000, 5000
MJD_1970, DAY_S = 40587.0, 86400.0
M_PER_ANGSTROM = 1e-10
COLLECTION = "heliopsf"


class VotableErrors(PlainErrors):
    """Errors as VOTables."""

    async def error(self, problem: Problem) -> Response:
        """The answer that reports an error."""
        content = await run_in_threadpool(error_document, problem.detail)
        return Response(content, problem.status, headers=problem.headers, media_type=VOTABLE_TYPE)


VOTABLE_ERROR: Descriptions = {
    "4XX": {
        "content": {VOTABLE_TYPE: {}, "application/problem+json": {}},
        "description": "A VOTable with QUERY_STATUS=ERROR; problem details if the service is not called by this host "
        "name",
    }
}
LIST: RouteOptions = {
    "response_class": Response,
    "responses": {
        200: {
            "description": "A VOTable 1.4, or JSON: `columns`, `rows`, `status` (OK or OVERFLOW), `next`",
            "content": {VOTABLE_TYPE: {}, JSON_TYPE: {"schema": {"type": "object"}}},
        },
        **VOTABLE_ERROR,
    },
    "openapi_extra": query(
        MAXREC=f"largest number of rows; default {USUAL}, at most {MOST}; 0: only the columns",
        CURSOR="the cursor in the address of the next page, INFO `next`",
        RESPONSEFORMAT="votable (default) or json",
    ),
}
router = APIRouter(prefix="/vo", tags=["VO"], route_class=VotableErrors)


@router.get("/products", summary="Products with the columns of ObsCore", **LIST)
@router.post("/products", include_in_schema=False)
def list_vo_products(request: Request, caller: Reading, state: Shared, fields: Fields) -> Response:
    """Your products, newest first. A harvester reads pages until it meets a product that it knows."""

    def records(rows: Sequence[ProductRow]) -> list[dict[str, object]]:
        images = state.catalogue.rows(ImageRow, {row.image_id for row in rows}, caller.owner)
        return [product_record(row, images.get(row.image_id), base_url(request)) for row in rows]

    page = partial(state.catalogue.page, ProductRow, owner=caller.owner)
    return _listed(request, fields, PRODUCTS, page, records)


@router.get("/psfs", summary="PSFs with the columns of ObsCore", **LIST)
@router.post("/psfs", include_in_schema=False)
def list_vo_psfs(request: Request, caller: Reading, state: Shared, fields: Fields) -> Response:
    """Your PSFs, newest first. `t_min` and `t_max` are the validity of certified PSFs."""

    def records(rows: Sequence[PsfRow]) -> list[dict[str, object]]:
        return [psf_record(row, base_url(request)) for row in rows]

    page = partial(state.catalogue.page, PsfRow, owner=caller.owner)
    return _listed(request, fields, PSFS, page, records)


def did(kind: str, identity: str) -> str:
    """The name of a product or PSF."""
    return f"{NAMES}{kind}:{identity}"


def row_named(state: State, caller: Caller, name: str) -> ProductRow | PsfRow | None:
    """The row of the product or PSF with this name or id; None if the caller has none."""
    parts = NAME.fullmatch(name)
    if parts is None:
        return None
    rows: Iterator[ProductRow | PsfRow | None] = (
        state.catalogue.get(table, parts[2], caller.owner)
        for kind, table in TABLES_OF_NAMES.items()
        if parts[1] in (None, kind)
    )
    return next((row for row in rows if row is not None), None)


def product_record(row: ProductRow, image: ImageRow | None, base: str) -> dict[str, object]:
    """The values of a product's columns.

    Parameters
    ----------
    image
        The image that was deconvolved; None if the service does not keep it (bulk runs over an archive).
    base
        The address of the service.
    """
    seen: Mapping[str, Any] = {} if image is None else image.summary
    shape, cards = seen.get("shape", (None, None)), seen.get("cards", {})
    scales = [plate_scale_arcsec(cards, axis) for axis in (1, 2)]
    fov = [n * scale / 3600 for n, scale in zip(reversed(shape), scales, strict=True) if n and scale]
    start, exposure_s = _mjd(seen.get("date_obs")), seen.get("exposure_s")
    instrument = seen.get("detector") or seen.get("instrume") or seen.get("instrument")
    return _record(row, PRODUCT, row.details["filename"], base) | {
        "obs_id": row.image_id,
        "target_name": "Sun",
        "s_fov": max(fov) if len(fov) == 2 else None,
        "s_xel1": shape[1],
        "s_xel2": shape[0],
        "t_min": start,
        "t_max": None if start is None or exposure_s is None else start + exposure_s / DAY_S,
        "t_exptime": exposure_s,
        "t_resolution": exposure_s,
        **_channel(seen.get("wavelnth")),
        "o_ucd": "phot.count;em.UV.10-50nm",
        "facility_name": seen.get("telescop"),
        "instrument_name": instrument,
        "image_id": row.image_id,
        "psf_id": row.psf_id,
        "psf_version": row.psf_version,
        "method": row.details["method"]["name"],
        "artefact_score": row.details["changes"]["artefacts"]["score"],
    }


def psf_record(row: PsfRow, base: str) -> dict[str, object]:
    """The values of a PSF's columns."""
    shape = row.details.get("shape") or (None, None)
    return _record(row, PSF, title(row.name, row.version, None), base) | {
        "obs_id": row.id,
        "s_xel1": shape[1],
        "s_xel2": shape[0],
        "t_min": _mjd_of(row.valid_from),
        "t_max": _mjd_of(row.valid_to),
        **_channel(row.details.get("wavelength_angstrom")),
        "o_ucd": "instr.det.psf",
        "instrument_name": row.instrument,
        "name": row.name,
        "version": row.version,
        "status": row.status,
        "kind": row.kind,
        "origin": row.origin,
        "successor": row.successor_id,
    }


def _record(row: ProductRow | PsfRow, kind: str, title: str | None, base: str) -> dict[str, object]:
    """The values of the columns that both lists have."""
    name = did(kind, row.id)
    return {
        "dataproduct_type": "image",
        "calib_level": 3,
        "obs_collection": COLLECTION,
        "obs_publisher_did": name,
        "access_url": f"{base}/vo/links?ID={name}",
        "access_format": LINKS_TYPE,
        "access_estsize": max(1, round(row.bytes / 1000)),
        "t_xel": 1,
        "em_xel": 1,
        "pol_xel": 0,
        "obs_title": title,
        # As DALI writes it, in UTC without a zone, to the millisecond.
        "obs_creation_date": (iso(round(row.created_at, 3)) or "").removesuffix("Z")[:23],
        "obs_creator_name": row.owner,
        "file_url": f"{base}/v1/{kind}s/{row.id}/file",
        "file_sha256": row.file_sha256,
        "provenance_url": f"{base}/v1/{kind}s/{row.id}/provenance",
    }


def _listed(
    request: Request,
    fields: Mapping[str, list[str]],
    table: Table,
    page: Callable[..., Sequence[Row]],
    records: Callable[[Sequence[Row]], list[dict[str, object]]],
) -> Response:
    """The answer to a request for a list."""
    answer_format = format_of(fields, VOTABLE, JSON)
    limit = min(integer("MAXREC", one(fields, "maxrec") or str(USUAL), 0), MOST)
    listing = Listing(request, limit, one(fields, "cursor"))
    listed = page(**listing.query)
    rows = listed[:limit]
    status = "OVERFLOW" if len(listed) > limit else "OK"
    link = listing.following(listed) if rows else None
    following_page = None if link is None else base_url(request) + link
    if answer_format == JSON:
        about = ("name", "description", "datatype", "unit", "ucd", "utype", "xtype")
        columns = [{key: getattr(column, key) for key in about} for column in table.columns]
        cells = [{column.name: row.get(column.name) for column in table.columns} for row in records(rows)]
        document = {"table": table.name, "columns": columns, "rows": cells}
        return JSONResponse(document | {"status": status, "next": following_page})
    links = Service(
        "links",
        "All files of a row",
        f"{base_url(request)}/vo/links",
        (Input("ID", "Product or PSF", ucd="meta.id;meta.main", ref="obs_publisher_did"),),
        standard_id=LINKS_STANDARD,
        content_type=LINKS_TYPE,
    )
    infos = {} if following_page is None else {"next": following_page}
    content = table_document(
        table.name, table.columns, records(rows), status=status, infos=infos, services=[links]
    )
    return Response(content, media_type=VOTABLE_TYPE)


def _channel(angstrom: float | None) -> dict[str, float | None]:
    """The limits of the wavelength: both are the wavelength that names the channel."""
    metres = None if angstrom is None else angstrom * M_PER_ANGSTROM
    return {"em_min": metres, "em_max": metres}


def _mjd(date_obs: str | None) -> float | None:
    """The modified Julian date of a date in a header; None if the header gives no usable date."""
    try:
        return None if date_obs is None else _mjd_of(seconds(date_obs))
    except DataError:
        return None


def _mjd_of(at: float | None) -> float | None:
    """The modified Julian date of a time; None for an open end."""
    return None if at is None or math.isinf(at) else MJD_1970 + at / DAY_S
