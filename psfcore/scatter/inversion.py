"""Diffuse scatter from a transit: the PSF for which the occulter is dark.

Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm", steps (a) to (j), with
the four biases of its fit mended and its rounds solved as one non-linear least-squares problem.

With H(q) the total PSF on the field, D the pixels that are fully dark, x(q) = H(q)^-1 y the scene behind an image:

    r(q) = D [y - H(q) (1 - D) x(q)]                                  Eq. (1)
    minimise over q   sum over images and dark pixels of r^2 / v      Eq. (2)
    v = variance of a photon and a readout at the model's intensity   Eq. (3)
    dr/dq = -D [(dH/dq) (1 - D) x - H (1 - D) G (dH/dq) x]            Eq. (4)

Steps (d), (f), (h), (i) of the paper alternate between a scene at a fixed PSF and a PSF at a fixed scene. Eq. (4)
holds both: what the PSF does to the disc, and what it does to the scene that then scatters into the disc. A
Gauss-Newton step with it settles in three or four rounds where the alternation needs six and more, and its normal
matrix is the fit's error.

Departures from the paper, each measured on simulated transits: weights from the expected, not the observed
intensity, Eq. (3); scatter and diffraction convolve, so scattered light is diffracted (Eq. (1) has the total PSF);
light is counted to the corner of the full reach; only what is fully dark is blanked, not every pixel within the
radius; the scene is reconstructed linearly. No shells are needed where the scatter is a formula: Eq. (1) is exact.

| symbol | name | unit |
|---|---|---|
| y | frame.pixels | DN/s |
| q | coordinates of the shape's parameters | - |
| D | dark: rows and columns of the fully dark pixels | - |
| G | optics.undo_once | - |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.psf import cumulative_curve
from psfcore.scatter.noise_transfer import noise_covariance
from psfcore.scatter.optics import Blur, Lanes, Optics, Pixels, pick, put
from psfcore.scatter.shapes import SOFTENED_POWER_LAW, Shape, Vector
from psfcore.scatter.total_psf import Kernel, TotalPsf
from psfcore.transit.occulter import LARGEST_SHIFT_PX, FoundPlace, find_occulter, fully_dark
from psfcore.transit.transit import Frame, Transit

Progress = Callable[[str, int, int], None]

CONVERGED_POINTS = 0.02  # of the cumulative curve, a tenth of the bias that is allowed
ROUNDS = 12
WARM_STEPS = 3
PILOT_FRAMES = 16
PILOT_CONVERGED_POINTS = 0.3
SLOPES_KEPT_BELOW_POINTS = 0.3
DARK_MARGIN_PX = 0.05
DARK_MARGIN_SIGMAS = 1.5
LARGEST_DARK_MARGIN_PX = 2.5
LEAST_DARK_PIXELS = 30
LEAST_LEVEL = 0.2  # of a disc's mean: what a pixel is taken to hold at least, for its variance
LEAST_FRAMES = 3
WEAKEST_DIRECTION = 1e-10  # of a normal matrix scaled to a unit diagonal


@dataclass(frozen=True)
class Round:
    """One Gauss-Newton step: what it found and how far the cumulative curve moved (points)."""

    frames: int
    values: dict[str, float]
    curve_pct: tuple[float, ...]
    moved_points: float
    chi2_per_pixel: float


@dataclass(frozen=True, eq=False)
class FrameFit:
    """One frame at the solution: where the occulter is, how dark it was and how dark it should be.

    observed, expected: means over the fully dark pixels, DN/s; noise: of the observed mean, DN/s.
    normal, score: this frame's share of the normal equations, in coordinates (a sum over its pixels). answer: how
    the expected mean changes with the coordinates, DN/s.
    """

    file: str
    fov: int
    found: FoundPlace
    dark: Pixels
    observed: float
    expected: float
    noise: float
    chi2: float
    normal: NDArray[np.float64]
    score: Vector
    answer: Vector

    @property
    def residual_pct(self) -> float:
        """Simulated minus observed, in percent of the observed mean."""
        return 100 * (self.expected - self.observed) / self.observed


@dataclass(frozen=True, eq=False)
class Inversion:
    """What a transit says of scatter: coordinates with covariance, curve with errors, and how it was found.

    radii_px, curve_pct, curve_sigma: of the total PSF's cumulative curve, on the square a field can see.
    covariance: of the coordinates, photon and readout noise of all pixels carried through the whole estimate.
    left_out: frames that took no part, with the reason.
    """

    shape: Shape
    coordinates: Vector
    covariance: NDArray[np.float64]
    radii_px: Vector
    curve_pct: Vector
    curve_sigma: Vector
    rounds: tuple[Round, ...]
    converged: bool
    frames: tuple[FrameFit, ...]
    left_out: dict[str, str]

    @property
    def values(self) -> dict[str, float]:
        """The parameters by name."""
        return self.shape.values(self.coordinates)

    @property
    def value_sigma(self) -> dict[str, float]:
        """Standard errors of the parameters by name."""
        sigma = np.sqrt(np.diag(self.covariance))
        return {
            p.name: float(abs(p.slope(float(q))) * s)
            for p, q, s in zip(self.shape.parameters, self.coordinates, sigma, strict=True)
        }

    @property
    def chi2_per_pixel(self) -> float:
        """Of all dark pixels, photon and readout noise expected; about 1 where the model is right."""
        pixels = sum(frame.dark[0].size for frame in self.frames)
        return sum(frame.chi2 for frame in self.frames) / (pixels - self.coordinates.size)


class Sky:
    """The frames in the engine's order, their scenes as last reconstructed, their occulters as last found."""

    def __init__(self, transit: Transit, optics: Optics, progress: Progress) -> None:
        self.transit = transit
        self.observed: list[Lanes] = []
        self.scenes: list[Lanes] = []
        for n, frame in enumerate(transit.frames):
            progress("reconstructing", n, len(transit.frames))
            self.observed.append(optics.lanes(frame.pixels))
            self.scenes.append(optics.undo(self.observed[-1]))
        self.found: list[FoundPlace] = []
        self.dark: list[Pixels] = []

    def copy(self) -> Sky:
        """One more, to go on from here with: no array is copied, and none is ever written to."""
        other = copy(self)
        other.scenes, other.found, other.dark = list(self.scenes), list(self.found), list(self.dark)
        return other

    def find(
        self,
        optics: Optics,
        psf_kernel: Kernel,
        progress: Progress = lambda stage, step, steps: None,
    ) -> None:
        """Step (e): where every occulter is, and which pixels are fully dark."""
        frames = self.transit.frames
        scenes = _Fields(self.scenes, optics)
        places = [f.place for f in self.found] or [frame.place for frame in frames]
        self.found = []
        for n in range(len(frames)):
            progress("finding occulters", n, len(frames))
            self.found.append(find_occulter(n, frames, scenes, places, psf_kernel, self.transit.noise))
        self.dark = [dark_pixels(frame, found) for frame, found in zip(frames, self.found, strict=True)]

    def left_out(self) -> dict[str, str]:
        """Frames that cannot take part, and why."""
        reasons = {}
        for frame, dark, found in zip(self.transit.frames, self.dark, self.found, strict=True):
            if not found.within_reach:
                reasons[frame.file] = (
                    f"expected an occulter at ({frame.place.x_px:g}, {frame.place.y_px:g}) px; "
                    f"found none within {LARGEST_SHIFT_PX:g} px"
                )
            elif not found.seen:
                reasons[frame.file] = (
                    f"expected an occulter at ({frame.place.x_px:g}, {frame.place.y_px:g}) px; "
                    f"{100 * found.depth:.0f} +- {100 * found.depth_sigma:.0f} % of the light it would hide is missing"
                )
            elif dark[0].size < LEAST_DARK_PIXELS:
                reasons[frame.file] = (
                    f"expected at least {LEAST_DARK_PIXELS} fully dark pixels, got {dark[0].size}"
                )
        return reasons


