"""Questions about a PSF, answered from its tables: looked up and interpolated, nothing computed anew.

The tables are those of `psfcore.tables.make`. E(R), the light within R, is a staircase as far as they are exact,
and taken as linear between their radii beyond. A 1-sigma error is the same figure read off the changes that a fit
leaves open, so that an annulus has its own error and not those of two curves added up.

No numerics are imported: the web process answers with this, and so does the command line.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from psfcore.errors import DataError

SCHEMA = "psf-tables/1"
LARGEST_COUNT = 500
PLATE_SCALE_TOLERANCE = 0.01
SMALLEST_WORTH_SAYING = 0.005  # points

Tables = Mapping[str, Any]
Numbers = list[float]


def curve(tables: Tables, radii: Sequence[float] | None = None) -> dict[str, Any]:
    """Light beyond each radius in percent, by component; without radii at those of the tables."""
    wanted: Sequence[float] = tables["radii_px"] if radii is None else radii
    if radii is not None and not 0 < len(radii) <= LARGEST_COUNT:
        raise DataError("bad-radius", f"expected 1 to {LARGEST_COUNT} radii; got {len(wanted)}")
    find = _finder(tables, wanted)
    return {
        **_what(tables),
        "radii_px": list(wanted),
        "light_beyond_pct": {
            name: [_beyond(e) for e in find(row)] for name, row in tables["encircled"].items()
        },
        "sigma_points": _sigma(tables, lambda row: [100 * e for e in find(row)]),
        "resolution": _resolution(tables),
    }


def profile(tables: Tables) -> dict[str, Any]:
    """Mean weight of a pixel by ring, one ring a pixel of radius, by component."""
    return {**_what(tables), **tables["profile"], "resolution": "rings one pixel wide: r rounds to radius_px"}


def encircled(tables: Tables, radius: float) -> dict[str, Any]:
    """Light within a radius as a fraction of all light, by component."""
    find = _finder(tables, [radius])
    return {
        **_what(tables),
        "radius_px": radius,
        "light_within": {name: find(row)[0] for name, row in tables["encircled"].items()},
        "sigma": {name: s[0] for name, s in _sigma(tables, find).items()},
        "resolution": _resolution(tables),
    }


def annulus(tables: Tables, inner: float, outer: float) -> dict[str, Any]:
    """Light farther than `inner` and not farther than `outer`, as a fraction of all light, by component."""
    find = _finder(tables, [inner, outer])
    if inner >= outer:
        raise DataError("bad-annulus", f"expected inner < outer; got {inner:g} and {outer:g} px")

    def between(row: Numbers) -> Numbers:
        near, far = find(row)
        return [far - near]

    return {
        **_what(tables),
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
    """Differences of two PSFs, `other` minus `one`: of their curves at the radii that both have, and of their totals.

    Raises DataError "plate-scale-mismatch" where their pixels are not the same.
    """
    scales = [tables["plate_scale_arcsec"] for tables in (one, other)]
    if None not in scales and abs(scales[1] / scales[0] - 1) > PLATE_SCALE_TOLERANCE:
        raise DataError(
            "plate-scale-mismatch",
            f"expected two PSFs on the same pixels; got {scales[0]:g} and {scales[1]:g} arcsec/px: rebin one first",
        )
    reach = min(one["reach_px"], other["reach_px"])
    shared = set(other["radii_px"])
    radii = [r for r in one["radii_px"] if r <= reach and r in shared]
    names = [name for name in one["encircled"] if name in other["encircled"]]
    find = [_finder(tables, radii) for tables in (one, other)]
    points = {
        name: [
            _beyond(new) - _beyond(old)
            for old, new in zip(
                find[0](one["encircled"][name]), find[1](other["encircled"][name]), strict=True
            )
        ]
        for name in names
    }
    sigmas = [_sigma(tables, f) for tables, f in zip((one, other), find, strict=True)]
    known = [name for name in names if name in sigmas[0] or name in sigmas[1]]
    none = [0.0] * len(radii)
    return {
        "one": _what(one),
        "other": _what(other),
        "radii_px": radii,
        "difference_points": points,
        "sigma_points": {
            name: [
                100 * math.hypot(a, b)
                for a, b in zip(sigmas[0].get(name, none), sigmas[1].get(name, none), strict=True)
            ]
            for name in known
        },
        "largest_points": {name: max(row, key=abs, default=0.0) for name, row in points.items()},
        "difference_of_sums": other["sum"] - one["sum"],
        "difference_of_central_weights": other["central_weight"] - one["central_weight"],
        "only_in_one": sorted(set(one["encircled"]) - set(names)),
        "only_in_other": sorted(set(other["encircled"]) - set(names)),
        "resolution": "at the radii of the tables, without interpolation; errors as of two fits that share no data",
    }


def _what(tables: Tables) -> dict[str, Any]:
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
    worst = 100 * max(tables["interpolation_error"].values())
    near = f"exact to {min(tables['exact_to_px'], tables['reach_px']):g} px and at whole pixels to 100"
    if worst < SMALLEST_WORTH_SAYING:
        return f"{near}; between the table's radii linear, off by less than {SMALLEST_WORTH_SAYING} points"
    return (
        f"{near}; between the table's radii (steps of 1 px to 100, 2 % beyond) linear, off by up to {worst:.2f} points "
        f"({100 * tables['interpolation_error']['TOTAL']:.2f} for the total)"
    )


def _finder(tables: Tables, radii: Sequence[float]) -> Callable[[Numbers], Numbers]:
    """What reads a row of the tables at these radii; DataError where one cannot be."""
    grid, reach = tables["radii_px"], tables["reach_px"]
    for radius in radii:
        if not radius >= 0 or math.isinf(radius):
            raise DataError("bad-radius", f"expected radii of 0 px or more; got {radius:g}")
        if radius > reach * (1 + 1e-9):
            raise DataError(
                "radius-beyond-reach",
                f"expected radii within {reach:.1f} px, the PSF's reach; got {radius:g}",
            )
    # Stored radii are rounded: a radius such as sqrt(2) may be given with more digits, or fewer.
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
    """1-sigma errors of figures that are linear in E, by component; none where the PSF was not fitted."""
    return {
        name: [math.hypot(*column) for column in zip(*(of(row) for row in rows), strict=True)]
        for name, rows in tables["encircled_changes"].items()
    }


def _beyond(within: float) -> float:
    """Light beyond, percent: an array larger than the full reach holds more than all of the light."""
    return 100 * max(1 - within, 0.0)
