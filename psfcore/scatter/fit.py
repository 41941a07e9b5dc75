"""From a transit to a total PSF with its errors, its doubts and its history: the whole way, for people and services.

The default is the inversion with the four biases of the published fit mended (`inversion`); beside it stand a free
fit without a formula, other shapes judged on held-out images, the first guess, and, where asked for, the published
recipe to the letter with what each of its four biases does (`published`).

Errors: photon and readout noise of every pixel, carried through (`inversion`). Where the discs scatter by more than
that from image to image, by a factor f in chi2 beyond what chance allows, all errors are multiplied by sqrt(f) and
the report says so: something is not modelled, and the errors of a mean do not shrink below what it leaves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.psf import (
    REACH_GRID_PX,
    FittedShape,
    Psf,
    crop_or_pad,
    cumulative_curve,
    encircled_energy,
)
from psfcore.scatter.as_published.equations import Equations, SubsetFits, free_fit
from psfcore.scatter.as_published.published import (
    AS_PUBLISHED,
    CORRECTED_ALONE,
    Published,
    invert_as_published,
)
from psfcore.scatter.as_published.ring_sums import segment_sums
from psfcore.scatter.as_published.segments import Segments, shells_as_published
from psfcore.scatter.inversion import Inversion, Progress, Solution, invert
from psfcore.scatter.optics import Blur, pick
from psfcore.scatter.shapes import SOFTENED_POWER_LAW, Vector, shape_named
from psfcore.scatter.total_psf import CURVE_RADII_PX
from psfcore.scatter.validation.shape_comparison import ComparedShape, compare_shapes
from psfcore.transit.first_guess import FirstGuess, first_guess
from psfcore.transit.occulter import disc_distance
from psfcore.transit.transit import Transit

Kernel = NDArray[np.float64]

RADII_PX = (*CURVE_RADII_PX, 500.0, 1000.0)
ALONE_SUBSETS = 30  # of each bias mended alone: differences between recipes that share their subsets
WORST_CHI2 = 1.5  # a pixel; that of 10,000 pixels is known to 0.014
OPEN_POINTS = 3.0  # an error of the curve from which a radius is said to be open


@dataclass(frozen=True, eq=False)
class Curve:
    """A cumulative curve C(R) in percent with its standard error, at radii in px."""

    radii_px: Vector
    pct: Vector
    sigma: Vector


@dataclass(frozen=True, eq=False)
class ShellWeightFits:
    """Scatter without a formula: weights by shell (subsets kept, shells) on `segments`, and the light beyond each edge.

    Where no pixel decides, a shell is held at the fitted shape: its spread there says nothing.
    """

    segments: Segments
    drawn: SubsetFits

    def weights_pct(self, percentiles: tuple[float, ...]) -> NDArray[np.float64]:
        """Percentiles over the subsets of the weight of a pixel of each shell: (percentiles, shells)."""
        return np.asarray(np.percentile(self.drawn.fits, percentiles, axis=0))

    def beyond_pct(self, percentiles: tuple[float, ...]) -> NDArray[np.float64]:
        """Percentiles over the subsets of the diffuse light beyond each shell's inner edge, percent."""
        light = self.drawn.fits * self.segments.counts
        beyond = 100 * np.cumsum(light[:, ::-1], axis=1)[:, ::-1]
        return np.asarray(np.percentile(beyond, percentiles, axis=0))


@dataclass(frozen=True, eq=False)
class TransitFit:
    """Everything that a transit says of a PSF."""

    transit: Transit
    solution: Solution
    overdispersion: float
    curve: Curve
    diffuse_curve: Curve
    kernel: Kernel
    scatter: Kernel
    first_guess: FirstGuess
    free: ShellWeightFits | None
    shapes: tuple[ComparedShape, ...]
    published: Published | None
    published_alone: dict[str, Published]
    limits: tuple[str, ...]

    @property
    def inversion(self) -> Inversion:
        """The fit of the shape."""
        return self.solution.inversion

    @property
    def value_sigma(self) -> dict[str, float]:
        """Standard errors of the parameters, overdispersion included."""
        factor = math.sqrt(self.overdispersion)
        return {name: factor * sigma for name, sigma in self.inversion.value_sigma.items()}

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Of the shape's coordinates, overdispersion included."""
        return self.inversion.covariance * self.overdispersion


