"""The lineage of PSFs and products, ``.../lineage``, and reruns, ``.../rerun``."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter, Response

from psfcore.errors import DataError
from service.api.jobs import submit_job
from service.http.callers import Reading, Submitting
from service.http.problems import RESPONSES, problem
from service.http.state import Shared
from service.views.jobs import JobView
from workers.catalogue.tables import ProductRow, PsfRow
from workers.contract.kinds import KINDS
from workers.contract.requests import Identity, Rerun
from workers.lineage import Ancestor, lineage

router = APIRouter(tags=["lineage"], responses=RESPONSES)


@router.get("/v1/psfs/{psf_id}/lineage", summary="The lineage of a PSF")
def get_psf_lineage(psf_id: Identity, caller: Reading, state: Shared) -> Ancestor:
    """The inputs of the PSF (by hash), its parameters, the versions of software and libraries, and its job. The PSFs from which it
    was made are described in the same way."""
    row = state.catalogue.get(PsfRow, psf_id, caller.owner)
    if row is None:
        raise _missing("psf", psf_id)
    return lineage(state.catalogue, row)


@router.get("/v1/products/{product_id}/lineage", summary="The lineage of a product")
def get_product_lineage(product_id: Identity, caller: Reading, state: Shared) -> Ancestor:
    """The image, the parameters, the versions of software and libraries, and the job of the product; also the lineage of its PSF."""
    row = state.catalogue.get(ProductRow, product_id, caller.owner)
    if row is None:
        raise _missing("product", product_id)
    return lineage(state.catalogue, row)


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
    asked = KINDS["rerun"].request(kind="rerun", parameters=Rerun(of=of, id=identity))
    return submit_job(asked, response, caller, state)


def _missing(of: str, identity: str) -> Exception:
    return problem(
        DataError(
            f"no-such-{of}",
            f"expected the id of a {of} in the catalogue; got {identity}, which is not in it: list the {of}s",
        )
    )