class _Fields(Sequence[NDArray[np.float32]]):
    """Scenes as fields [y, x], turned out of the engine's order only where asked for."""

    def __init__(self, lanes: Sequence[Lanes], optics: Optics) -> None:
        self._lanes, self._optics = lanes, optics
        self._last: dict[int, NDArray[np.float32]] = {}

    def __len__(self) -> int:
        return len(self._lanes)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        if index not in self._last:
            if len(self._last) > 12:
                self._last.pop(next(iter(self._last)))
            self._last[index] = self._optics.field(self._lanes[index])
        return self._last[index]


def dark_pixels(frame: Frame, found: FoundPlace) -> Pixels:
    """Rows and columns of the pixels that are surely dark: fully within the disc, less what its place is unsure by.

    A pixel whose value was filled in is not among them. A disc cut by the frame's edge has none.
    """
    shape = (frame.pixels.shape[0], frame.pixels.shape[1])
    place = found.place
    if not (0 <= place.x_px < shape[1] and 0 <= place.y_px < shape[0]):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    unsure = DARK_MARGIN_SIGMAS * max(found.sigma_x_px, found.sigma_y_px)
    dark = fully_dark(shape, place, min(DARK_MARGIN_PX + unsure, LARGEST_DARK_MARGIN_PX))
    if frame.filled is not None:
        dark &= ~frame.filled
    rows, columns = np.nonzero(dark)
    return rows, columns