def fit_transit(
    transit: Transit,
    *,
    shape: str = SOFTENED_POWER_LAW.name,
    as_published: bool = False,
    seed: int = 1,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> TransitFit:
    """Fit a transit. as_published: the published recipe too, and each of its biases mended alone.

    Raises DataError as `inversion.invert`, "unknown-shape".
    """
    wanted = shape_named(shape)
    guess = first_guess(transit)
    progress = _FitProgress(
        progress,
        len(transit.frames),
        compared=wanted is SOFTENED_POWER_LAW,
        published=1 + len(CORRECTED_ALONE) if as_published else 0,
    )
    solution = invert(transit, wanted, threads=threads, progress=progress)
    factor = overdispersion(solution.inversion)
    kernel, scatter, curve, diffuse = _on_full_reach(solution, factor, threads)
    free = _free_shells(solution, seed, progress) if wanted.isotropic else None
    shapes = compare_shapes(solution, progress=progress) if wanted is SOFTENED_POWER_LAW else ()
    published, alone = None, {}
    if as_published:
        published = invert_as_published(transit, AS_PUBLISHED, seed=seed, threads=threads, progress=progress)
        alone = {
            name: invert_as_published(
                transit, choices, seed=seed, subsets=ALONE_SUBSETS, threads=threads, progress=progress
            )
            for name, choices in CORRECTED_ALONE.items()
        }
    return TransitFit(
        transit=transit,
        solution=solution,
        overdispersion=factor,
        curve=curve,
        diffuse_curve=diffuse,
        kernel=kernel,
        scatter=scatter,
        first_guess=guess,
        free=free,
        shapes=shapes,
        published=published,
        published_alone=alone,
        limits=_limits(solution, curve, factor),
    )


class _FitProgress:
    """Progress of the whole fit out of that of its stages: each call of a stage is a visit to one frame.

    The rounds that a fit will take are a guess; the total grows where there are more.
    """

    _COST: ClassVar[dict[str, float]] = {"reconstructing": 1.0, "errors": 1.2, "comparing": 2.5, "free": 1.0}
    _ROUND, _ROUNDS, _PUBLISHED_ROUND = 1.2, 4.0, 2.0

    def __init__(self, progress: Progress, frames: int, *, compared: bool, published: int) -> None:
        self._progress, self._done = progress, 0.0
        visits = (
            sum(self._COST.values())
            + self._ROUND * self._ROUNDS
            - (0 if compared else self._COST["comparing"])
        )
        self._total = frames * (visits + published * 6 * 2 * self._PUBLISHED_ROUND)

    def __call__(self, stage: str, step: int, steps: int) -> None:
        first = stage.split()[0]
        cost = self._PUBLISHED_ROUND if ":" in stage else self._ROUND
        self._done += self._COST.get(first, cost)
        self._total = max(self._total, 1.02 * self._done)
        self._progress(stage, round(10 * self._done), round(10 * self._total))


def overdispersion(inversion: Inversion) -> float:
    """By how much the discs' means scatter beyond noise, as a factor on chi2; 1 where chance could do it.

    Chance: two standard deviations of a chi2 with as many degrees of freedom as images less parameters.
    """
    freedom = len(inversion.frames) - inversion.coordinates.size
    if freedom < 1:
        return 1.0
    chi2 = sum(((f.expected - f.observed) / f.noise) ** 2 for f in inversion.frames)
    factor = chi2 / freedom
    return float(factor) if factor > 1 + 2 * math.sqrt(2 / freedom) else 1.0


def _on_full_reach(solution: Solution, factor: float, threads: int) -> tuple[Kernel, Kernel, Curve, Curve]:
    """Total PSF and scatter [y, x] on the full reach, and their cumulative curves with errors."""
    inversion = solution.inversion
    shape, at = inversion.shape, inversion.coordinates
    radii = np.array(RADII_PX)
    grid = (REACH_GRID_PX, REACH_GRID_PX)
    diffract = Convolver(solution.transit.diffraction, grid, dtype=np.float64, threads=threads)
    scatter = shape.kernel(at, REACH_GRID_PX)
    kernel = np.maximum(diffract.apply(scatter), 0.0)
    # Slopes need no more than single precision, which takes half the time.
    diffract = Convolver(solution.transit.diffraction, grid, dtype=np.float32, threads=threads)
    total_slopes, diffuse_slopes = [], []
    for k in range(at.size):
        slope = shape.slope(at, k, REACH_GRID_PX)
        diffuse_slopes.append(-100 * encircled_energy(slope, radii))
        total_slopes.append(-100 * encircled_energy(np.asarray(diffract.apply(slope), np.float64), radii))

    def curve(of: Kernel, slopes: list[Vector]) -> Curve:
        s = np.stack(slopes, axis=1)
        variance = np.einsum("rk,kl,rl->r", s, inversion.covariance * factor, s)
        return Curve(radii, cumulative_curve(of, radii), np.sqrt(np.maximum(variance, 0.0)))

    return kernel, scatter, curve(kernel, total_slopes), curve(scatter, diffuse_slopes)


def _free_shells(solution: Solution, seed: int, progress: Progress) -> ShellWeightFits:
    """The free fit on the reconstructed scenes, its biases mended, held at the fitted shape where nothing decides."""
    segments = Segments(tuple(shells_as_published()))
    diffract = Blur(solution.transit.diffraction, solution.transit.shape, threads=solution.threads)
    parts = []
    for step, n in enumerate(solution.part):
        progress("free shells", step, len(solution.part))
        frame, dark = solution.transit.frames[n], solution.sky.dark[n]
        lit = solution.blanked_scene(n)
        diffracted = diffract.convolve(lit)
        expected = pick(solution.optics.convolve(lit), dark)
        distance = disc_distance(solution.transit.shape, solution.sky.found[n].place)[dark]
        parts.append(
            Equations(
                observed=pick(solution.sky.observed[n], dark),
                ring_sums=segment_sums(
                    diffract.field(diffracted), np.stack(dark, axis=1), segments, threads=solution.threads
                ),
                unscattered=pick(diffracted, dark),
                scale=1 / np.sqrt(solution.weight(n, expected)),
                stratum=np.maximum(np.floor(frame.place.radius_px - distance), 0).astype(np.int64),
            )
        )
    shape, at = solution.inversion.shape, solution.inversion.coordinates
    towards = segments.mean_of_map(shape.kernel(at, REACH_GRID_PX))
    counts = segments.counts.astype(np.float64)
    return ShellWeightFits(segments, free_fit(Equations.joined(parts), counts, seed=seed, towards=towards))


def _limits(solution: Solution, curve: Curve, factor: float) -> tuple[str, ...]:
    """What these data cannot say, or where the fit is not to be trusted, in words."""
    inversion, out = solution.inversion, []
    if not inversion.converged:
        out.append(f"the fit had not settled after {len(inversion.rounds)} rounds")
    pointings = {frame.fov for frame in inversion.frames}
    if inversion.left_out:
        out.append(
            f"{len(inversion.left_out)} images took no part: " + "; ".join(sorted(inversion.left_out)[:5])
        )
    if len(pointings) < 3:
        out.append(
            f"{len(pointings)} pointing{'s' if len(pointings) > 1 else ''}: scatter over short and long distances "
            "can hardly be told apart; the errors hold for the fitted shape alone"
        )
    open_at = [r for r, s in zip(curve.radii_px, curve.sigma, strict=True) if s > OPEN_POINTS]
    if open_at:
        radii = ", ".join(f"{r:g}" for r in open_at)
        out.append(f"the light beyond {radii} px is open to more than {OPEN_POINTS:g} points")
    if factor > 1:
        out.append(
            f"the discs scatter {math.sqrt(factor):.1f} times as much as noise allows: an effect is not modelled, "
            "and all errors are larger by that factor"
        )
    if inversion.chi2_per_pixel > WORST_CHI2:
        out.append(
            f"the model does not describe the occulted pixels: chi2 {inversion.chi2_per_pixel:.2f} a pixel where 1 is "
            "expected; the noise figures are wrong, or the discs are not what transit.json says"
        )
    short = min(solution.transit.shape)
    if short < REACH_GRID_PX:
        out.append(
            f"the field is {short} px: what the PSF holds beyond that distance follows from the shape alone"
        )
    unsettled = [f.file for f in inversion.frames if not f.found.settled]
    if unsettled:
        out.append(f"the occulter's place is not settled in {len(unsettled)} images")
    return tuple(out)


def fitted_psf(fit: TransitFit, *, name: str, version: str, provenance: dict[str, Any]) -> Psf:
    """The PSF of a fit on the full reach, its components DIFFRACTION and SCATTER beside it."""
    return Psf(
        kernel=fit.kernel,
        name=name,
        version=version,
        instrument=fit.transit.instrument,
        status="draft",
        plate_scale_arcsec=fit.transit.plate_scale_arcsec,
        components={
            "DIFFRACTION": crop_or_pad(fit.transit.diffraction, REACH_GRID_PX),
            "SCATTER": fit.scatter,
        },
        provenance=provenance,
        fitted=FittedShape(
            shape=fit.inversion.shape.name,
            parameters=fit.inversion.shape.names,
            coordinates=tuple(fit.inversion.coordinates.tolist()),
            covariance=tuple(tuple(row) for row in fit.covariance.tolist()),
        ),
    )
