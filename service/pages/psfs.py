"""The pages of PSFs: the list with its forms; one PSF with its facts, curves, provenance and status; and two PSFs
compared.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, TypeVar, get_args

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse
from starlette.datastructures import FormData

from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names, parse_toml, telescope_of
from psfcore.tables import lookup
from service.api.images import get_psf_lineage, rerun_psf
from service.api.pixels import picture_of
from service.api.psf_curves import tables_of
from service.api.psf_versions import (
    SeriesChange,
    SeriesView,
    change_psf_status,
    change_series,
    get_psf_status,
    get_series,
    list_affected_by_psf,
)
from service.api.psfs import KindOfUpload, delete_psf, get_psf, list_psfs, psf_filter, upload_psf
from service.http.callers import Caller
from service.http.files import json_of
from service.http.gate import in_turn
from service.http.paging import Cursor, Listing
from service.http.problems import Problem
from service.http.state import Shared, State
from service.pages.forms import SentForm, checked, filled, parameters, start_job, text
from service.pages.login import PageCertifying, PageReading, PageSubmitting
from service.pages.rendering import dense, differing, flat, number, page, short
from service.views import PsfView
from workers.catalogue.access import Scope
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import PsfRow, ReportRow
from workers.contract.psf_status import StatusChange
from workers.contract.requests import Component, Identity, PsfBuild
from workers.versions import TOTAL, PsfStatus, without_variant

PER_PAGE = MOST_OTHERS = 50
MOST_REPORTS = 10
CUTOUT_PX = 257
CORE_PX = 129
FILTERS = ("instrument", "channel", "kind", "name", "version", "status", "valid_at")
# Entries of the provenance that say when and where a PSF was made, not how.
NOT_PARAMETERS = ("psf_id", "job_id", "file", "history", "instrument_toml")
Thing = TypeVar("Thing")
router = APIRouter(prefix="/psfs", include_in_schema=False)


@router.get("")
def psf_list(request: Request, caller: PageReading, state: Shared, cursor: Cursor = None) -> Response:
    """PSFs, newest first, with the filters of the API."""
    asked = _asked(request)
    filters = checked(psf_filter, {name: asked[name] for name in FILTERS if name in asked})
    found = list_psfs(Listing(request, PER_PAGE, cursor), caller, state, filters, asked.get("context"))
    return page(
        request,
        "psfs.html",
        psfs=found.items,
        next=found.next,
        asked={name: asked.get(name, "") for name in (*FILTERS, "context")},
        filtered=bool(asked),
        statuses=list(PsfStatus),
        instruments={name: telescope_of(name) for name in instrument_names()},
        components=get_args(Component),
        usual_size=PsfBuild.model_fields["size"].default,
        most_bytes=state.settings.max_psf_bytes,
        may_submit=Scope.SUBMIT in caller.scopes,
    )


@router.post("")
async def upload(
    request: Request,
    response: Response,
    caller: PageSubmitting,
    state: Shared,
    kind: KindOfUpload = None,
    image: Annotated[Identity | None, Query()] = None,
) -> Response:
    """Take a PSF from the form, and go to its page, or to the page of the image for which it was sent. The API explains
    ``kind``.
    """
    view = await upload_psf(request, response, caller, state, kind=kind)
    return RedirectResponse(f"/psfs/{view.id}" if image is None else f"/images/{image}?psf_id={view.id}", 303)


@in_turn(router.post("/build"))
def build(caller: PageSubmitting, state: Shared, form: SentForm) -> Response:
    """Start the build of a PSF from a shipped instrument file, and go to its job."""
    return start_job("psf-build", parameters(PsfBuild, form), caller, state)


def _asked(request: Request) -> dict[str, str]:
    """The filters of the request that are not empty. A browser also sends the empty fields of a form."""
    names = (*FILTERS, "context")
    return {name: text for name in names if (text := request.query_params.get(name, "").strip())}


# --- a PSF ------------------------------------------------------------------------------------------------


@in_turn(router.get("/{psf_id}"))
def psf(psf_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The PSF. Without tables it has no curves; a form then starts the job that makes them."""
    view = get_psf(psf_id, caller, state)
    tables, told = _unless("no-tables", tables_of, state, caller, psf_id)
    report_sha256 = view.details.get("report_sha256")
    others = state.catalogue.psfs.page(PsfFilter(), caller.owner, limit=MOST_OTHERS + 1)
    status = get_psf_status(psf_id, caller, state)
    return page(
        request,
        "psf.html",
        psf=view,
        facts=psf_facts(view),
        status_view=status,
        series=_series(state, caller, status.series),
        profile=None if tables is None else lookup.profile(tables),
        curve=None if tables is None else lookup.curve(tables),
        no_tables=told,
        fit=None if report_sha256 is None else json_of(state.store, report_sha256),
        lineage=get_psf_lineage(psf_id, caller, state),
        others=[one for one in others if one.id != psf_id][:MOST_OTHERS],
        rivals=_rivals(state, caller, view),
        reports=state.catalogue.page(ReportRow, owner=caller.owner, limit=MOST_REPORTS, about_id=psf_id),
        core_px=CORE_PX,
        cutout_px=min(CUTOUT_PX, *view.details["shape"]),
        may_certify=Scope.CERTIFY in caller.scopes,
        may_submit=Scope.SUBMIT in caller.scopes,
    )


