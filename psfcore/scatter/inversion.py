"""Fit diffuse scatter to a transit: find the PSF for which the occulter is dark.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm", steps (a) to (j).
Here the four biases of the published fit are corrected. One non-linear least-squares problem replaces the paper's
rounds.

H(q) is the convolution with the total PSF on the field. D selects the fully dark pixels. x(q) = H(q)^-1 y is the scene
of an image y:

    r(q) = D [y - H(q) (1 - D) x(q)]                                  Eq. (1)
    minimise over q   sum over images and dark pixels of r^2 / v      Eq. (2)
    v = variance of photon and read noise at the model's intensity    Eq. (3)
    dr/dq = -D [(dH/dq) (1 - D) x - H (1 - D) G (dH/dq) x]            Eq. (4)

The paper alternates: steps (d) and (f) find the scene for a fixed PSF, steps (h) and (i) find the PSF for a fixed
scene. Eq. (4) contains both effects of a change of the PSF: it changes the light that the scene scatters into the disc,
and it changes the scene. Gauss-Newton steps with Eq. (4) converge in three or four rounds, whereas the alternation
needs six or more. The normal matrix of the steps also gives the error of the fit.

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

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from psfcore.arrays import Kernel, Matrix, Vector
from psfcore.errors import DataError
from psfcore.psf import cumulative_curve
from psfcore.scatter.reconstruction import (
    FrameFit,
    Inversion,
    Progress,
    Reconstruction,
    Round,
    Solution,
    TransitScenes,
    on_threads,
)
from psfcore.scatter.shapes import SOFTENED_POWER_LAW, Shape
from psfcore.scatter.total_psf import (
    NOISE_REACH_PX,
    Blur,
    Optics,
    TotalPsf,
    around_disc,
    noise_covariance,
)
from psfcore.transit.transit import Transit

ALGORITHM_VERSION = 3  # of `invert`: a change of its results needs a new number, because solutions are kept
PILOT_FRAMES = 16
PILOT_CONVERGED_POINTS = 0.3
CONVERGED_POINTS = 0.02  # limit for the change of C(R), in percentage points: a tenth of the allowed bias
ROUNDS = 12
WARM_STEPS = 3
# The Jacobian is kept while C(R) changes by less than this multiple of the tolerance. A Jacobian of another PSF moves
# the minimum by the relative error of the Jacobian times the standard error of the fit.
SLOPES_KEPT_TOLERANCES = 3.0
LEAST_FRAMES = 3
WEAKEST_DIRECTION = 1e-10  # smallest allowed eigenvalue of the normal matrix, after scaling its diagonal to 1


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

    Raises DataError "too-few-frames" if fewer than three frames contain an occulter, and "transit-says-too-little" if
    the frames do not determine all parameters.

    Parameters
    ----------
    start
        Coordinates at which the fit starts; default: shape.start.
    near
        True if these coordinates come from a fit to nearly the same images. Then the fit does not begin with a pilot
        fit to a few images. The occulters are located again only if the fit does not converge, or if C(R) changes by
        0.3 percentage points or more.
    counts
        How many times each image counts; default: once. An image with count 0 is held out of the fit, but it still
        helps to locate the occulters of its neighbours in time.
    """
    total = TotalPsf(transit.diffraction, shape, transit.shape, threads=threads)
    at = shape.start if start is None else np.asarray(start, dtype=np.float64)
    sky = _scenes(transit, total, at, threads, progress)
    solver = _Solver(sky, total, counts or [1] * len(transit.frames), threads, progress)
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


