"""Gauss-Newton steps that solve the least-squares problem of the inversion, Eq. (2).

The equations have the same numbers as in `psfcore.scatter.inversion.inversion`. The "score" is the right-hand side of the
normal equations: J^T w r, with J the Jacobian, w the weights and r the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.psf import cumulative_curve
from psfcore.scatter.inversion.reconstruction import Progress, TransitScenes, jacobian_row, pixel_weight
from psfcore.scatter.inversion.results import FrameFit, Inversion, Round, Solution
from psfcore.scatter.noise_transfer import noise_covariance
from psfcore.scatter.optics import Blur, Optics, pick, put
from psfcore.scatter.shapes import Shape, Vector
from psfcore.scatter.total_psf import TotalPsf

CONVERGED_POINTS = 0.02  # limit for the change of C(R), in percentage points: a tenth of the allowed bias
ROUNDS = 12
WARM_STEPS = 3
SLOPES_KEPT_BELOW_POINTS = 0.3
LEAST_FRAMES = 3
WEAKEST_DIRECTION = 1e-10  # smallest allowed eigenvalue of the normal matrix, after scaling its diagonal to 1


@dataclass(frozen=True, eq=False)
class _Slopes:
    """The weighted Jacobian of one image. It is reused while the PSF hardly changes."""

    weight: Vector
    weighted: NDArray[np.float64]
    normal: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Measured:
    """One image compared with the model: residual and expected intensity of its dark pixels, and their Jacobian."""

    residual: Vector
    expected: Vector
    slopes: _Slopes

    @property
    def score(self) -> Vector:
        return np.asarray(self.slopes.weighted @ self.residual)

    @property
    def chi2(self) -> float:
        return float(np.sum(self.slopes.weight * self.residual**2))


@dataclass(frozen=True, eq=False)
class _Model:
    """The PSF at given coordinates, prepared for convolution, and the derivatives of this PSF."""

    optics: Optics
    slope_blurs: list[Blur]
    curve: Vector
    curve_slopes: NDArray[np.float64]


class Solver:
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
        kept: dict[int, _Slopes] = {}
        moved, self.converged = np.inf, False
        before: tuple[Vector, float] | None = None
        for _ in range(ROUNDS):
            if moved > SLOPES_KEPT_BELOW_POINTS or not kept:
                kept = {}
            model = self._model(at, with_slopes=not kept)
            measured = self._measure(model, frames, kept)
            kept = {n: m.slopes for n, m in measured.items()}
            chi2 = sum(self._counts[n] * m.chi2 for n, m in measured.items())
            if before is not None and chi2 > 1.2 * before[1]:
                at, kept = (at + before[0]) / 2, {}  # the step was too long: take half of it
                continue
            before = (at, chi2)
            step, whole = self._step(measured)
            moved = float(np.abs(model.curve_slopes @ step).max())
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
            at = at + step
            if moved < tolerance_points and whole:
                self.converged = True
                break
        return at

    def _step(self, measured: dict[int, _Measured]) -> tuple[Vector, bool]:
        """The Gauss-Newton step, shortened if it exceeds the largest step of a parameter; True if it was not shortened."""
        normal = np.sum([self._counts[n] * m.slopes.normal for n, m in measured.items()], axis=0)
        _check_determined(normal, self._total.shape)
        score = np.sum([self._counts[n] * m.score for n, m in measured.items()], axis=0)
        return self._total.shape.shortened(np.linalg.solve(normal, score))

    def _model(self, at: Vector, *, with_slopes: bool) -> _Model:
        kernel = self._total.kernel(at)
        shape, threads = self._sky.transit.shape, self._threads
        slopes = self._total.slopes(at)
        return _Model(
            optics=Optics(kernel, shape, threads=threads),
            slope_blurs=[Blur(s, shape, threads=threads) for s in slopes] if with_slopes else [],
            curve=cumulative_curve(kernel, self._total.radii_px),
            curve_slopes=self._total.curve_slopes(slopes),
        )

    def _measure(self, model: _Model, frames: list[int], kept: dict[int, _Slopes]) -> dict[int, _Measured]:
        measured = {}
        for step, n in enumerate(frames):
            self._progress(f"round {len(self.rounds) + 1}", step, len(frames))
            measured[n] = self._measure_one(model, n, kept.get(n))
        return measured

    def _measure_one(self, model: _Model, n: int, kept: _Slopes | None) -> _Measured:
        """Compute Eq. (1) for one image. If `kept` is given, reuse its weights and Jacobian; otherwise compute Eq. (3) and (4)."""
        sky, optics = self._sky, model.optics
        dark, observed = sky.dark[n], sky.observed[n]
        scene = optics.invert(observed, sky.scenes[n], steps=WARM_STEPS)  # step (d)
        sky.scenes[n] = scene
        blanked = scene.copy()
        put(blanked, dark, 0.0)  # step (f)
        expected = pick(optics.convolve(blanked), dark)
        residual = pick(observed, dark) - expected  # Eq. (1)
        if kept is not None:
            return _Measured(residual, expected, kept)
        weight = pixel_weight(sky.transit, n, expected)
        jacobian = np.array([jacobian_row(optics, blur, blanked, dark) for blur in model.slope_blurs])
        weighted = jacobian * weight
        return _Measured(residual, expected, _Slopes(weight, weighted, weighted @ jacobian.T))

    def solution(self, at: Vector) -> Solution:
        """The results at these coordinates. Every image is measured once more to obtain residuals and errors."""
        model = self._model(at, with_slopes=True)
        frames = self.taking_part()
        measured = self._measure(model, frames, {})
        normal = np.sum([self._counts[n] * m.slopes.normal for n, m in measured.items()], axis=0)
        _check_determined(normal, self._total.shape)
        spread = np.zeros_like(normal)
        fits = []
        for step, (n, m) in enumerate(measured.items()):
            self._progress("errors", step, len(measured))
            scatter, mean_noise = self._noise_of(model, n, m)
            spread += self._counts[n] ** 2 * scatter
            fits.append(self._frame_fit(n, m, mean_noise))
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
        return Solution(
            inversion=inversion,
            transit=self._sky.transit,
            total=self._total,
            optics=model.optics,
            sky=self._sky,
            part=tuple(frames),
            threads=self._threads,
        )

    def _noise_of(self, model: _Model, n: int, measured: _Measured) -> tuple[NDArray[np.float64], float]:
        """The covariance of the score and the standard error of the mean residual, from the noise of all pixels."""
        sky, dark = self._sky, self._sky.dark[n]
        templates = [*measured.slopes.weighted, np.full(dark[0].size, 1 / dark[0].size)]
        covariance = noise_covariance(model.optics, sky.transit.frames[n], dark, templates, sky.transit.noise)
        return covariance[:-1, :-1], float(np.sqrt(covariance[-1, -1]))

    def _frame_fit(self, n: int, measured: _Measured, mean_noise: float) -> FrameFit:
        frame = self._sky.transit.frames[n]
        return FrameFit(
            file=frame.file,
            pointing=frame.pointing,
            found=self._sky.found[n],
            dark=self._sky.dark[n],
            observed=float((measured.expected + measured.residual).mean()),
            expected=float(measured.expected.mean()),
            noise=mean_noise,
            chi2=measured.chi2,
            normal=measured.slopes.normal,
            score=measured.score,
            mean_jacobian=(measured.slopes.weighted / measured.slopes.weight).mean(axis=1),
        )


def _check_determined(normal: NDArray[np.float64], shape: Shape) -> None:
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
        names = ", ".join(shape.names)
        raise DataError(
            "transit-says-too-little",
            f"expected frames that determine {names}; got frames that leave a combination of them undetermined; "
            "add images at other distances from the limb, or fit a shape with fewer parameters",
        )
