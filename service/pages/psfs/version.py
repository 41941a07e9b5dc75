"""The page of one PSF: facts, curves, provenance, downloads, and the changes of its status."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse
from starlette.datastructures import FormData

from psfcore.tables import lookup
from service.api.lineage import get_psf_lineage, rerun_psf
from service.api.psfs.affected import list_affected_by_psf
from service.api.psfs.curves import get_cutout, tables_of
from service.api.psfs.series import SeriesChange, SeriesView, change_series, get_series
from service.api.psfs.status import StatusChange, change_psf_status, get_psf_status
from service.api.psfs.versions import delete_psf, get_psf
from service.http import downloads
from service.http.callers import Caller
from service.http.paging import Cursor
from service.http.problems import Problem
from service.http.state import Shared, State
from service.pages.parts.forms import checked, filled, start_job, text
from service.pages.parts.plots import Plot, Series, around, light_beyond_plot, shown_radii
from service.pages.parts.readings import fit_parameters, fit_plots
from service.pages.rendering import number, page
from service.pages.visitors import PageCertifying, PageReading, PageSubmitting
from service.views.psfs import PsfView
from workers.catalogue.access import Scope
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import ReportRow
from workers.contract.requests import Identity
from workers.versions import TOTAL, PsfStatus, without_variant

MOST_OTHERS = 50
MOST_REPORTS = 10
PER_PAGE = 50
CUTOUT_PX = 257
router = APIRouter(prefix="/psfs/{psf_id}", include_in_schema=False)


@router.get("")
def psf(psf_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The PSF. Without tables it has no curves; a form then starts the job that makes them."""
    view = get_psf(psf_id, caller, state)
    tables, told = _tables(state, caller, psf_id)
    fit = _fit(state, view)
    others = state.catalogue.psfs.page(PsfFilter(), caller.owner, limit=MOST_OTHERS + 1)
    status = get_psf_status(psf_id, caller, state)
    return page(
        request,
        "psf.html",
        psf=view,
        facts=psf_facts(view),
        status_view=status,
        series=_series(state, caller, status.series),
        plots=[] if tables is None else _plots(tables),
        resolution=None if tables is None else lookup.curve(tables)["resolution"],
        no_tables=told,
        fit=fit,
        fit_values=[] if fit is None else fit_parameters(fit),
        fit_plots=[] if fit is None else fit_plots(fit),
        lineage=get_psf_lineage(psf_id, caller, state),
        others=[one for one in others if one.id != psf_id][:MOST_OTHERS],
        rivals=_rivals(state, caller, view),
        reports=state.catalogue.page(ReportRow, owner=caller.owner, limit=MOST_REPORTS, about_id=psf_id),
        cutout_px=min(CUTOUT_PX, *view.details["shape"]),
        may_certify=Scope.CERTIFY in caller.scopes,
        may_submit=Scope.SUBMIT in caller.scopes,
    )


@router.get("/products")
def products(
    psf_id: Identity, request: Request, caller: PageReading, state: Shared, cursor: Cursor = None
) -> Response:
    """The products that were made with the PSF."""
    found = list_affected_by_psf(psf_id, request, caller, state, PER_PAGE, cursor)
    view = get_psf(psf_id, caller, state)
    return page(request, "psf_products.html", psf=view, products=found.items, next=found.next)


@router.get("/cutout")
async def cutout(
    psf_id: Identity,
    size: Annotated[int, Query(ge=1)],
    request: Request,
    caller: PageReading,
    state: Shared,
) -> Response:
    """The central part of the PSF as FITS; an error is shown as a page."""
    return await get_cutout(psf_id, size, request, caller, state)


@router.post("/status")
async def change(psf_id: Identity, request: Request, caller: PageCertifying, state: Shared) -> Response:
    """Certify the PSF, change its range, deprecate it or name its successor; then show it."""
    body = _change(await request.form())
    await run_in_threadpool(change_psf_status, psf_id, body, caller, state)
    return RedirectResponse(f"/psfs/{psf_id}", 303)


@router.post("/series")
async def change_interpolation(
    psf_id: Identity, request: Request, caller: PageCertifying, state: Shared
) -> Response:
    """Say whether the PSFs of the PSF's series may be interpolated in time; then show the PSF."""
    body: SeriesChange = checked(SeriesChange, filled(await request.form(), "interpolated", "reason"))

    def change() -> None:
        series = get_psf_status(psf_id, caller, state).series
        if series is None:
            raise Problem(
                409,
                "no-series",
                "expected a PSF of a series; the instrument of this PSF is unknown: upload the PSF again with its instrument",
            )
        instrument, channel, kind = series.split("/")
        change_series(instrument, channel, kind, body, caller, state)

    await run_in_threadpool(change)
    return RedirectResponse(f"/psfs/{psf_id}", 303)


@router.post("/tables")
async def make_tables(psf_id: Identity, caller: PageSubmitting, state: Shared) -> Response:
    """Start the job that makes the tables and the picture, and go to it."""
    return await start_job("psf-tables", {"psf_id": psf_id}, caller, state)


