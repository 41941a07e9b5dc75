"""Basic iterative deconvolution; `psfcore.deconvolve.iterations.basic_iterative` has the equations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfcore.deconvolve.declaration import Method, steps

if TYPE_CHECKING:
    from psfcore.deconvolve.conditions import Deconvolved
    from psfcore.deconvolve.problem import Problem

METHOD = Method(
    "basic-iterative",
    "For a bright source near an edge, as the paper recommends. Results may be negative.",
    edges="symmetric",
    margin_share=0.015,
    parameters=(steps(20),),
    may_be_negative=True,
    margin_of_psf=0.28,
    plane_bytes=12.0,
    transform_bytes=18.0,
)


def deconvolve(problem: Problem) -> Deconvolved:
    """Estimate the scene. The first estimate is the observation.

    The result may be negative. It is NaN where the image is not finite. Saturated pixels keep their first estimate.
    Raises DataError "method-diverges".
    """
    from psfcore.deconvolve.iterations.basic_iterative import solve

    return solve(problem)
