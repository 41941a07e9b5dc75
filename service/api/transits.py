"""Uploaded transits: ``/v1/transits``."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, Field

from psfcore.noise_figures import NoiseFigures
from service.http import uploads
from service.http.callers import Reading, Submitting
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES, Problem
from service.http.quotas import Allowed
from service.http.state import Shared
from workers.catalogue.tables import TransitRow
from workers.contract.requests import Identity
from workers.intake.uploads import transit_row

router = APIRouter(prefix="/v1/transits", tags=["transits"], responses=RESPONSES)


class PointingView(BaseModel):
    """A pointing of a transit."""

    fov: int = Field(description="number of the pointing in transit.json")
    images: int


class FileView(BaseModel):
    """A file of a transit."""

    name: str
    bytes: int = Field(description="unpacked size, as declared in the archive")


class TransitView(BaseModel):
    """An uploaded transit: properties of its archive, and the content of its transit.json."""

    id: str = Field(description="SHA-256 of the archive")
    created_at: float
    bytes: int
    filename: str | None
    archive: str = Field(description="zip, tar or tar.gz")
    instrument: str | None
    images: int
    pointings: list[PointingView]
    noise: NoiseFigures | None = Field(
        description="noise figures; null: the request for a job must give them"
    )
    known_psf: str | None = Field(
        description="file of the known part of the PSF; null: the diffraction PSF of the instrument"
    )
    unpacked_bytes: int

    @classmethod
    def of(cls, row: TransitRow) -> TransitView:
        """The description of a transit, from its row in the catalogue."""
        return cls.model_validate(_content(row))


class TransitDetails(TransitView):
    """An uploaded transit, with the files that its transit.json names."""

    files: list[FileView]

    @classmethod
    def of(cls, row: TransitRow) -> TransitDetails:
        """The description of a transit and its files, from the row of the transit in the catalogue."""
        return cls.model_validate(_content(row))


def _content(row: TransitRow) -> dict[str, object]:
    about = {"id": row.id, "created_at": row.created_at, "bytes": row.bytes, "filename": row.filename}
    return row.summary | about


@router.post(
    "",
    status_code=201,
    summary="Upload a transit",
    openapi_extra=uploads.OPENAPI_TRANSIT_BODY,
    responses={200: {"model": TransitDetails, "description": "The same file was already uploaded."}},
)
async def upload_transit(
    request: Request, response: Response, caller: Submitting, state: Shared
) -> TransitDetails:
    """Upload one archive: the images of a transit, their transit.json and, optionally, the known part of the PSF.

    The table of contents and transit.json are checked at upload. The pixels are read by the jobs that use the transit.
    """
    settings, take = state.settings, Allowed(state, caller)
    async with uploads.receive_transit(
        request,
        state.store,
        settings.archive_limits,
        settings.max_transit_bytes,
        take,
    ) as upload:
        row = transit_row(caller.owner, upload.sha256, upload.bytes, upload.filename, upload.summary)
        row, new = await run_in_threadpool(take.keep, upload.path, upload.sha256, row)
    response.status_code = 201 if new else 200
    response.headers["Location"] = f"/v1/transits/{row.id}"
    return TransitDetails.of(row)


@router.get("", summary="List uploaded transits")
def list_transits(
    request: Request, caller: Reading, state: Shared, limit: Limit = 50, cursor: Cursor = None
) -> Page[TransitView]:
    """Uploaded transits, newest first, without the names of their files."""
    rows = state.catalogue.page(TransitRow, owner=caller.owner, limit=limit + 1, after=position(cursor))
    return page(request, rows, limit, TransitView.of)


@router.get("/{transit_id}", summary="One uploaded transit")
def get_transit(transit_id: Identity, caller: Reading, state: Shared) -> TransitDetails:
    """An uploaded transit, with its files."""
    row = state.catalogue.get(TransitRow, transit_id, caller.owner)
    if row is None:
        raise Problem(
            404,
            "no-such-transit",
            f"expected the id of an uploaded transit; got {transit_id}, which is not in the catalogue: upload the transit, or list your transits",
        )
    return TransitDetails.of(row)
