"""The lineage of PSFs and products, ``.../lineage`` and ``.../provenance``, and reruns, ``.../rerun``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Response

from service.api.jobs import submit_job
from service.http.callers import Reading, Submitting
from service.http.problems import RESPONSES
from service.http.state import Shared
from service.views import JobView
from workers.catalogue.tables import ProductRow, PsfRow
from workers.contract.kinds import KINDS
from workers.contract.requests import Identity, Rerun
from workers.lineage import Ancestor, Format, lineage, provenance_text

MEDIA_TYPES: dict[Format, str] = {"json": "application/json", "provn": "text/provenance-notation"}
FILES: dict[Format, str] = {"json": "prov.json", "provn": "provn"}
FORMAT = Query(description="`json`: PROV-JSON; `provn`: PROV-N")
PROV: dict[str, Any] = {
    "response_class": Response,
    "responses": {
        200: {
            "description": "A PROV document: entities by hash, activities by job, agents by owner and software version",
            "content": {
                MEDIA_TYPES["json"]: {"schema": {"type": "object"}},
                MEDIA_TYPES["provn"]: {"schema": {"type": "string"}},
            },
        }
    },
}
router = APIRouter(tags=["lineage"], responses=RESPONSES)


@router.get("/v1/psfs/{psf_id}/lineage", summary="The lineage of a PSF")
def get_psf_lineage(psf_id: Identity, caller: Reading, state: Shared) -> Ancestor:
    """The inputs of the PSF (by hash), its parameters, the versions of software and libraries, and its job. The PSFs from which it
    was made are described in the same way."""
    return lineage(state.catalogue, state.row(PsfRow, psf_id, caller.owner))


@router.get("/v1/products/{product_id}/lineage", summary="The lineage of a product")
def get_product_lineage(product_id: Identity, caller: Reading, state: Shared) -> Ancestor:
    """The image, the parameters, the versions of software and libraries, and the job of the product; also the lineage of its PSF."""
    return lineage(state.catalogue, state.row(ProductRow, product_id, caller.owner))


@router.get("/v1/psfs/{psf_id}/provenance", summary="The lineage of a PSF as W3C PROV", **PROV)
def get_psf_provenance(
    psf_id: Identity, caller: Reading, state: Shared, format: Annotated[Format, FORMAT] = "json"
) -> Response:
    """The lineage in the terms of W3C PROV and of the IVOA Provenance Data Model."""
    return _provenance(state, state.row(PsfRow, psf_id, caller.owner), "psf", format)


@router.get("/v1/products/{product_id}/provenance", summary="The lineage of a product as W3C PROV", **PROV)
def get_product_provenance(
    product_id: Identity, caller: Reading, state: Shared, format: Annotated[Format, FORMAT] = "json"
) -> Response:
    """The lineage in the terms of W3C PROV and of the IVOA Provenance Data Model."""
    return _provenance(state, state.row(ProductRow, product_id, caller.owner), "product", format)


@router.post("/v1/psfs/{psf_id}/rerun", status_code=202, summary="Make a PSF again and compare")
def rerun_psf(psf_id: Identity, response: Response, caller: Submitting, state: Shared) -> JobView:
    """Submit a job that makes the PSF again with the same parameters. The result is a report on the differences between both PSFs."""
    return _rerun("psf", psf_id, response, caller, state)


@router.post("/v1/products/{product_id}/rerun", status_code=202, summary="Make a product again and compare")
def rerun_product(product_id: Identity, response: Response, caller: Submitting, state: Shared) -> JobView:
    """Submit a job that makes the product again with the same parameters. The result is a report on the differences between both products."""
    return _rerun("product", product_id, response, caller, state)


def _rerun(
    of: Literal["product", "psf"], identity: str, response: Response, caller: Submitting, state: Shared
) -> JobView:
    request = KINDS["rerun"].request(kind="rerun", parameters=Rerun(of=of, id=identity))
    return submit_job(request, response, caller, state)


def _provenance(state: Shared, row: ProductRow | PsfRow, of: str, form: Format) -> Response:
    headers = {"Content-Disposition": f'attachment; filename="{of}-{row.id[:12]}.{FILES[form]}"'}
    return Response(
        provenance_text(state.catalogue, row, form), media_type=MEDIA_TYPES[form], headers=headers
    )
