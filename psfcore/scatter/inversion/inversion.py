"""Fit diffuse scatter to a transit: find the PSF for which the occulter is dark.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm", steps (a) to (j). Here
the four biases of the published fit are corrected. One non-linear least-squares problem replaces the paper's rounds.

H(q) is the convolution with the total PSF on the field. D selects the fully dark pixels. x(q) = H(q)^-1 y is the scene of
an image y:

    r(q) = D [y - H(q) (1 - D) x(q)]                                  Eq. (1)
    minimise over q   sum over images and dark pixels of r^2 / v      Eq. (2)
    v = variance of photon and read noise at the model's intensity    Eq. (3)
    dr/dq = -D [(dH/dq) (1 - D) x - H (1 - D) G (dH/dq) x]            Eq. (4)

The paper alternates: steps (d) and (f) find the scene for a fixed PSF, steps (h) and (i) find the PSF for a fixed scene.
Eq. (4) contains both effects of a change of the PSF: it changes the light that the scene scatters into the disc, and it
changes the scene. Gauss-Newton steps with Eq. (4) converge in three or four rounds, whereas the alternation needs six or
more. The normal matrix of the steps also gives the error of the fit.

Differences from the paper; the benefit of each was measured on simulated transits:
- The weight of a pixel follows from the expected intensity, not from the observed intensity, Eq. (3).
- The scatter kernel and the diffraction PSF are convolved, because scattered light is diffracted too. Eq. (1) therefore
  contains the total PSF.
- Scattered light is counted to the corner of the full reach.
- Only fully dark pixels are set to zero, not every pixel within the radius.
- The scene is reconstructed by a linear method, not by Richardson-Lucy.
- The formula of scatter is not averaged over shells, because Eq. (1) uses the kernel at every pixel.

| symbol | name | unit |
|---|---|---|
| y | frame.pixels | DN/s |
| q | coordinates of the shape's parameters | - |
| D | dark: rows and columns of the fully dark pixels | - |
| G | optics.invert_once: inverse of H | - |
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from psfcore.errors import DataError
from psfcore.scatter.inversion.reconstruction import Progress, TransitScenes
from psfcore.scatter.inversion.results import Solution, SolutionWithoutErrors
from psfcore.scatter.inversion.solver import CONVERGED_POINTS, LEAST_FRAMES, Solver
from psfcore.scatter.optics import Optics
from psfcore.scatter.shapes import SOFTENED_POWER_LAW, Shape, Vector
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.transit import Transit

ALGORITHM_VERSION = 1  # of `invert`: a change of its results needs a new number, because solutions are kept
PILOT_FRAMES = 16
PILOT_CONVERGED_POINTS = 0.3


class Inverter(Protocol):
    """A function that makes the solution of a transit and a shape, as `invert` with these arguments does."""

    def __call__(
        self, transit: Transit, shape: Shape, /, *, start: Vector | None, threads: int, progress: Progress
    ) -> Solution: ...


def invert(
    transit: Transit,
    shape: Shape = SOFTENED_POWER_LAW,
    *,
    start: Vector | None = None,
    near: bool = False,
    counts: Sequence[int] | None = None,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> Solution:
    """Fit a shape of scatter to a transit.

    start: coordinates at which the fit starts; default: shape.start. near: True if these coordinates come from a fit to
    nearly the same images. Then the fit does not begin with a pilot fit to a few images. The occulters are located again
    only if the fit does not converge, or if C(R) changes by 0.3 percentage points or more. counts: how many times each
    image counts; default: once. An image with count 0 is held out of the fit, but it still helps to locate the occulters
    of its neighbours in time.

    Raises DataError "too-few-frames" if fewer than three frames contain an occulter, and "transit-says-too-little" if
    the frames do not determine all parameters.
    """
    total = TotalPsf(transit.diffraction, shape, transit.shape, threads=threads)
    at = shape.start if start is None else np.asarray(start, dtype=np.float64)
    kernel = total.kernel(at)
    optics = Optics(kernel, transit.shape, threads=threads)
    sky = TransitScenes(transit, optics, progress)
    sky.find(optics, kernel)
    solver = Solver(sky, total, counts or [1] * len(transit.frames), threads, progress)
    frames = solver.taking_part()
    if near:
        at = solver.solve(at, frames, CONVERGED_POINTS)
        if solver.converged and solver.moved_points < PILOT_CONVERGED_POINTS:
            return solver.solution(at)
    else:
        if len(frames) > PILOT_FRAMES + LEAST_FRAMES:
            spread = np.unique(np.linspace(0, len(frames) - 1, PILOT_FRAMES).round().astype(int))
            at = solver.solve(at, [frames[k] for k in spread], PILOT_CONVERGED_POINTS)
        at = solver.solve(at, frames, PILOT_CONVERGED_POINTS)
    kernel = total.kernel(at)  # repeat step (e) with a PSF that is nearly correct
    sky.find(Optics(kernel, transit.shape, threads=threads), kernel)
    at = solver.solve(at, solver.taking_part(), CONVERGED_POINTS)
    return solver.solution(at)


def solution_of(
    transit: Transit,
    shape: Shape,
    given: Solution | Inverter | None,
    *,
    start: Vector | None = None,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> Solution:
    """The given solution, or the solution that the given function makes. If nothing is given, `invert` makes it.

    Raises DataError "other-solution" if the given solution was made from other images, noise or diffraction PSF, or
    with another shape.
    """
    if not isinstance(given, Solution):
        make: Inverter = invert if given is None else given
        return make(transit, shape, start=start, threads=threads, progress=progress)
    of = given.transit
    same = of.frames is transit.frames and of.diffraction is transit.diffraction and of.noise == transit.noise
    if not same or given.inversion.shape.name != shape.name:
        raise DataError(
            "other-solution",
            f"expected a solution of the same transit, its noise and {shape.name}; got one of other images, of another "
            f"noise, or of {given.inversion.shape.name}: leave the solution out, so that a new one is made",
        )
    return given


def refit(
    solution: Solution,
    counts: Sequence[int],
    start: Vector,
    *,
    progress: Progress = lambda stage, step, steps: None,
) -> SolutionWithoutErrors:
    """Repeat the fit of a solution with other counts.

    counts: how many times each image counts (see `invert`). start: coordinates near the expected result, for example
    one Gauss-Newton step from the solution. The iteration starts from the scenes of the solution. Every occulter is
    located again with the PSF at the coordinates `start`. Raises the errors of `invert`.
    """
    total, threads = solution.total, solution.threads
    sky = solution.sky.copy()
    kernel = total.kernel(start)
    sky.find(Optics(kernel, solution.transit.shape, threads=threads), kernel, progress)
    solver = Solver(sky, total, counts, threads, progress)
    frames = solver.taking_part()
    at = solver.solve(start, frames, CONVERGED_POINTS)
    return SolutionWithoutErrors(
        transit=solution.transit,
        total=total,
        optics=Optics(total.kernel(at), solution.transit.shape, threads=threads),
        sky=sky,
        part=tuple(frames),
        threads=threads,
        coordinates=at,
        rounds=tuple(solver.rounds),
        converged=solver.converged,
        left_out=sky.left_out(),
    )
