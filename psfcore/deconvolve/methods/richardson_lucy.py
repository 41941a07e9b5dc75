"""Richardson-Lucy deconvolution; `psfcore.deconvolve.iterations.richardson_lucy` has the equations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfcore.deconvolve.declaration import Method, steps

if TYPE_CHECKING:
    from psfcore.deconvolve.conditions import Deconvolved
    from psfcore.deconvolve.problem import Problem

METHOD = Method(
    "richardson-lucy",
    "For most images. The paper recommends 20 steps and edges `zero`.",
    edges="symmetric",
    margin_share=0.05,
    parameters=(steps(20, "iterations; the paper uses 20"),),
    algorithm_version=2,
    keeps_flux=True,
    margin_of_psf=0.08,
    plane_bytes=8.0,
    transform_bytes=8.0,
)


def deconvolve(problem: Problem) -> Deconvolved:
    """Estimate the scene. The first estimate is the observation.

    The result is not negative. It is NaN where the image is not finite. Where the image is saturated, the result is an
    estimate from the surrounding pixels. Raises DataError "no-signal".
    """
    from psfcore.deconvolve.iterations.richardson_lucy import RichardsonLucy

    return problem.solve(RichardsonLucy(problem))
