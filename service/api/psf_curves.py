"""Curves and weights of a PSF, under ``/v1/psfs/{id}``, read from its stored tables.

A job makes the tables when it builds or fits a PSF. An uploaded PSF has no tables until a job ``psf-tables`` makes
them. The upload does not make them, because the web process does no numerical work.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, BinaryIO, cast

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse

from psfcore.fits.stored_psf import write_cutout
from psfcore.tables import lookup as psf_lookup
from service.client.answers import (
    AnnulusAnswer,
    ComparisonAnswer,
    CurveAnswer,
    EncircledAnswer,
    ProfileAnswer,
)
from service.http import files
from service.http.callers import Caller, Reading
from service.http.cutouts import cutout_of
from service.http.gate import in_turn
from service.http.problems import RESPONSES, Problem, as_problems
from service.http.state import Shared, State
from workers.catalogue.tables import PsfRow
from workers.contract.requests import Identity

# This number is part of every ETag. Increase it when a new version of the code gives other answers for the same tables.
ANSWERS_VERSION = 2
router = APIRouter(prefix="/v1/psfs", tags=["PSFs"], responses=RESPONSES)

Radius = Annotated[float, Query(description="distance from the PSF's centre, px")]


@in_turn(
    router.get(
        "/{psf_id}/curve", summary="Light beyond radii (1 - encircled energy)", response_model=CurveAnswer
    )
)
def get_curve(
    psf_id: Identity,
    request: Request,
    caller: Reading,
    state: Shared,
    radii: Annotated[
        str | None,
        Query(max_length=12_000, description="px, such as 1,10,100; default: the radii of the table"),
    ] = None,
) -> Response:
    """1 - encircled energy at radii, with errors for a fitted PSF."""
    radii_px = None if radii is None else _numbers(radii)
    return _answer(request, caller, state, [psf_id], lambda tables: psf_lookup.curve(tables, radii_px))


@in_turn(router.get("/{psf_id}/profile", summary="Mean weight by radius", response_model=ProfileAnswer))
def get_profile(psf_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The mean weight in each ring, and the variation of the weights along the ring."""
    return _answer(request, caller, state, [psf_id], psf_lookup.profile)


@in_turn(
    router.get(
        "/{psf_id}/encircled",
        summary="Light within a radius (encircled energy)",
        response_model=EncircledAnswer,
    )
)
def get_encircled(
    psf_id: Identity, radius: Radius, request: Request, caller: Reading, state: Shared
) -> Response:
    """The encircled energy as a fraction of all light."""
    return _answer(request, caller, state, [psf_id], lambda tables: psf_lookup.encircled(tables, radius))


@in_turn(router.get("/{psf_id}/annulus", summary="Light between two radii", response_model=AnnulusAnswer))
def get_annulus(
    psf_id: Identity, inner: Radius, outer: Radius, request: Request, caller: Reading, state: Shared
) -> Response:
    """Light beyond `inner` and up to `outer`, as a fraction of all light."""
    return _answer(request, caller, state, [psf_id], lambda tables: psf_lookup.annulus(tables, inner, outer))


@in_turn(
    router.get("/{psf_id}/compare/{other_id}", summary="Compare two PSFs", response_model=ComparisonAnswer)
)
def get_comparison(
    psf_id: Identity, other_id: Identity, request: Request, caller: Reading, state: Shared
) -> Response:
    """The second PSF minus the first: differences of the curves, in percentage points, and of the sums."""
    return _answer(request, caller, state, [psf_id, other_id], psf_lookup.compare)


@router.get("/{psf_id}/cutout", summary="The central part of a PSF as FITS", response_class=Response)
async def get_cutout(
    psf_id: Identity,
    size: Annotated[int, Query(ge=1, description="edge length in px, at most the edge length of the PSF")],
    request: Request,
    caller: Reading,
    state: Shared,
) -> Response:
    """The central part of the PSF, not renormalised. Its centre is at [size // 2, size // 2]."""
    row = await run_in_threadpool(state.row, PsfRow, psf_id, caller.owner)

    def write(path: Path, target: BinaryIO) -> None:
        write_cutout(path, size, state.settings.psf_limits, target)

    part, filename = f"{ANSWERS_VERSION} cutout {size}", f"psf-{psf_id[:12]}-{size}px.fits"
    return await cutout_of(request, state, row, part, write, filename=filename)


def tables_of(state: State, caller: Caller, psf_id: str) -> psf_lookup.Tables:
    """The tables of a PSF. Raises ``Problem`` 404 if there is no such PSF, 409 "no-tables" if it has no tables yet."""
    row = state.row(PsfRow, psf_id, caller.owner)
    return _read(state, row, _tables_of(row))


def _answer(
    request: Request, caller: Caller, state: Shared, psf_ids: list[str], ask: Callable[..., dict[str, object]]
) -> Response:
    """The answer from the tables of these PSFs, or 304 if the client already has this answer."""
    rows = [state.row(PsfRow, psf_id, caller.owner) for psf_id in psf_ids]
    digests = [_tables_of(row) for row in rows]
    headers = files.headers_of(
        f"{ANSWERS_VERSION} {' '.join(digests)} {request.url.path} {request.url.query}"
    )
    if (same := files.not_modified(request, headers)) is not None:
        return same
    tables = [_read(state, row, digest) for row, digest in zip(rows, digests, strict=True)]
    with as_problems():
        return JSONResponse(ask(*tables), headers=headers)


def _read(state: Shared, row: PsfRow, digest: str) -> psf_lookup.Tables:
    tables = files.json_of(state.store, digest)
    if tables["schema"] != psf_lookup.SCHEMA:
        raise _no_tables(row)
    return cast("psf_lookup.Tables", tables)


def _tables_of(row: PsfRow) -> str:
    digest = row.details.get("tables_sha256")
    if digest is None:
        raise _no_tables(row)
    return str(digest)


def _no_tables(row: PsfRow) -> Problem:
    return Problem(
        409,
        "no-tables",
        f"expected a PSF with tables; {row.name} {row.version} ({row.origin}) has none yet: make them with the job "
        f'{{"kind": "psf-tables", "parameters": {{"psf_id": "{row.id}"}}}}, sent to /v1/jobs',
    )


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise Problem(
            422,
            "bad-radius",
            f"radii: expected numbers separated by commas, such as 1,10,100; got {text!r:.60}",
        ) from error