def solution_at(
    transit: Transit,
    total: TotalPsf,
    at: Vector,
    *,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> Solution:
    """The scenes, occulters, residuals and errors of a transit with the PSF at these coordinates, without any fit.

    Raises the errors of `invert`.

    Parameters
    ----------
    total
        Computation of total PSFs for the shape of the scatter.
    """
    sky = _scenes(transit, total, at, threads, progress)
    return _Solver(sky, total, [1] * len(transit.frames), threads, progress).solution(at)


def _scenes(transit: Transit, total: TotalPsf, at: Vector, threads: int, progress: Progress) -> TransitScenes:
    """The scenes and occulters of all images, for the PSF at these coordinates."""
    kernel = total.kernel(at)
    optics = Optics(kernel, transit.shape, threads=threads)
    sky = TransitScenes.reconstructed(transit, optics, progress)
    sky.find(optics, kernel)
    return sky


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
) -> tuple[Reconstruction, Vector]:
    """Repeat the fit of a solution with other counts, without errors; returns the coordinates too.

    The iteration starts from the scenes of the solution; the scenes of images outside the fit stay those of the
    solution. Every occulter is located again with the PSF at the coordinates `start`.

    Raises the errors of `invert`.

    Parameters
    ----------
    counts
        How many times each image counts (see `invert`).
    start
        Coordinates near the expected result, for example one Gauss-Newton step from the solution.
    """
    total, threads, shape = solution.total, solution.threads, solution.transit.shape
    sky, kernel = solution.sky.copy(), total.kernel(start)
    sky.find(Optics(kernel, shape, threads=threads), kernel, progress)
    solver = _Solver(sky, total, counts, threads, progress)
    frames = solver.taking_part()
    at = solver.solve(start, frames, CONVERGED_POINTS)
    return solver.reconstruction(total.kernel(at), frames), at


@dataclass(frozen=True, eq=False)
class _Measured:
    """One image compared with the model: residual and expected intensity of its dark pixels, and their Jacobian.

    The other fields are reused while the PSF hardly changes.

    Attributes
    ----------
    weight, weighted, normal
        The weights of the pixels, the weighted Jacobian, and the normal matrix of this Jacobian.
    """

    residual: Vector
    expected: Vector
    weight: Vector
    weighted: Matrix
    normal: Matrix

    @property
    def score(self) -> Vector:
        return np.asarray(self.weighted @ self.residual)

    @property
    def chi2(self) -> float:
        return float(np.sum(self.weight * self.residual**2))


@dataclass(frozen=True, eq=False)
class _Model:
    """The images with the PSF at given coordinates, and the derivatives of this PSF."""

    images: Reconstruction
    kernel: Kernel
    slope_blurs: list[Blur]
    curve: Vector
    curve_slopes: Matrix

    def twins(self) -> list[_Model]:
        """The same for each thread, see `on_threads`."""
        return [replace(self, images=images) for images in self.images.twins()]


