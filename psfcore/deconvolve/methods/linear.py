"""Linear deconvolution; `psfcore.deconvolve.iterations.linear` has the equations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfcore.deconvolve.declaration import Method, steps

if TYPE_CHECKING:
    from psfcore.deconvolve.conditions import Deconvolved
    from psfcore.deconvolve.problem import Problem

METHOD = Method(
    "linear",
    "For photometry of faint pixels: no bias, results may be negative. It has converged after about five steps.",
    edges="symmetric",
    margin_share=0.015,
    parameters=(steps(5),),
    may_be_negative=True,
    margin_of_psf=0.28,
    plane_bytes=12.0,
    # At the end, the noise amplification is computed from the transfer function.
    transform_bytes=19.0,
)


def deconvolve(problem: Problem) -> Deconvolved:
    """Estimate the scene. The first estimate is the observation.

    The result may be negative. It is NaN where the image is not finite.
    """
    from psfcore.deconvolve.iterations.linear import solve

    return solve(problem)
