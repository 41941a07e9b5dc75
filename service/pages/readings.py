"""Reads the stored JSON reports for pages. This is the only module of the pages that knows the fields of these reports.

| schema | what is read |
|---|---|
| psf-fit | parameters, free shells, the residual of each image |
| cross-validation | bands of the parameters |
| gap | the discs: position, time, residual without and with the named effects |
| rerun | the arrays that were compared, and what made each of the two results |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite, sqrt
from typing import Any

from service.pages.plots import Numbers, Plot, Series, radial_plot, with_errors

Report = Mapping[str, Any]
Row = tuple[str, ...]
MAP_PX = 400  # edge length of the map of discs in the units of its picture
DISC_PX = 9
NOT_COMPARED = ("id", "created_at")  # these always differ, or are always the same
# The ends of the scale of residuals; the middle is grey, so that it is seen on light and dark pages.
BELOW, MIDDLE, ABOVE = (33, 102, 172), (190, 190, 190), (178, 24, 43)


# --- a fit ------------------------------------------------------------------------------------------------


def fit_parameters(fit: Report) -> list[Row]:
    """The parameters of a fit: name, value, standard error, unit, meaning."""
    return [
        (name, f"{found['value']:.5g}", f"{found['sigma']:.2g}", found["unit"], found["meaning"])
        for name, found in fit["parameters"].items()
    ]


def fit_plots(fit: Report) -> list[Plot]:
    """The free shells of a fit if they were fitted, and the residual of each image."""
    return [*_free_shells(fit), _fit_residuals(fit)]


def _free_shells(fit: Report) -> list[Plot]:
    free = fit.get("free_shells")
    if free is None:
        return []
    title, series = "Weight of the scatter without a formula", [_banded("free shells", free["weight"])]
    return [radial_plot(title, "weight of a pixel", _middles(free["edges_px"]), series)]


def _fit_residuals(fit: Report) -> Plot:
    frames = fit["frames"]
    residuals = [frame["residual_pct"] for frame in frames]
    errors = [100 * frame["noise_dn_s"] / frame["observed_dn_s"] for frame in frames]
    return Plot(
        "Residual of each image",
        "number of the image",
        "simulated minus observed (%)",
        list(range(len(frames))),
        [with_errors("residual", residuals, errors, draw="points")],
        names=[_image_name(frame) for frame in frames],
    )


# --- a cross-validation -----------------------------------------------------------------------------------


def band_parameters(report: Report) -> list[Row]:
    """The parameters over all folds: name, median, and the limits of one and of two standard deviations."""
    return [
        (
            name,
            f"{limits['median']:.4g}",
            f"{limits['minus_1_sigma']:.4g} to {limits['plus_1_sigma']:.4g}",
            f"{limits['minus_2_sigma']:.4g} to {limits['plus_2_sigma']:.4g}",
        )
        for name, limits in report["parameters"].items()
    ]


def _banded(label: str, limits: Mapping[str, Numbers]) -> Series:
    return Series(label, limits["median"], limits["minus_1_sigma"], limits["plus_1_sigma"])


# --- a gap ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Disc:
    """A disc on the map. x, y: position in the picture, y = 0 at the top. row: its row in the tables of the plots."""

    row: int
    x: float
    y: float
    radius: float
    colour: str
    name: str
    told: str


@dataclass(frozen=True)
class GapMap:
    """The discs of a gap report on the detector, and their residuals against time.

    width, height: size of the picture. largest: the residual at the ends of the colour scale, percent.
    """

    width: float
    height: float
    discs: Sequence[Disc]
    residuals: Plot
    largest: float


def gap_map(report: Report) -> GapMap | None:
    """The map of a gap report with its residuals; None if no image could be held out, so that there are no residuals."""
    images = sorted(
        (image for image in report["images"] if image["residual_pct"] is not None),
        key=lambda image: image["time_s"],
    )
    if not images:
        return None
    ny, nx = report["shape"]
    scale = MAP_PX / max(ny, nx)
    largest = max(abs(image["residual_pct"]) for image in images) or 1.0
    discs = [
        Disc(
            row,
            image["x_px"] * scale,
            (ny - image["y_px"]) * scale,
            DISC_PX,
            _colour(image["residual_pct"] / largest),
            _image_name(image),
            f"{_image_name(image)}: {image['residual_pct']:+.2f} ± {image['noise_pct']:.2f} %",
        )
        for row, image in enumerate(images)
    ]
    return GapMap(nx * scale, ny * scale, discs, _gap_residuals(images), largest)


def _gap_residuals(images: Sequence[Report]) -> Plot:
    series = [_gap_series("fitted model", images, "residual_pct", "noise_pct")]
    if any(image["residual_after_pct"] is not None for image in images):
        series.append(_gap_series("with the named effects", images, "residual_after_pct", "noise_after_pct"))
    return Plot(
        "Residuals of the held-out discs against time",
        "time after the first image (s)",
        "simulated minus observed (%)",
        [image["time_s"] for image in images],
        series,
        names=[_image_name(image) for image in images],
    )


def _gap_series(label: str, images: Sequence[Report], of: str, error: str) -> Series:
    values, errors = ([image[name] for image in images] for name in (of, error))
    return with_errors(label, values, errors, draw="points")


def _colour(part: float) -> str:
    """The colour of a residual. part: the residual divided by the largest one, -1 to 1."""
    end = ABOVE if part > 0 else BELOW
    mixed = (round(m + abs(part) * (e - m)) for m, e in zip(MIDDLE, end, strict=True))
    return "#" + "".join(f"{value:02x}" for value in mixed)


# --- a rerun ----------------------------------------------------------------------------------------------


def rerun_arrays(report: Report) -> list[Row]:
    """The arrays that a rerun compared: name, whether equal, and the largest difference as a part of the largest value."""
    return [
        (name, "equal" if found["same"] else "different", _figure(found["largest_relative"]))
        for name, found in report["arrays"].items()
    ]


def rerun_makers(report: Report) -> list[Row]:
    """The properties that were different when the two results were made: name, first value, new value."""
    first, again = (_flat(report[name]) for name in ("first", "again"))
    names = [*first, *(name for name in again if name not in first)]
    rows = [(name, first.get(name, "-"), again.get(name, "-")) for name in names if name not in NOT_COMPARED]
    return [row for row in rows if row[1] != row[2]]


def _flat(made: Report) -> dict[str, str]:
    libraries = made.get("libraries") or {}
    own = {name: str(value) for name, value in made.items() if name != "libraries" and value is not None}
    return own | {f"library {name}": str(version) for name, version in libraries.items()}


# --- all --------------------------------------------------------------------------------------------------


def _image_name(image: Report) -> str:
    return f"{image['file']}, pointing {image['fov']}"


def _middles(edges: Sequence[float]) -> list[float]:
    """The geometric middles of shells; half of the outer edge for a shell from the centre."""
    return [sqrt(low * high) if low > 0 else high / 2 for low, high in pairwise(edges)]


def _figure(value: float | None) -> str:
    return "-" if value is None or not isfinite(value) else f"{value:.3g}"
