"""Answers questions about a PSF from its tables, without reading the pixels of the PSF. `make` writes the tables.

    E(R) = sum of the weights with r <= R                encircled energy                Eq. (1)
    C(R) = 100 max(1 - E(R), 0)                          1 - encircled energy, percent   Eq. (2)

E is a fraction of all light. C(R) is the light that falls farther than R from the centre, or outside the array.
On an array larger than the full reach the weights can sum to more than 1 (E > 1); then C is 0.

To compute the 1-sigma error of a number that is linear in E, compute the same number from each row of
encircled_changes, and take the root of the sum of the squares of these numbers. This method includes correlations. For
example, the error of the light in an annulus is not the sum of the errors at its two radii.

Up to `exact_to_px`, E is an exact staircase. Farther out, E is interpolated linearly between the radii of the tables.

This module imports no numerical library, because the web process and the command line use it.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import Any, TypedDict

from psfcore.errors import DataError
from psfcore.instruments.files import PLATE_SCALE_TOLERANCE

SCHEMA = "psf-tables/1"
TOTAL = "TOTAL"
EXACT_TO_PX = 50
WHOLE_TO_PX = 100  # up to this radius, the tables contain every radius that is a whole number of pixels
STEP = 1.02  # beyond this radius: the ratio of two successive radii of the tables
LARGEST_COUNT = 500  # largest number of radii in one question
# Smaller interpolation errors (percentage points) are reported only as "below 0.005".
NEGLIGIBLE_POINTS = 0.005

Numbers = list[float]


class Profile(TypedDict):
    """Mean weights, by ring of one pixel.

    Attributes
    ----------
    sigma
        The standard errors of the total PSF and of its scatter; {} if the scatter was not fitted.
    """

    radius_px: Numbers
    pixels: list[int]
    mean_weight: dict[str, Numbers]
    sigma: dict[str, Numbers]
    azimuthal_rms_over_mean: Numbers  # of TOTAL


class Tables(TypedDict):
    """The tables of a PSF, as JSON values. The dictionaries are by component, TOTAL included."""

    schema: str
    name: str
    version: str
    shape: list[int]
    sum: float  # of all weights
    central_weight: float
    reach_px: float
    plate_scale_arcsec: float | None
    radii_px: Numbers  # R, ascending
    exact_to_px: int  # up to this radius E is a staircase, and the tables hold every step
    interpolation_error: dict[str, float]  # the largest error of an interpolated E, found at test radii
    encircled: dict[str, Numbers]  # E at radii_px
    # One row for each axis of the fit's covariance, with the change of E for a step of 1 sigma; {} if not fitted.
    encircled_changes: dict[str, list[Numbers]]
    profile: Profile


def curve(tables: Tables, radii: Sequence[float] | None = None) -> dict[str, Any]:
    """1 - encircled energy at each radius, in percent, by component. Default of `radii`: the radii of the tables.

    Raises DataError "bad-radius", "radius-beyond-reach".
    """
    at: Sequence[float] = tables["radii_px"] if radii is None else radii
    if radii is not None and not 0 < len(radii) <= LARGEST_COUNT:
        raise DataError("bad-radius", f"expected 1 to {LARGEST_COUNT} radii; got {len(at)}")
    find = _reader_at(tables, at)
    return {
        **_about(tables),
        "radii_px": list(at),
        "light_beyond_pct": {
            name: [_one_minus(e) for e in find(row)] for name, row in tables["encircled"].items()
        },
        "sigma_points": _sigma(tables, lambda row: [100 * e for e in find(row)]),
        "resolution": _resolution(tables),
    }


def profile(tables: Tables) -> dict[str, Any]:
    """The mean weight of the pixels in each ring, by component. A ring is one pixel wide."""
    return {
        **_about(tables),
        **tables["profile"],
        "resolution": "rings are one pixel wide: a pixel belongs to the ring whose radius_px is its distance r, "
        "rounded to whole pixels",
    }


def encircled(tables: Tables, radius: float) -> dict[str, object]:
    """The encircled energy within a radius, as a fraction of all light, by component.

    Raises DataError "bad-radius", "radius-beyond-reach".
    """
    find = _reader_at(tables, [radius])
    return {
        **_about(tables),
        "radius_px": radius,
        "light_within": {name: find(row)[0] for name, row in tables["encircled"].items()},
        "sigma": {name: s[0] for name, s in _sigma(tables, find).items()},
        "resolution": _resolution(tables),
    }


def annulus(tables: Tables, inner: float, outer: float) -> dict[str, object]:
    """The light at inner < r <= outer, as a fraction of all light, by component.

    Raises DataError "bad-annulus", "bad-radius", "radius-beyond-reach".
    """
    find = _reader_at(tables, [inner, outer])
    if inner >= outer:
        raise DataError("bad-annulus", f"expected inner < outer; got {inner:g} and {outer:g} px")

    def between(row: Numbers) -> Numbers:
        near, far = find(row)
        return [far - near]

    return {
        **_about(tables),
        "inner_px": inner,
        "outer_px": outer,
        "light": {name: between(row)[0] for name, row in tables["encircled"].items()},
        "sigma": {name: s[0] for name, s in _sigma(tables, between).items()},
        "resolution": _resolution(tables),
    }


QUESTIONS: dict[str, Callable[..., dict[str, Any]]] = {
    "curve": curve,
    "profile": profile,
    "encircled": encircled,
    "annulus": annulus,
}


def compare(one: Tables, other: Tables) -> dict[str, Any]:
    """Differences `other` minus `one` of two PSFs: 1 - encircled energy at common radii, sum, and central weight.

    Raises DataError "plate-scale-mismatch".
    """
    old_scale, new_scale = one["plate_scale_arcsec"], other["plate_scale_arcsec"]
    if (
        old_scale is not None
        and new_scale is not None
        and abs(new_scale / old_scale - 1) > PLATE_SCALE_TOLERANCE
    ):
        raise DataError(
            "plate-scale-mismatch",
            f"expected two PSFs of the same plate scale; got {old_scale:g} and {new_scale:g} arcsec/px: rebin one of "
            "them first",
        )
    reach = min(one["reach_px"], other["reach_px"])
    shared = set(other["radii_px"])
    radii = [r for r in one["radii_px"] if r <= reach and r in shared]
    names = [name for name in one["encircled"] if name in other["encircled"]]
    find = [_reader_at(tables, radii) for tables in (one, other)]
    points = {
        name: [
            _one_minus(new) - _one_minus(old)
            for old, new in zip(
                find[0](one["encircled"][name]), find[1](other["encircled"][name]), strict=True
            )
        ]
        for name in names
    }
    sigmas = [_sigma(tables, f) for tables, f in zip((one, other), find, strict=True)]
    fitted = [name for name in names if name in sigmas[0] or name in sigmas[1]]
    none = [0.0] * len(radii)
    return {
        "one": _about(one),
        "other": _about(other),
        "radii_px": radii,
        "difference_points": points,
        "sigma_points": {
            name: [
                100 * math.hypot(a, b)
                for a, b in zip(sigmas[0].get(name, none), sigmas[1].get(name, none), strict=True)
            ]
            for name in fitted
        },
        "largest_points": {name: max(row, key=abs, default=0.0) for name, row in points.items()},
        "difference_of_sums": other["sum"] - one["sum"],
        "difference_of_central_weights": other["central_weight"] - one["central_weight"],
        "only_in_one": sorted(set(one["encircled"]) - set(names)),
        "only_in_other": sorted(set(other["encircled"]) - set(names)),
        "resolution": "at radii that both tables have, without interpolation; the errors assume that the two PSFs "
        "were fitted to independent data",
    }


def _about(tables: Tables) -> dict[str, object]:
    """The fields that identify a PSF in an answer."""
    return {
        "name": tables["name"],
        "version": tables["version"],
        "shape": tables["shape"],
        "sum_on_array": tables["sum"],
        "central_weight": tables["central_weight"],
        "reach_px": tables["reach_px"],
        "plate_scale_arcsec": tables["plate_scale_arcsec"],
    }


def _resolution(tables: Tables) -> str:
    """A sentence that says at which radii the answer is exact, and how large the interpolation error is at other
    radii.
    """
    worst = 100 * max(tables["interpolation_error"].values())
    near = f"exact to {min(tables['exact_to_px'], tables['reach_px']):g} px and at whole pixels up to {WHOLE_TO_PX} px"
    if worst < NEGLIGIBLE_POINTS:
        return f"{near}; elsewhere interpolated linearly, with an error below {NEGLIGIBLE_POINTS} points"
    return (
        f"{near}; elsewhere interpolated linearly (steps of 1 px up to {WHOLE_TO_PX} px, 2 % farther out), with an "
        f"error of up to {worst:.2f} points ({100 * tables['interpolation_error'][TOTAL]:.2f} for the total PSF)"
    )


def _reader_at(tables: Tables, radii: Sequence[float]) -> Callable[[Numbers], Numbers]:
    """A function that reads a row of the tables at these radii.

    Raises DataError "bad-radius", "radius-beyond-reach".
    """
    grid, reach = tables["radii_px"], tables["reach_px"]
    for radius in radii:
        if not radius >= 0 or math.isinf(radius):
            raise DataError("bad-radius", f"expected finite radii of 0 px or more; got {radius:g}")
        if radius > reach * (1 + 1e-9):
            raise DataError(
                "radius-beyond-reach",
                f"expected radii up to the reach of the PSF, {reach:.1f} px; got {radius:g}",
            )
    # The stored radii are rounded, and a caller may give a radius such as sqrt(2) with fewer digits. Therefore radii
    # that differ only by rounding count as equal.
    places = [min(bisect_right(grid, radius * (1 + 1e-9)) - 1, len(grid) - 1) for radius in radii]

    def find(row: Numbers) -> Numbers:
        return [
            _read(tables["exact_to_px"], grid, row, at, radius)
            for at, radius in zip(places, radii, strict=True)
        ]

    return find


def _read(exact_to_px: float, grid: Numbers, row: Numbers, at: int, radius: float) -> float:
    low = grid[at]
    if radius <= low or low < exact_to_px or at + 1 == len(grid):
        return row[at]
    share = (radius - low) / (grid[at + 1] - low)
    return row[at] + share * (row[at + 1] - row[at])


def _sigma(tables: Tables, of: Callable[[Numbers], Numbers]) -> dict[str, Numbers]:
    """The 1-sigma errors of numbers that `of` computes linearly from E, by component; empty if the PSF was not
    fitted.
    """
    return {
        name: [math.hypot(*column) for column in zip(*(of(row) for row in rows), strict=True)]
        for name, rows in tables["encircled_changes"].items()
    }


def _one_minus(within: float) -> float:
    """1 - encircled energy in percent, Eq. (2)."""
    return 100 * max(1 - within, 0.0)