@dataclass(frozen=True, eq=False)
class _Slopes:
    """How one frame's model answers to the coordinates, weighted: kept while the PSF hardly moves."""

    weight: Vector
    weighted: NDArray[np.float64]
    normal: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Measured:
    """One frame through the model: residual and expectation of its dark pixels, and its normal equations."""

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
class Reconstruction:
    """A transit behind one PSF: its scenes, where its discs are dark, and what the PSF leaves unexplained there.

    optics: the total PSF. sky: scenes and dark pixels of all frames. part: indices of the frames that took part in
    the fit of the PSF.
    """

    transit: Transit
    total: TotalPsf
    optics: Optics
    sky: Sky
    part: tuple[int, ...]
    threads: int

    def lit(self, n: int) -> Lanes:
        """The scene of frame n with its occulter dark, in the engine's order."""
        scene = self.sky.scenes[n].copy()
        put(scene, self.sky.dark[n], 0.0)
        return scene

    def residual(self, n: int) -> tuple[Vector, Vector]:
        """Eq. (1) for the dark pixels of frame n, and what was expected there, DN/s."""
        expected = pick(self.optics.see(self.lit(n)), self.sky.dark[n])
        return pick(self.sky.observed[n], self.sky.dark[n]) - expected, expected

    def weight(self, n: int, expected: Vector) -> Vector:
        """One over the variance of Eq. (3) at an expected intensity."""
        return _weight(self.transit, n, expected)

    def answer(self, n: int, slope: Blur) -> Vector:
        """How the expected dark pixels of frame n change with a change of the PSF, Eq. (4)."""
        return _answer(self.optics, slope, self.lit(n), self.sky.dark[n])


@dataclass(frozen=True, eq=False)
class Solution(Reconstruction):
    """An inversion and what it was made with, for questions that come after it; part is in the order of its frames."""

    inversion: Inversion


