"""Accelerated Richardson-Lucy; `psfcore.deconvolve.iterations.richardson_lucy_accelerated` has the equations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfcore.deconvolve.declaration import Method, Parameter, steps

if TYPE_CHECKING:
    from psfcore.deconvolve.conditions import Deconvolved
    from psfcore.deconvolve.problem import Problem

METHOD = Method(
    "richardson-lucy-accelerated",
    "For many images: the same result in half the steps. The extrapolation is that of Biggs and Andrews.",
    edges="symmetric",
    margin_share=0.05,
    parameters=(steps(10), Parameter("order", 1, 1, 2, "order of the extrapolation")),
    keeps_flux=True,
    margin_of_psf=0.08,
    plane_bytes=24.0,
    transform_bytes=8.0,
)


def deconvolve(problem: Problem, order: int) -> Deconvolved:
    """Estimate the scene. The first estimate is the observation.

    The result is not negative. It is NaN where the image is not finite. Raises DataError "no-signal".
    """
    from psfcore.deconvolve.iterations.richardson_lucy_accelerated import Accelerated

    return problem.solve(Accelerated(problem, order))
