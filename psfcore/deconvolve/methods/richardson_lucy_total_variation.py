"""Richardson-Lucy with total variation; `psfcore.deconvolve.iterations.richardson_lucy_total_variation` has the
equations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfcore.deconvolve.declaration import Method, Parameter, steps

if TYPE_CHECKING:
    from psfcore.deconvolve.conditions import Deconvolved
    from psfcore.deconvolve.problem import Problem

METHOD = Method(
    "richardson-lucy-total-variation",
    "For pictures of noisy images, not for photometry. The total variation is regularised.",
    edges="symmetric",
    margin_share=0.05,
    parameters=(
        steps(20),
        Parameter(
            "smoothing",
            0.01,
            0,
            0.02,  # the iteration converges only below 2 SOFTENING / 8
            "weight of the regularisation, in counts; 0 gives Richardson-Lucy",
        ),
    ),
    keeps_flux=True,
    margin_of_psf=0.08,
    plane_bytes=20.0,
    transform_bytes=8.0,
)


def deconvolve(problem: Problem, smoothing: float) -> Deconvolved:
    """Estimate the scene. The first estimate is the observation.

    The result is not negative. It is NaN where the image is not finite. Raises DataError "no-signal".
    """
    from psfcore.deconvolve.iterations.richardson_lucy_total_variation import TotalVariation

    return problem.solve(TotalVariation(problem, smoothing))