@router.post("/rerun")
def rerun(psf_id: Identity, response: Response, caller: PageSubmitting, state: Shared) -> Response:
    """Make the PSF again, and go to the job."""
    return RedirectResponse(f"/jobs/{rerun_psf(psf_id, response, caller, state).id}", 303)


@router.post("/delete")
def delete(psf_id: Identity, caller: PageSubmitting, state: Shared) -> Response:
    """Delete a draft that nothing uses, and go to the list."""
    delete_psf(psf_id, caller, state)
    return RedirectResponse("/psfs", 303)


def psf_facts(psf: PsfView) -> list[tuple[str, str]]:
    """The properties of a PSF that a page shows: name and value."""
    details = psf.details
    scale, total = details.get("plate_scale_arcsec"), details.get("sum")
    facts = {
        "Instrument": psf.instrument or "unknown",
        "Channel": _channel(psf.channel),
        "Kind": psf.kind,
        "Origin": psf.origin,
        "Size": "{1} x {0} px".format(*details["shape"]),
        "Pixel scale": f"{scale:.4g} arcsec" if scale else "unknown",
        "Sum of the weights": number(total, 6),
        "Components": ", ".join(details.get("components") or []) or "-",
        "Valid": validity(psf),
        "Id": psf.id,
    }
    return [(name, said) for name, said in facts.items() if said != "-"]


def _channel(channel: str | None) -> str:
    """A channel with its unit, and its variant, if it names one."""
    if channel is None:
        return "unknown"
    plain = without_variant(channel)
    variant = channel[len(plain) + 1 :]
    return f"{plain} angstrom" + (f", variant {variant}" if variant else "")


def validity(psf: PsfView) -> str:
    """The range of observation times for which the PSF is certified."""
    if not psf.was_certified:
        return "not certified"
    if psf.valid_from is None and psf.valid_to is None:
        return "at all times"
    return f"from {psf.valid_from or 'the beginning'} to {psf.valid_to or 'now and later'}"


def profile_series(label: str, profile: Mapping[str, Any], name: str, places: list[int]) -> Series:
    """The mean weight of one component at each radius. If the PSF was fitted, the errors are included."""
    values = [profile["mean_weight"][name][at] for at in places]
    errors = profile["sigma"].get(name)
    return Series(label, values, *around(values, None if errors is None else [errors[at] for at in places]))


def _tables(state: State, caller: Caller, psf_id: str) -> tuple[Mapping[str, Any] | None, str | None]:
    """Two results: the tables, and None; or None, and the reason why the PSF has no tables."""
    try:
        return tables_of(state, caller, psf_id), None
    except Problem as problem:
        if problem.code != "no-tables":
            raise
        return None, problem.detail


def _plots(tables: Mapping[str, Any]) -> list[Plot]:
    curve, profile = lookup.curve(tables), lookup.profile(tables)
    beyond = {
        name: {"radii_px": curve["radii_px"], "pct": pct, "sigma": curve["sigma_points"].get(name)}
        for name, pct in curve["light_beyond_pct"].items()
    }
    places = shown_radii(profile["radius_px"])
    rings = Plot(
        "Mean weight by radius",
        "radius (px)",
        "mean weight of a pixel",
        [profile["radius_px"][at] for at in places],
        [profile_series(name, profile, name, places) for name in profile["mean_weight"]],
        x_log=True,
        y_log=True,
    )
    return [rings, light_beyond_plot(beyond)]


def _series(state: State, caller: Caller, name: str | None) -> SeriesView | None:
    """The series of total PSFs with this name; None if there is no such series, or if none of its PSFs was certified."""
    if name is None:
        return None
    instrument, channel, kind = name.split("/")
    if kind != TOTAL:
        return None
    try:
        return get_series(instrument, channel, kind, caller, state)
    except Problem as problem:
        if problem.code != "no-such-series":
            raise
        return None


def _fit(state: State, view: PsfView) -> dict[str, Any] | None:
    """The report on the fit; None if the PSF was not fitted. Raises ``Problem`` 410 if the report is lost."""
    digest = view.details.get("report_sha256")
    if digest is None:
        return None
    said: dict[str, Any] = json.loads(downloads.found(state.store, digest).read_bytes())
    return said


def _rivals(state: State, caller: Caller, view: PsfView) -> list[PsfView]:
    """The other certified PSFs of the same series. This PSF can supersede them, or one of them can be its successor."""
    wanted = PsfFilter(
        instrument=view.instrument, channel=view.channel, kind=view.kind, status=PsfStatus.CERTIFIED
    )
    rows = state.catalogue.psfs.page(wanted, caller.owner, limit=MOST_OTHERS)
    return [PsfView.of(row) for row in rows if row.id != view.id]


def _change(form: FormData) -> StatusChange:
    """The change of status in a form. Raises ``Problem`` 422 for a wrong field."""
    values: dict[str, Any] = filled(
        form, "status", "reason", "version", "successor", "instrument", "channel", "kind"
    )
    if text(form, "with_range"):
        values |= {name: text(form, name) or None for name in ("valid_from", "valid_to")}
    values["supersedes"] = [one for one in form.getlist("supersedes") if isinstance(one, str)]
    body: StatusChange = checked(StatusChange, values)
    return body
