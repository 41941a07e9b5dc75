"""Richardson-Lucy beyond the field; `psfcore.deconvolve.iterations.richardson_lucy_extended` has the equations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfcore.deconvolve.declaration import Method, steps

if TYPE_CHECKING:
    from psfcore.deconvolve.conditions import Deconvolved
    from psfcore.deconvolve.problem import Problem

METHOD = Method(
    "richardson-lucy-extended",
    "For cut-outs with bright light beyond their edges. Bertero and Boccacci describe it.",
    edges="extended",
    margin_share=0.005,
    parameters=(steps(20),),
    margin_of_psf=0.56,
    plane_bytes=26.0,
    transform_bytes=8.0,
)


def deconvolve(problem: Problem) -> Deconvolved:
    """Estimate the scene in the field and in a margin around it; the result covers only the field.

    The result is not negative. It is NaN where the image is not finite. Raises DataError "no-signal".
    """
    from psfcore.deconvolve.iterations.richardson_lucy_extended import Extended

    return problem.solve(Extended(problem))