class _Solver:
    """Gauss-Newton steps on Eq. (2)."""

    def __init__(
        self, sky: TransitScenes, total: TotalPsf, counts: Sequence[int], threads: int, progress: Progress
    ) -> None:
        self._sky, self._total, self._threads, self._progress = sky, total, threads, progress
        self._counts = counts
        self.rounds: list[Round] = []
        self.converged = False

    @property
    def moved_points(self) -> float:
        """The largest difference between the curves C(R) of the first and the last round, in percentage points."""
        first, last = (np.array(self.rounds[k].curve_pct) for k in (0, -1))
        return float(np.abs(last - first).max())

    def taking_part(self) -> list[int]:
        """Indices of the frames that the fit can use. Raises DataError "too-few-frames"."""
        left_out = self._sky.left_out()
        frames = [
            n
            for n, f in enumerate(self._sky.transit.frames)
            if f.file not in left_out and self._counts[n] > 0
        ]
        if len(frames) < LEAST_FRAMES:
            reasons = "; ".join(f"{file}: {why}" for file, why in list(left_out.items())[:3])
            raise DataError(
                "too-few-frames",
                f"expected at least {LEAST_FRAMES} images with a usable occulter; got {len(frames)}"
                + (f" ({reasons})" if reasons else "")
                + ": check the positions in transit.json, or add images",
            )
        return frames

    def solve(self, at: Vector, frames: list[int], tolerance_points: float) -> Vector:
        """Iterate until C(R) changes by less than the tolerance in one round. Return the coordinates."""
        kept: dict[int, _Measured] = {}
        curve_slopes = np.zeros((0, at.size))
        moved, self.converged = np.inf, False
        before: tuple[Vector, float] | None = None
        for _ in range(ROUNDS):
            if moved > SLOPES_KEPT_TOLERANCES * tolerance_points:
                kept = {}
            model = self._model(at, frames, with_slopes=not kept)
            curve_slopes = curve_slopes if kept else model.curve_slopes
            measured = kept = self._measure(model, frames, kept)
            chi2 = sum(self._counts[n] * m.chi2 for n, m in measured.items())
            if before is not None and chi2 > 1.2 * before[1]:
                at, kept = (at + before[0]) / 2, {}  # the step was too long: take half of it
                continue
            before = (at, chi2)
            step, whole = self._step(measured)
            moved = float(np.abs(curve_slopes @ step).max())
            pixels = sum(self._counts[n] * m.residual.size for n, m in measured.items())
            self.rounds.append(
                Round(
                    frames=len(frames),
                    values=self._total.shape.values(at),
                    curve_pct=tuple(float(c) for c in model.curve),
                    moved_points=moved,
                    chi2_per_pixel=chi2 / pixels,
                )
            )
            del model  # its memory is needed for the next one
            at = at + step
            if moved < tolerance_points and whole:
                self.converged = True
                break
        return at

    def _step(self, measured: dict[int, _Measured]) -> tuple[Vector, bool]:
        """The Gauss-Newton step, shortened if it exceeds the largest step of a parameter; True if it was not
        shortened.
        """
        normal = self._normal(measured)
        score = np.sum([self._counts[n] * m.score for n, m in measured.items()], axis=0)
        return self._total.shape.shortened(np.linalg.solve(normal, score))

    def _normal(self, measured: dict[int, _Measured]) -> Matrix:
        """The normal matrix of all images. Raises DataError "transit-says-too-little"."""
        normal = np.sum([self._counts[n] * m.normal for n, m in measured.items()], axis=0)
        _check_determined(normal, self._total.shape)
        return np.asarray(normal)

    def reconstruction(self, kernel: Kernel, frames: list[int]) -> Reconstruction:
        """The scenes with this total PSF.

        Parameters
        ----------
        frames
            The images of the fit.
        """
        transit, threads = self._sky.transit, self._threads
        optics = Optics(kernel, transit.shape, threads=threads)
        return Reconstruction(transit, self._total, optics, self._sky, tuple(frames), threads)

    def _model(self, at: Vector, frames: list[int], *, with_slopes: bool) -> _Model:
        kernel = self._total.kernel(at)
        shape, threads = self._sky.transit.shape, self._threads
        slopes = self._total.slopes(at) if with_slopes else []
        return _Model(
            images=self.reconstruction(kernel, frames),
            kernel=kernel,
            slope_blurs=[Blur(s, shape, threads=threads) for s in slopes],
            curve=cumulative_curve(kernel, self._total.radii_px),
            curve_slopes=self._total.curve_slopes(slopes),
        )

    def _measure(self, model: _Model, frames: list[int], kept: dict[int, _Measured]) -> dict[int, _Measured]:
        def one(model: _Model, n: int) -> _Measured:
            return self._measure_one(model, n, kept.get(n))

        stage = f"round {len(self.rounds) + 1}"
        results = on_threads(
            one, frames, model.twins(), lambda step: self._progress(stage, step, len(frames))
        )
        return dict(zip(frames, results, strict=True))

    def _measure_one(self, model: _Model, n: int, kept: _Measured | None) -> _Measured:
        """Compute Eq. (1) for one image. If `kept` is given, reuse its weights and Jacobian; otherwise compute Eq. (3)
        and (4).
        """
        images = model.images
        scene = self._sky.improve(n, images.optics, WARM_STEPS)  # step (d)
        slopes = model.slope_blurs if kept is None else ()
        residual, expected, jacobian = images.residual_with_jacobian(n, slopes, scene)  # step (f)
        if kept is not None:
            return replace(kept, residual=residual, expected=expected)
        weight = images.weight(n, expected)
        weighted = jacobian * weight
        return _Measured(residual, expected, weight, weighted, weighted @ jacobian.T)

    def solution(self, at: Vector) -> Solution:
        """The results at these coordinates. Every image is measured once more to obtain residuals and errors."""
        frames = self.taking_part()
        model = self._model(at, frames, with_slopes=True)
        measured = self._measure(model, frames, {})
        normal = self._normal(measured)
        spread = np.zeros_like(normal)
        fits = []

        kernel, field = model.kernel, self._sky.transit.shape
        reach = NOISE_REACH_PX + max(frame.place.radius_px for frame in self._sky.transit.frames)
        part = (min(field[0], math.ceil(2 * reach)), min(field[1], math.ceil(2 * reach)))
        near = Optics(kernel, part, threads=self._threads)

        def covariance_of(optics: Optics, n: int) -> Matrix:
            frame, dark = around_disc(self._sky.transit.frames[n], self._sky.dark[n], part)
            templates = [*measured[n].weighted, np.full(dark[0].size, 1 / dark[0].size)]
            # The covariance of the score, and in the last row that of the mean residual, from the noise of the pixels.
            return noise_covariance(optics, frame, dark, templates, self._sky.transit.noise)

        covariances = on_threads(
            covariance_of, frames, near.twins(), lambda step: self._progress("errors", step, len(frames))
        )
        for (n, m), of_noise in zip(measured.items(), covariances, strict=True):
            frame, dark = self._sky.transit.frames[n], self._sky.dark[n]
            spread += self._counts[n] ** 2 * of_noise[:-1, :-1]
            fits.append(
                FrameFit(
                    file=frame.file,
                    pointing=frame.pointing,
                    found=self._sky.found[n],
                    dark=dark,
                    observed=float((m.expected + m.residual).mean()),
                    expected=float(m.expected.mean()),
                    noise=float(np.sqrt(of_noise[-1, -1])),
                    chi2=m.chi2,
                    normal=m.normal,
                    score=m.score,
                    jacobian=m.weighted / m.weight,
                )
            )
        inverse = np.linalg.inv(normal)
        covariance = inverse @ spread @ inverse
        inversion = Inversion(
            shape=self._total.shape,
            coordinates=at,
            covariance=covariance,
            radii_px=self._total.radii_px,
            curve_pct=model.curve,
            curve_sigma=np.sqrt(np.einsum("rk,kl,rl->r", model.curve_slopes, covariance, model.curve_slopes)),
            rounds=tuple(self.rounds),
            converged=self.converged,
            frames=tuple(fits),
            left_out=self._sky.left_out(),
        )
        return Solution(**vars(model.images), inversion=inversion)


def _check_determined(normal: Matrix, shape: Shape) -> None:
    """Raise DataError "transit-says-too-little" if the images do not determine all combinations of the parameters."""
    diagonal = np.sqrt(np.diag(normal))
    if not (np.isfinite(normal).all() and (diagonal > 0).all()):
        raise DataError(
            "transit-says-too-little",
            "expected discs whose light depends on the PSF; got discs that do not depend on it; check that the images "
            "contain light",
        )
    weakest = float(np.linalg.eigvalsh(normal / np.outer(diagonal, diagonal))[0])
    if weakest < WEAKEST_DIRECTION:
        raise DataError(
            "transit-says-too-little",
            f"expected frames that determine {', '.join(shape.names)}; got frames that leave a combination of them "
            "undetermined; add images at other distances from the limb, or fit a shape with fewer parameters",
        )
