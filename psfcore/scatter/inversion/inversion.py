"""Fit diffuse scatter to a transit: find the PSF for which the occulter is dark.

Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm", steps (a) to (j). The four
biases of the published fit are corrected, and its rounds are solved as one non-linear least-squares problem.

H(q) is the total PSF on the field, D selects the fully dark pixels, and x(q) = H(q)^-1 y is the scene of an image y:

    r(q) = D [y - H(q) (1 - D) x(q)]                                  Eq. (1)
    minimise over q   sum over images and dark pixels of r^2 / v      Eq. (2)
    v = variance of photon and read noise at the model's intensity    Eq. (3)
    dr/dq = -D [(dH/dq) (1 - D) x - H (1 - D) G (dH/dq) x]            Eq. (4)

The paper alternates: steps (d) and (f) find a scene at a fixed PSF, steps (h) and (i) a PSF at a fixed scene. Eq. (4)
contains both effects: the PSF changes the light in the disc, and it changes the scene that scatters into the disc. A
Gauss-Newton step with Eq. (4) converges in three or four rounds, where the alternation needs six or more. Its normal
matrix also gives the error of the fit.

Differences from the paper; the benefit of each was measured on simulated transits:
- Pixels are weighted by the expected intensity, not by the observed one, Eq. (3).
- Scatter and diffraction are convolved, so scattered light is diffracted too: Eq. (1) contains the total PSF.
- Light is counted to the corner of the full reach.
- Only fully dark pixels are set to zero, not every pixel within the radius.
- The scene is reconstructed by a linear method.
- A formula of scatter needs no shells, because Eq. (1) is exact.

| symbol | name | unit |
|---|---|---|
| y | frame.pixels | DN/s |
| q | coordinates of the shape's parameters | - |
| D | dark: rows and columns of the fully dark pixels | - |
| G | optics.invert_once | - |
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

    start: coordinates; default: the start of the shape. near: the start comes from a fit of nearly the same images.
    Then no pilot fit of a few images runs first, and occulters are located again only if the curve moves. counts: the
    weight of each frame, as the number of times that it counts; default: once each. A frame with count 0 is held out
    of the fit, but it still helps to locate the occulters of its neighbours in time.

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
    kernel = total.kernel(at)  # step (e) again, now with a PSF that is nearly correct
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
    """The given solution, or the one that the given function makes; None: that of `invert`.

    Raises DataError "other-solution" if the given solution is of other images, noise, diffraction PSF or shape.
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
    """Repeat the fit of a solution with other counts (see `invert`).

    start: coordinates near the expected result, for example one Gauss-Newton step from the solution. The iteration
    starts from the scenes of the solution, and every occulter is located again with the PSF at the start. Raises
    DataError as `invert` does.
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
