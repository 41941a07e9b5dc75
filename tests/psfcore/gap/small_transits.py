"""A small clean transit, a quick fit, its solution and view, and effects by name, for several tests."""

from __future__ import annotations

from functools import cache

from psfcore.blind.leftover import true_coordinates
from psfcore.gap.effect import Effect
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.view import View
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Solution
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Transit
from tests.transit_files import TRUTH, diffraction


@cache
def clean(images: int = 18) -> Transit:
    plan = default_plan(images, 128, oversampling=1, brightness=8.0)
    return simulate(plan, TRUTH, diffraction(), seed=3).transit


def fit(transit: Transit) -> Solution:
    """The fit to a transit of the tests. It starts at the true PSF, which is quicker."""
    return invert(transit, start=true_coordinates(TRUTH), near=True)


@cache
def solution() -> Solution:
    return invert(clean())


@cache
def view() -> View:
    return View(solution())


def effect(name: str) -> Effect:
    return next(one for one in LIBRARY if one.name == name)