@dataclass(frozen=True, eq=False)
class Refit(Reconstruction):
    """The fit of some of a transit's frames, without its errors. left_out: frames that could not take part, and why.

    Scenes of frames that did not take part are still those of the fit before.
    """

    coordinates: Vector
    rounds: tuple[Round, ...]
    converged: bool
    left_out: dict[str, str]


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

    start: coordinates; none: the shape's own. near: the start is a fit of nearly the same images: none of a few of them
    goes before it, and occulters are looked for again only where the curve moves. counts: how often each frame counts, 0
    for one that is held out (it is still looked at, as a neighbour in time and for its occulter's place); none: once
    each. Raises DataError "too-few-frames" (fewer than three with an occulter in them), "transit-says-too-little" (the
    frames leave a parameter open).
    """
    total = TotalPsf(transit.diffraction, shape, transit.shape, threads=threads)
    at = shape.start if start is None else np.asarray(start, dtype=np.float64)
    kernel = total.kernel(at)
    optics = Optics(kernel, transit.shape, threads=threads)
    sky = Sky(transit, optics, progress)
    sky.find(optics, kernel)
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
    kernel = total.kernel(at)  # step (e) again, with a PSF that is nearly right
    sky.find(Optics(kernel, transit.shape, threads=threads), kernel)
    at = solver.solve(at, solver.taking_part(), CONVERGED_POINTS)
    return solver.solution(at)


def refit(
    solution: Solution,
    counts: Sequence[int],
    start: Vector,
    *,
    progress: Progress = lambda stage, step, steps: None,
) -> Refit:
    """The same fit with other counts, as `invert` has them, where one with all frames is there to begin from.

    start: coordinates near to the result, such as one step from the solution. Scenes are iterated on from those of
    the solution, and every occulter is looked for again with the PSF at the start. Raises DataError as `invert`.
    """
    total, threads = solution.total, solution.threads
    sky = solution.sky.copy()
    kernel = total.kernel(start)
    sky.find(Optics(kernel, solution.transit.shape, threads=threads), kernel, progress)
    solver = _Solver(sky, total, counts, threads, progress)
    frames = solver.taking_part()
    at = solver.solve(start, frames, CONVERGED_POINTS)
    return Refit(
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


class _Solver:
    """Gauss-Newton steps on Eq. (2)."""

    def __init__(
        self, sky: Sky, total: TotalPsf, counts: Sequence[int], threads: int, progress: Progress
    ) -> None:
        self._sky, self._total, self._threads, self._progress = sky, total, threads, progress
        self._counts = counts
        self.rounds: list[Round] = []
        self.converged = False

    @property
    def moved_points(self) -> float:
        """How far the cumulative curve has moved since the first round, in points."""
        first, last = (np.array(self.rounds[k].curve_pct) for k in (0, -1))
        return float(np.abs(last - first).max())

    def taking_part(self) -> list[int]:
        """Indices of the frames with enough dark pixels; DataError "too-few-frames"."""
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
                f"expected at least {LEAST_FRAMES} images with an occulter in them; got {len(frames)}"
                + (f" ({reasons})" if reasons else ""),
            )
        return frames

    def solve(self, at: Vector, frames: list[int], tolerance_points: float) -> Vector:
        """Steps until the cumulative curve moves by less than the tolerance."""
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
                at, kept = (at + before[0]) / 2, {}  # too far: half-way back
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
        """The Gauss-Newton step, shortened to the largest that each parameter may take; whether it is whole."""
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
        """Eq. (1) for one frame; Eq. (3) and (4) unless they are kept from the last round."""
        sky, optics = self._sky, model.optics
        dark, observed = sky.dark[n], sky.observed[n]
        scene = optics.undo(observed, sky.scenes[n], steps=WARM_STEPS)  # step (d)
        sky.scenes[n] = scene
        lit = scene.copy()
        put(lit, dark, 0.0)  # step (f)
        expected = pick(optics.see(lit), dark)
        residual = pick(observed, dark) - expected  # Eq. (1)
        if kept is not None:
            return _Measured(residual, expected, kept)
        weight = _weight(sky.transit, n, expected)
        answers = np.array([_answer(optics, blur, lit, dark) for blur in model.slope_blurs])
        weighted = answers * weight
        return _Measured(residual, expected, _Slopes(weight, weighted, weighted @ answers.T))

    def solution(self, at: Vector) -> Solution:
        """Everything at the solution: one more look at every frame, for residuals and errors."""
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
        """What the noise of all of a frame's pixels does to its score, and to its mean residual."""
        sky, dark = self._sky, self._sky.dark[n]
        templates = [*measured.slopes.weighted, np.full(dark[0].size, 1 / dark[0].size)]
        covariance = noise_covariance(model.optics, sky.transit.frames[n], dark, templates, sky.transit.noise)
        return covariance[:-1, :-1], float(np.sqrt(covariance[-1, -1]))

    def _frame_fit(self, n: int, measured: _Measured, mean_noise: float) -> FrameFit:
        frame = self._sky.transit.frames[n]
        return FrameFit(
            file=frame.file,
            fov=frame.pointing,
            found=self._sky.found[n],
            dark=self._sky.dark[n],
            observed=float((measured.expected + measured.residual).mean()),
            expected=float(measured.expected.mean()),
            noise=mean_noise,
            chi2=measured.chi2,
            normal=measured.slopes.normal,
            score=measured.score,
            answer=(measured.slopes.weighted / measured.slopes.weight).mean(axis=1),
        )


@dataclass(frozen=True, eq=False)
class _Model:
    """The PSF at some coordinates, ready for use, and its slopes there."""

    optics: Optics
    slope_blurs: list[Blur]
    curve: Vector
    curve_slopes: NDArray[np.float64]


def _weight(transit: Transit, n: int, expected: Vector) -> Vector:
    """One over the variance of Eq. (3)."""
    level = np.maximum(expected, LEAST_LEVEL * expected.mean())
    return np.asarray(1 / transit.noise.variance(level, transit.frames[n].exposure_s))


def _answer(optics: Optics, slope: Blur, lit: Lanes, dark: Pixels) -> Vector:
    """Eq. (4), its sign turned: how the expected dark pixels change with one coordinate."""
    changed = slope.see(lit)
    scene = optics.undo_once(changed)
    put(scene, dark, 0.0)
    return pick(changed, dark) - pick(optics.see(scene), dark)


def _check_determined(normal: NDArray[np.float64], shape: Shape) -> None:
    """Raise DataError "transit-says-too-little" where the frames leave a combination of parameters open."""
    diagonal = np.sqrt(np.diag(normal))
    if not (np.isfinite(normal).all() and (diagonal > 0).all()):
        raise DataError("transit-says-too-little", "expected discs that answer to the PSF; got none that do")
    weakest = float(np.linalg.eigvalsh(normal / np.outer(diagonal, diagonal))[0])
    if weakest < WEAKEST_DIRECTION:
        names = ", ".join(shape.names)
        raise DataError(
            "transit-says-too-little",
            f"expected frames that tell {names} apart; got some that leave a combination of them open",
        )
