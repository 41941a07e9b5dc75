"""Two PSFs compared: both in one plot, their ratio, and the parameters that differ."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse

from psfcore.errors import DataError
from psfcore.tables import lookup
from psfcore.tables.lookup import TOTAL
from service.api.psf_curves import tables_of
from service.api.psfs import get_psf
from service.http.problems import Problem
from service.http.state import Shared
from service.pages.login import PageReading
from service.pages.plots import Plot, Series, light_beyond_plot, radial_plot, shown_radii, with_errors
from service.pages.psfs import profile_series, psf_facts
from service.pages.rendering import page, short
from service.views import PsfView
from workers.contract.requests import Identity

router = APIRouter(prefix="/psfs/{psf_id}/vs", include_in_schema=False)
Tables = Mapping[str, Any]
# Entries of the provenance that say when and where a PSF was made, not how.
NOT_PARAMETERS = ("psf_id", "job_id", "file", "history", "instrument_toml")


@router.get("")
def choose(psf_id: Identity, other: Identity, caller: PageReading) -> Response:
    """Go to the comparison with the PSF that was chosen in a form."""
    return RedirectResponse(f"/psfs/{psf_id}/vs/{other}", 303)


@router.get("/{other_id}")
def comparison(
    psf_id: Identity, other_id: Identity, request: Request, caller: PageReading, state: Shared
) -> Response:
    """The two PSFs. Without tables, or with different pixel scales, only their parameters are compared."""
    one, other = get_psf(psf_id, caller, state), get_psf(other_id, caller, state)
    plots, figures, told = [], None, None
    try:
        tables = tables_of(state, caller, psf_id), tables_of(state, caller, other_id)
        figures = lookup.compare(*tables)
        plots = _plots(_labels(one, other), *tables)
    except DataError as error:
        told = error.message
    except Problem as problem:
        if problem.code != "no-tables":
            raise
        told = problem.detail
    return page(
        request,
        "psf_comparison.html",
        one=one,
        other=other,
        labels=_labels(one, other),
        plots=plots,
        figures=figures,
        told=told,
        differences=differences(one, other),
    )


def differences(one: PsfView, other: PsfView) -> list[tuple[str, str, str]]:
    """The facts and parameters that differ: name, and the value of each PSF ("-": it has none)."""
    first, second = _parameters(one), _parameters(other)
    names = [*first, *(name for name in second if name not in first)]
    rows = [(name, first.get(name, "-"), second.get(name, "-")) for name in names]
    return [row for row in rows if row[1] != row[2]]


def _labels(one: PsfView, other: PsfView) -> tuple[str, str]:
    """Short names that tell the two PSFs apart."""
    first, second = (f"{psf.name} {psf.version}" for psf in (one, other))
    if first == second:
        return f"{first} ({short(one.id)})", f"{second} ({short(other.id)})"
    return first, second


def _parameters(psf: PsfView) -> dict[str, str]:
    facts = {name: said for name, said in psf_facts(psf) if name != "Id"}
    made = dict(psf.details.get("provenance") or {})
    fitted = (psf.details.get("fit") or {}).get("parameters") or {}
    fit = {name: f"{found['value']:.5g} ± {found['sigma']:.2g}" for name, found in fitted.items()}
    told = {name: value for name, value in made.items() if name not in NOT_PARAMETERS}
    return {
        "Name": psf.name,
        "Version": psf.version,
        "Status": str(psf.status),
        **facts,
        **{f"fit: {name}": said for name, said in fit.items()},
        **dict(_flat(told)),
        **{f"instrument file: {name}": said for name, said in _flat(_instrument(made))},
    }


def _instrument(made: Mapping[str, Any]) -> dict[str, Any]:
    """The content of the instrument file from which a PSF was built; empty if there is none."""
    text = made.get("instrument_toml")
    return tomllib.loads(text) if isinstance(text, str) else {}


def _flat(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Nested values as pairs of name and text. The name contains all levels, separated by dots."""
    for key, value in values.items():
        name = f"{before}{key}"
        if isinstance(value, Mapping):
            yield from _flat(value, f"{name}.")
        elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
            for place, item in enumerate(value, start=1):
                yield from _flat(item, f"{name} {item.get('name', place)}.")
        elif value is not None:
            yield name, str(value)


def _plots(labels: tuple[str, str], one: Tables, other: Tables) -> list[Plot]:
    profiles = [lookup.profile(tables) for tables in (one, other)]
    rings = min(len(profile["radius_px"]) for profile in profiles)
    places = shown_radii(profiles[0]["radius_px"][:rings])
    radii = [profiles[0]["radius_px"][at] for at in places]
    curves = [
        profile_series(label, profile, TOTAL, places) for label, profile in zip(labels, profiles, strict=True)
    ]
    means = [profile["mean_weight"][TOTAL] for profile in profiles]
    ratios = [means[1][at] / means[0][at] if means[0][at] > 0 else None for at in places]
    title = f"Ratio of the mean weights: {labels[1]} / {labels[0]}"
    return [
        radial_plot("Mean weight by radius", "mean weight of a pixel", radii, curves),
        radial_plot(title, "ratio", radii, [Series("ratio", ratios)], y_log=False),
        *_light_plots(labels, one, other),
    ]


def _light_plots(labels: tuple[str, str], one: Tables, other: Tables) -> list[Plot]:
    """The light beyond each radius that both tables have, and the difference."""
    compared = lookup.compare(one, other)
    places = shown_radii(compared["radii_px"])
    radii = [compared["radii_px"][at] for at in places]
    found = [lookup.curve(tables, radii) for tables in (one, other)]
    curves = {
        label: (curve["light_beyond_pct"][TOTAL], curve["sigma_points"].get(TOTAL))
        for label, curve in zip(labels, found, strict=True)
    }
    points, sigma = compared["difference_points"][TOTAL], compared["sigma_points"].get(TOTAL)
    difference = radial_plot(
        f"Difference of the light beyond a radius: {labels[1]} minus {labels[0]}",
        "percentage points",
        radii,
        [with_errors("difference", points, sigma, places)],
        y_log=False,
    )
    return [light_beyond_plot(radii, curves), difference]