@router.get("/{psf_id}/products")
def products(
    psf_id: Identity, request: Request, caller: PageReading, state: Shared, cursor: Cursor = None
) -> Response:
    """The products that were made with the PSF."""
    found = list_affected_by_psf(psf_id, Listing(request, PER_PAGE, cursor), caller, state)
    view = get_psf(psf_id, caller, state)
    return page(request, "psf_products.html", psf=view, products=found.items, next=found.next)


@router.get("/{psf_id}/core")
async def core(psf_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """A picture of the core of the PSF."""
    row = await run_in_threadpool(state.row, PsfRow, psf_id, caller.owner)
    return await picture_of(request, state, caller.owner, row.file_sha256, core_px=CORE_PX)


@router.post("/{psf_id}/status")
def change(psf_id: Identity, caller: PageCertifying, state: Shared, form: SentForm) -> Response:
    """Certify the PSF, change its range, deprecate it or name its successor; then show it."""
    change_psf_status(psf_id, _change(form), caller, state)
    return RedirectResponse(f"/psfs/{psf_id}", 303)


@router.post("/{psf_id}/series")
def change_interpolation(psf_id: Identity, caller: PageCertifying, state: Shared, form: SentForm) -> Response:
    """Say whether the PSFs of the PSF's series may be interpolated in time; then show the PSF."""
    body = checked(SeriesChange, filled(form, "interpolated", "reason"))
    series = get_psf_status(psf_id, caller, state).series
    if series is None:
        raise Problem(
            409,
            "no-series",
            "expected a PSF of a series; the instrument of this PSF is unknown: upload the PSF again with its "
            "instrument",
        )
    instrument, channel, kind = series.split("/")
    change_series(instrument, channel, kind, body, caller, state)
    return RedirectResponse(f"/psfs/{psf_id}", 303)


@in_turn(router.post("/{psf_id}/tables"))
def make_tables(psf_id: Identity, caller: PageSubmitting, state: Shared) -> Response:
    """Start the job that makes the tables and the picture, and go to it."""
    return start_job("psf-tables", {"psf_id": psf_id}, caller, state)


@in_turn(router.post("/{psf_id}/rerun"))
def rerun(psf_id: Identity, response: Response, caller: PageSubmitting, state: Shared) -> Response:
    """Make the PSF again, and go to the job."""
    return RedirectResponse(f"/jobs/{rerun_psf(psf_id, response, caller, state).id}", 303)


@in_turn(router.post("/{psf_id}/delete"))
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


def _unless(code: str, get: Callable[..., Thing], *args: object) -> tuple[Thing | None, str | None]:
    """What ``get`` returns, and None; or None, and the reason if it raises a problem with this code."""
    try:
        return get(*args), None
    except Problem as problem:
        if problem.code != code:
            raise
        return None, problem.detail


def _series(state: State, caller: Caller, name: str | None) -> SeriesView | None:
    """The series of total PSFs with this name; None if there is no such series, or if none of its PSFs was
    certified.
    """
    if name is None or not name.endswith(f"/{TOTAL}"):
        return None
    return _unless("no-such-series", get_series, *name.split("/"), caller, state)[0]


def _rivals(state: State, caller: Caller, view: PsfView) -> list[PsfView]:
    """The other certified PSFs of the same series. This PSF can supersede them, or one of them can be its successor."""
    wanted = PsfFilter(
        instrument=view.instrument, channel=view.channel, kind=view.kind, status=PsfStatus.CERTIFIED
    )
    rows = state.catalogue.psfs.page(wanted, caller.owner, limit=MOST_OTHERS)
    return [PsfView.of(row) for row in rows if row.id != view.id]


def _change(form: FormData) -> StatusChange:
    """The change of status in a form. Raises ``Problem`` 422 for a wrong field."""
    values: dict[str, object] = {
        **filled(form, "status", "reason", "version", "successor", "instrument", "channel", "kind")
    }
    if text(form, "with_range"):
        values |= {name: text(form, name) or None for name in ("valid_from", "valid_to")}
    values["supersedes"] = [one for one in form.getlist("supersedes") if isinstance(one, str)]
    return checked(StatusChange, values)


# --- two PSFs compared ----------------------------------------------------------------------------------


@router.get("/{psf_id}/vs")
def choose(psf_id: Identity, other: Identity, caller: PageReading) -> Response:
    """Go to the comparison with the PSF that was chosen in a form."""
    return RedirectResponse(f"/psfs/{psf_id}/vs/{other}", 303)


@in_turn(router.get("/{psf_id}/vs/{other_id}"))
def comparison(
    psf_id: Identity, other_id: Identity, request: Request, caller: PageReading, state: Shared
) -> Response:
    """The two PSFs. Without tables, or with different pixel scales, only their parameters are compared."""
    one, other = get_psf(psf_id, caller, state), get_psf(other_id, caller, state)
    labels = _labels(one, other)
    (first, why), (second, other_why) = (
        _unless("no-tables", tables_of, state, caller, identity) for identity in (psf_id, other_id)
    )
    compared, told = None, why or other_why
    if first is not None and second is not None:
        try:
            compared = _compared(first, second)
        except DataError as error:
            told = error.message
    return page(
        request,
        "psf_comparison.html",
        one=one,
        other=other,
        labels=labels,
        told=told,
        differences=differing(psf_parameters(one), psf_parameters(other)),
        compared=compared,
    )


def _compared(one: lookup.Tables, other: lookup.Tables) -> dict[str, object]:
    """The curves of two PSFs at the radii that both have, and their differences. Raises DataError
    "plate-scale-mismatch".
    """
    figures, both = lookup.compare(one, other), (one, other)
    profiles = [lookup.profile(tables) for tables in both]
    means = [profile["mean_weight"][lookup.TOTAL] for profile in profiles]
    shown = [figures["radii_px"][at] for at in dense(figures["radii_px"])]
    return {
        "figures": figures,
        "profiles": profiles,
        "radii": min((profile["radius_px"] for profile in profiles), key=len),
        "ratios": [b / a if a > 0 else None for a, b in zip(*means, strict=False)],
        "curves": [lookup.curve(tables, shown) for tables in both],
    }


def _labels(one: PsfView, other: PsfView) -> tuple[str, str]:
    """Short names that tell the two PSFs apart."""
    first, second = (f"{psf.name} {psf.version}" for psf in (one, other))
    if first == second:
        return f"{first} ({short(one.id)})", f"{second} ({short(other.id)})"
    return first, second


def psf_parameters(psf: PsfView) -> dict[str, str]:
    """The facts and parameters by which PSFs are compared: name and value."""
    facts = {name: said for name, said in psf_facts(psf) if name != "Id"}
    made = dict(psf.details.get("provenance") or {})
    fitted = (psf.details.get("fit") or {}).get("parameters") or {}
    fit = {name: f"{found['value']:.5g} ± {found['sigma']:.2g}" for name, found in fitted.items()}
    told = {name: value for name, value in made.items() if name not in NOT_PARAMETERS}
    instrument = parse_toml(made.get("instrument_toml") or "")
    return {
        "Name": psf.name,
        "Version": psf.version,
        "Status": str(psf.status),
        **facts,
        **{f"fit: {name}": said for name, said in fit.items()},
        **flat(told),
        **{f"instrument file: {name}": said for name, said in flat(instrument).items()},
    }
