"""The files and services that belong to a product or PSF, as a DataLink table: ``/vo/links``.

Citation: IVOA DataLink 1.1 (15 December 2023). Each ID gives the rows of its links. If an ID is not known, its only row says so,
and the other IDs are answered. A request without an ID gets an empty table. The table also describes the cut-out
service, so that a client can show a form for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from fastapi import APIRouter, Request, Response

from service.http.callers import Caller, Reading
from service.http.downloads import FITS_TYPE, GZIP_TYPE
from service.http.state import Shared, State
from service.vo.columns import LINKS
from service.vo.lists import LINKS_STANDARD, LINKS_TYPE, PSF, VOTABLE_ERROR, VotableErrors, did, row_named
from service.vo.parameters import VOTABLE, Fields, base_url, format_of, query, refuse
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow

MOST_IDS = 200
CUTOUT = "cutout"
PNG, JSON, PROVN = "image/png", "application/json", "text/provenance-notation"
Link = dict[str, Any]
router = APIRouter(prefix="/vo", tags=["VO"], route_class=VotableErrors)


@router.get(
    "/links",
    summary="DataLink: the files and services of products and PSFs",
    response_class=Response,
    responses={
        200: {"content": {LINKS_TYPE: {}}, "description": "A table of DataLink 1.1"},
        **VOTABLE_ERROR,
    },
    openapi_extra=query(
        ID=f"id of a product or PSF, or its name urn:heliopsf:product:... or urn:heliopsf:psf:...; at most {MOST_IDS}",
        RESPONSEFORMAT="votable, the only format",
    ),
)
@router.post("/links", include_in_schema=False)
def get_links(request: Request, caller: Reading, state: Shared, fields: Fields) -> Response:
    """Product or PSF, previews, input, PSF, provenance and cut-outs, with address, meaning, media type and size."""
    format_of(fields, VOTABLE)
    names = fields.get("id", [])
    if len(names) > MOST_IDS:
        refuse("ID", f"at most {MOST_IDS} of them", f"{len(names)} of them")
    rows = [link for name in names for link in _links(state, caller, name, base_url(request))]
    from service.vo.cutouts import described_cutout
    from service.vo.votables import table_document  # loads the numerical libraries

    content = table_document(
        "links",
        LINKS,
        rows,
        infos={"standardID": LINKS_STANDARD},
        services=[described_cutout(CUTOUT, base_url(request))],
    )
    return Response(content, media_type=LINKS_TYPE)


def _links(state: State, caller: Caller, name: str, base: str) -> Iterator[Link]:
    """The links of one ID."""
    row = row_named(state, caller, name)
    if row is None:
        yield _fault(
            name,
            "NotFoundFault: expected the id of one of your products or PSFs: list them at /vo/products or /vo/psfs",
        )
        return
    keys = "true" if state.access.keys else "false"
    links = _of_product(state, row, base) if isinstance(row, ProductRow) else _of_psf(row, base)
    for link in links:
        yield {"ID": name, "link_auth": keys, **link}


def _of_product(state: State, row: ProductRow, base: str) -> Iterator[Link]:
    here, psf = f"{base}/v1/products/{row.id}", f"{base}/v1/psfs/{row.psf_id}"
    details, owner = row.details, row.owner
    yield _link(
        "#this", "file", f"{here}/file", "The deconvolved image with its planes", FITS_TYPE, row.bytes
    )
    yield _link("#preview", "preview", f"{here}/preview", "The image before and after, and the change", PNG)
    if details.get("thumbnail_sha256"):
        yield _link(
            "#preview-image",
            "thumbnail",
            f"{here}/thumbnail",
            "The product, at most 192 px wide and high",
            PNG,
        )
    if details.get("changes_picture_sha256"):
        yield _link("#preview-plot", "changes", f"{here}/changes", "What the deconvolution changed", PNG)
    used = state.catalogue.get(PsfRow, row.psf_id, owner)
    if used is None:
        yield _fault(None, "NotFoundFault: the PSF was deleted", "#calibration", "psf")
    else:
        yield _link(
            "#calibration",
            "psf",
            f"{psf}/file",
            f"The PSF: {used.name} {used.version}",
            FITS_TYPE,
            used.bytes,
        )
        links = f"{base}/vo/links?ID={did(PSF, used.id)}"
        yield _link("#calibration", "psf-links", links, "All files of the PSF", LINKS_TYPE)
    image = state.catalogue.get(ImageRow, row.image_id, owner)
    if image is None:
        message = "NotFoundFault: the service does not keep the input; a bulk run read it from an archive"
        yield _fault(None, message, "#progenitor", "input")
    else:
        kind = GZIP_TYPE if image.summary.get("gzipped") else FITS_TYPE
        yield _link(
            "#progenitor", "input", f"{base}/v1/images/{image.id}/file", "The input image", kind, image.bytes
        )
    yield from _provenance(here)
    yield {
        "service_def": CUTOUT,
        "semantics": "#cutout",
        "description": "Cut a circle, box or polygon out of the product",
        "content_type": FITS_TYPE,
        "local_semantics": "cutout",
    }


def _of_psf(row: PsfRow, base: str) -> Iterator[Link]:
    here = f"{base}/v1/psfs/{row.id}"
    yield _link("#this", "file", f"{here}/file", f"The PSF: {row.name} {row.version}", FITS_TYPE, row.bytes)
    if row.preview_sha256:
        yield _link("#preview", "preview", f"{here}/preview", "The PSF and its curve", PNG)
    if "report_sha256" in row.details:
        yield _link("#auxiliary", "report", f"{here}/report", "The report on the fit", JSON)
    yield from _provenance(here)


def _provenance(here: str) -> Iterator[Link]:
    yield _link(
        "#auxiliary", "provenance", f"{here}/provenance?format=json", "The lineage as W3C PROV-JSON", JSON
    )
    yield _link(
        "#auxiliary", "provenance", f"{here}/provenance?format=provn", "The lineage as W3C PROV-N", PROVN
    )


def _link(
    semantics: str, local: str, address: str, description: str, kind: str, size: int | None = None
) -> Link:
    return {
        "access_url": address,
        "semantics": semantics,
        "description": description,
        "content_type": kind,
        "content_length": size,
        "local_semantics": local,
    }


def _fault(name: str | None, message: str, semantics: str = "#this", local: str | None = None) -> Link:
    """A row that says why there is no link."""
    fault = {"error_message": message, "semantics": semantics, "local_semantics": local}
    return fault if name is None else {"ID": name, **fault}
