"""Fit a transit completely: the total PSF with its errors and limits, and alternative fits for comparison.

Hofmeister et al., The point-spread function of HRI_EUV, sections "The inversion algorithm" and "Inversion results". The
default is `psfcore.scatter.inversion`, which corrects the four biases of the published fit. The result also contains:
- a free fit of shells without a formula,
- other shapes, tested on held-out images,
- the first guess,
- on request, the unchanged published recipe, and four variants that each correct one of its biases (`as_published`).

The errors follow from the photon and read noise of every pixel, propagated through the fit. A disc mean is the mean of
the fully dark pixels of one image. The disc means can vary from image to image by more than this noise. Then chi2
divided by its degrees of freedom is a factor f > 1. If chance does not explain f, all errors are multiplied by sqrt(f),
and the report says so. Such an excess shows that the model lacks an effect, and averaging more images does not remove
it.

| symbol | name | unit |
|---|---|---|
| f | TransitFit.overdispersion; 1 if chance explains the excess | - |
| C(R) | Curve.pct: 100 (1 - encircled energy) at radius R | % |

`fit_json` is the report of a fit, and `fit_sentence` its summary.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from psfcore.arrays import Kernel, Matrix, Vector, json_attributes
from psfcore.deconvolve.iterations.linear import LEAST_TRANSFER
from psfcore.psf import (
    CURVE_RADII_PX,
    REACH_GRID_PX,
    FittedShape,
    Psf,
    crop_or_pad,
    cumulative_curve,
)
from psfcore.scatter.as_published import (
    AS_PUBLISHED,
    CORRECTED_ALONE,
    Equations,
    Published,
    free_fit,
    invert_as_published,
)
from psfcore.scatter.inversion import Inverter, solution_of
from psfcore.scatter.reconstruction import Inversion, Progress, Solution, on_threads
from psfcore.scatter.segments import Segments, beyond_pct, segment_sums, shells_as_published
from psfcore.scatter.shapes import SOFTENED_POWER_LAW, shape_named, stretch_of
from psfcore.scatter.total_psf import Blur, TotalPsf, curve_sigma, pick
from psfcore.scatter.validation.cross_validation import LIMITS, limits_json
from psfcore.scatter.validation.robustness import ComparedShape, compare_shapes
from psfcore.transit.first_guess import FirstGuess, first_guess
from psfcore.transit.transit import Transit

RADII_PX = (*CURVE_RADII_PX, 500.0, 1000.0)
# A recipe with one corrected bias uses the same subsets as the published recipe, so few subsets show the difference.
ALONE_SUBSETS = 30
WORST_CHI2 = 1.5  # largest acceptable chi2 per pixel; with 10,000 pixels, its standard error is 0.014
# The largest error in 16 simulated transits of 18 images of 128 px, with Gaussian cores of sigma 0.62 to 1.2 px.
BIAS_OF_BROAD_CORES_POINTS = 4.4
OPEN_POINTS = 3.0  # percentage points; a larger error of the curve is reported as a limit
SCHEMA = "psf-fit/1"


@dataclass(frozen=True, eq=False)
class Curve:
    """A cumulative curve C(R) = 100 (1 - encircled energy), percent, with its standard error, at radii in px.

    C(R) is the percentage of all light that lands farther than R from its source: "light beyond R".
    """

    radii_px: Vector
    pct: Vector
    sigma: Vector


@dataclass(frozen=True, eq=False)
class ShellWeightFits:
    """Scatter fitted shell by shell, without a formula, to subsets of equations.

    A shell that no pixel constrains stays at the fitted shape, so the spread of its weights contains no information.
    `psfcore.scatter.validation.free_shells` has another free fit: it fits deviations from the fitted shape to all dark
    pixels, as one linear least-squares problem.

    Attributes
    ----------
    segments
        The shells.
    weights
        The weights per pixel from each subset, (subsets kept, shells).
    """

    segments: Segments
    weights: Matrix

    def weights_pct(self, percentiles: tuple[float, ...]) -> Matrix:
        """The weight per pixel of each shell: percentiles of the fits to the subsets, (percentiles, shells)."""
        return np.asarray(np.percentile(self.weights, percentiles, axis=0))

    def beyond_pct(self, percentiles: tuple[float, ...]) -> Matrix:
        """The percentage of the light that is scattered beyond the inner edge of each shell.

        The result holds percentiles of the fits to the subsets, (percentiles, shells).
        """
        beyond = beyond_pct(self.weights * self.segments.counts)
        return np.asarray(np.percentile(beyond, percentiles, axis=0))


@dataclass(frozen=True, eq=False)
class TransitFit:
    """The complete fit of a transit.

    Attributes
    ----------
    kernel, scatter
        Total PSF and scatter kernel [y, x] on the full reach.
    curve, diffuse_curve
        C(R) of the total PSF and of the scatter kernel.
    free
        The free fit of shells; None for shapes that are not isotropic.
    shapes
        The compared shapes; empty if the fitted shape is not the softened power law.
    published, published_alone
        The published recipe and its variants with one corrected bias, if requested.
    limits
        Sentences about quantities that these data do not determine, and about signs that the fit is unreliable.
    """

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
        """The fit of the shape; its errors do not include overdispersion."""
        return self.solution.inversion

    @property
    def value_sigma(self) -> dict[str, float]:
        """Standard errors of the parameters by name, overdispersion included."""
        factor = math.sqrt(self.overdispersion)
        return {name: factor * sigma for name, sigma in self.inversion.value_sigma.items()}

    @property
    def covariance(self) -> Matrix:
        """Covariance matrix of the shape's coordinates, overdispersion included."""
        return self.inversion.covariance * self.overdispersion


def fit_transit(
    transit: Transit,
    *,
    shape: str = SOFTENED_POWER_LAW.name,
    as_published: bool = False,
    seed: int = 1,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
    solution: Solution | Inverter | None = None,
) -> TransitFit:
    """Fit a transit.

    Raises DataError "unknown-shape", and the errors of `solution_of` and `invert`.

    Parameters
    ----------
    as_published
        Whether to run also the published recipe, and each correction of one bias alone.
    solution
        An existing solution of this transit and shape, or a function that makes it; None: `invert` makes it.
    """
    form = shape_named(shape)
    power_law = form is SOFTENED_POWER_LAW
    guess = first_guess(transit, threads=threads)
    progress = _FitProgress(
        progress,
        len(transit.frames),
        compared=power_law,
        published=1 + len(CORRECTED_ALONE) if as_published else 0,
    )
    solution = solution_of(transit, form, solution, threads=threads, progress=progress)
    factor = overdispersion(solution.inversion)
    free = _free_shells(solution, seed, progress) if form.isotropic else None
    shapes = compare_shapes(solution, progress=progress) if power_law else ()
    kernel, scatter, curve, diffuse = _on_full_reach(solution, factor, threads)
    invert_at = partial(invert_as_published, transit, seed=seed, threads=threads, progress=progress)
    published, alone = None, {}
    if as_published:
        published = invert_at(AS_PUBLISHED)
        alone = {name: invert_at(choices, subsets=ALONE_SUBSETS) for name, choices in CORRECTED_ALONE.items()}
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
    """Progress of the whole fit, computed from the progress of its stages.

    A pass of a stage reports once for each image. The number of rounds is estimated; the total grows if a fit needs
    more rounds.
    """

    _COST: ClassVar[dict[str, float]] = {"reconstructing": 1.0, "errors": 0.1, "comparing": 2.0, "free": 0.8}
    _ROUND, _ROUNDS, _COMPARING_PASSES, _PUBLISHED_ROUND = 1.6, 4.0, 2, 2.0

    def __init__(self, progress: Progress, frames: int, *, compared: bool, published: int) -> None:
        self._progress, self._done = progress, 0.0
        visits = (
            sum(self._COST.values())
            + self._ROUND * self._ROUNDS
            + ((self._COMPARING_PASSES if compared else 0) - 1) * self._COST["comparing"]
        )
        self._total = frames * (visits + published * 6 * 2 * self._PUBLISHED_ROUND)

    def __call__(self, stage: str, step: int, steps: int) -> None:
        first = stage.split(maxsplit=1)[0]
        cost = self._PUBLISHED_ROUND if ":" in stage else self._ROUND
        self._done += self._COST.get(first, cost)
        self._total = max(self._total, 1.02 * self._done)
        self._progress(stage, round(10 * self._done), round(10 * self._total))


def overdispersion(inversion: Inversion) -> float:
    """f: chi2 of the disc means divided by its degrees of freedom; 1 if chance explains the excess.

    The degrees of freedom are the number of images minus the number of parameters. Chance explains an excess of at most
    two standard deviations of chi2.
    """
    freedom = len(inversion.frames) - inversion.coordinates.size
    if freedom < 1:
        return 1.0
    chi2 = sum(((f.expected - f.observed) / f.noise) ** 2 for f in inversion.frames)
    factor = chi2 / freedom
    return float(factor) if factor > 1 + 2 * math.sqrt(2 / freedom) else 1.0


def _on_full_reach(solution: Solution, factor: float, threads: int) -> tuple[Kernel, Kernel, Curve, Curve]:
    """Total PSF and scatter kernel [y, x] on the full reach, and C(R) of both with errors."""
    shape, at = solution.inversion.shape, solution.inversion.coordinates
    radii, total = np.array(RADII_PX), solution.total
    if total.size != REACH_GRID_PX:
        field = (
            REACH_GRID_PX // 2,
            REACH_GRID_PX // 2,
        )  # the smallest field with total PSFs on the full reach
        total = TotalPsf(solution.transit.diffraction, shape, field, threads=threads)
    scatter = shape.kernel(at, REACH_GRID_PX)
    kernel = np.maximum(total.diffracted(scatter), 0.0)
    total_slopes = (total.slope(at, k) for k in range(at.size))
    diffuse_slopes = (shape.slope(at, k, REACH_GRID_PX) for k in range(at.size))

    def curve(of: Kernel, slopes: Iterable[Kernel]) -> Curve:
        return Curve(
            radii,
            cumulative_curve(of, radii),
            curve_sigma(slopes, solution.inversion.covariance * factor, radii),
        )

    return kernel, scatter, curve(kernel, total_slopes), curve(scatter, diffuse_slopes)


def _free_shells(solution: Solution, seed: int, progress: Progress) -> ShellWeightFits:
    """Fit free shells to the reconstructed scenes, with the biases of the published fit corrected.

    Shells that no pixel constrains stay at the fitted shape.
    """
    segments = Segments(shells_as_published())
    diffract = Blur(solution.transit.diffraction, solution.transit.shape, threads=solution.threads)

    def equations(tool: tuple[Solution, Blur], n: int) -> Equations:
        solution, diffract = tool
        frame, dark, place = solution.transit.frames[n], solution.sky.dark[n], solution.sky.found[n].place
        _, expected = solution.residual(n)
        diffracted = diffract.convolve(solution.blanked_scene(n))
        distance = np.hypot(dark[0] - place.y_px, dark[1] - place.x_px)
        return Equations(
            observed=solution.observed(n),
            ring_sums=segment_sums(diffract.field(diffracted), np.stack(dark, axis=1), segments),
            unscattered=pick(diffracted, dark),
            scale=1 / np.sqrt(solution.weight(n, expected)),
            stratum=np.maximum(np.floor(frame.place.radius_px - distance), 0).astype(np.int64),
        )

    count = len(solution.part)
    tools = list(zip(solution.twins(), diffract.twins(), strict=True))
    parts = on_threads(equations, solution.part, tools, lambda step: progress("free shells", step, count))
    shape, at = solution.inversion.shape, solution.inversion.coordinates
    towards = segments.mean_of_map(shape.kernel(at, REACH_GRID_PX))
    counts = segments.counts.astype(np.float64)
    fits = free_fit(Equations.joined(parts), counts, seed=seed, towards=towards)
    return ShellWeightFits(segments, fits.fits)


def _limits(solution: Solution, curve: Curve, factor: float) -> tuple[str, ...]:
    """Sentences about quantities that these data do not determine, and about signs that the fit is unreliable."""
    inversion, out = solution.inversion, []
    if not inversion.converged:
        out.append(f"the fit did not converge in {len(inversion.rounds)} rounds")
    pointings = {frame.pointing for frame in inversion.frames}
    if inversion.left_out:
        out.append(
            f"the fit did not use {_counted(len(inversion.left_out), 'image')}: "
            + "; ".join(f"{file} ({why})" for file, why in sorted(inversion.left_out.items())[:5])
        )
    if len(pointings) < 3:
        out.append(
            f"with {_counted(len(pointings), 'pointing')}, the data hardly distinguish scatter "
            "over short distances from scatter over long distances; the errors assume the fitted shape"
        )
    open_at = [r for r, s in zip(curve.radii_px, curve.sigma, strict=True) if s > OPEN_POINTS]
    if open_at:
        radii = ", ".join(f"{r:g}" for r in open_at)
        out.append(
            f"the light beyond {radii} px has a standard error of more than {OPEN_POINTS:g} percentage points"
        )
    if factor > 1:
        out.append(
            f"the disc means vary {math.sqrt(factor):.1f} times as much as noise explains: the model lacks an "
            "effect, and all errors are multiplied by that factor"
        )
    if inversion.chi2_per_pixel > WORST_CHI2:
        out.append(
            f"the model does not describe the occulted pixels: chi2 per pixel is {inversion.chi2_per_pixel:.2f}, "
            "expected 1; check the noise figures, and the positions and radii of the discs in transit.json"
        )
    if solution.optics.least_transfer < LEAST_TRANSFER:
        out.append(
            "the diffraction PSF blurs so much that the images do not contain the finest structures: in simulations "
            f"with such PSFs, the fraction of scattered light was wrong by up to {BIAS_OF_BROAD_CORES_POINTS:g} "
            "percentage points"
        )
    short = min(solution.transit.shape)
    if short < REACH_GRID_PX:
        out.append(
            f"the field is {short} px wide: beyond that distance the PSF is an extrapolation of the fitted shape"
        )
    unsettled = [f.file for f in inversion.frames if not f.found.settled]
    if unsettled:
        out.append(f"the position of the occulter did not converge in {_counted(len(unsettled), 'image')}")
    return tuple(out)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' if count > 1 else ''}"


def fitted_psf(fit: TransitFit, *, name: str, version: str, provenance: dict[str, object]) -> Psf:
    """The fitted PSF, on the full reach (2048 px x 2048 px), with its components DIFFRACTION and SCATTER."""
    return psf_of_fit(
        fit.kernel,
        fit.scatter,
        fit.solution,
        fit.covariance,
        name=name,
        version=version,
        provenance=provenance,
    )


def psf_of_fit(
    kernel: Kernel,
    scatter: Kernel,
    solution: Solution,
    covariance: Matrix,
    *,
    name: str,
    version: str,
    provenance: dict[str, object],
) -> Psf:
    """A draft PSF with the fitted shape of a solution and the components DIFFRACTION and SCATTER.

    Parameters
    ----------
    covariance
        Covariance matrix of the coordinates.
    """
    transit, inversion = solution.transit, solution.inversion
    diffraction = crop_or_pad(transit.diffraction, kernel.shape[0])
    return Psf(
        kernel=kernel,
        instrument=transit.instrument,
        status="draft",
        plate_scale_arcsec=transit.plate_scale_arcsec,
        components={"DIFFRACTION": diffraction, "SCATTER": scatter},
        fitted=FittedShape(
            shape=inversion.shape.name,
            parameters=inversion.shape.names,
            coordinates=tuple(inversion.coordinates.tolist()),
            covariance=tuple(tuple(row) for row in covariance.tolist()),
        ),
        name=name,
        version=version,
        provenance=provenance,
    )


def fit_json(fit: TransitFit) -> dict[str, object]:
    """The fit as JSON: parameters and curves with errors, every image, the alternative fits, and the limits."""
    inversion = fit.inversion
    values, sigma = inversion.values, fit.value_sigma
    out: dict[str, object] = {
        "schema": SCHEMA,
        "sentence": fit_sentence(fit),
        "shape": inversion.shape.name,
        "parameters": inversion.shape.described(values, sigma),
        "coordinates": {
            "scales": [p.scale for p in inversion.shape.parameters],
            "values": inversion.coordinates.tolist(),
            "covariance": fit.covariance.tolist(),
        },
        "curve": _curve_json(fit.curve),
        "diffuse_curve": _curve_json(fit.diffuse_curve),
        "chi2_per_pixel": inversion.chi2_per_pixel,
        "overdispersion": fit.overdispersion,
        "converged": inversion.converged,
        "rounds": [
            {
                "parameters": r.values,
                **json_attributes(r, "frames", "curve_pct", "moved_points", "chi2_per_pixel"),
            }
            for r in inversion.rounds
        ],
        "frames": [
            {
                "file": f.file,
                "fov": f.pointing,
                "x": f.found.place.x_px,
                "y": f.found.place.y_px,
                "r": f.found.place.radius_px,
                "x_sigma": f.found.sigma_x_px,
                "y_sigma": f.found.sigma_y_px,
                "neighbours": f.found.neighbours,
                "dark_pixels": int(f.dark[0].size),
                "observed_dn_s": f.observed,
                "expected_dn_s": f.expected,
                "noise_dn_s": f.noise,
                "residual_pct": f.residual_pct,
            }
            for f in inversion.frames
        ],
        "left_out": inversion.left_out,
        "limits": list(fit.limits),
        "first_guess": fit.first_guess.to_json(),
        "inputs_sha256": fit.transit.sha256,
    }
    if "stretch_p" in values:
        stretch, angle = stretch_of(values)
        out["stretch"] = {"stretch": stretch, "angle_deg": angle}
    out["shapes"] = [
        {
            "name": s.name,
            "added": {name: {"value": v, "sigma": e} for name, (v, e) in s.added.items()},
            "delta_chi2": s.gain,
            "delta_chi2_held_out": s.held_out_gain,
        }
        for s in fit.shapes
    ]
    if fit.free is not None:
        out["free_shells"] = {
            "edges_px": list(fit.free.segments.edges_px),
            "weight": limits_json(fit.free.weights_pct(LIMITS)),
            "diffuse_light_beyond_inner_edge_pct": limits_json(fit.free.beyond_pct(LIMITS)),
        }
    if fit.published is not None:
        out["as_published"] = _published_json(fit, fit.published)
    return out


def fit_sentence(fit: TransitFit) -> str:
    """A summary of the fit in one sentence."""
    values, sigma, curve = fit.inversion.values, fit.value_sigma, fit.curve
    at = {r: (c, s) for r, c, s in zip(curve.radii_px, curve.pct, curve.sigma, strict=True)}
    beyond = ", ".join(f"{at[r][0]:.2f} ± {at[r][1]:.2f} % beyond {r:g} px" for r in (10.0, 100.0))
    return (
        f"{100 * values['total']:.2f} ± {100 * sigma['total']:.2f} % of the light is scattered diffusely; with "
        f"diffraction, {at[0.5][0]:.2f} ± {at[0.5][1]:.2f} % of the light lands outside its pixel, {beyond} "
        f"({len(fit.inversion.frames)} images, chi2 per pixel {fit.inversion.chi2_per_pixel:.3f})."
    )


def _curve_json(curve: Curve) -> dict[str, list[float]]:
    return {
        "radii_px": curve.radii_px.tolist(),
        "light_beyond_pct": curve.pct.tolist(),
        "sigma": curve.sigma.tolist(),
    }


def _published_json(fit: TransitFit, published: Published) -> dict[str, object]:
    here = dict(zip(fit.curve.radii_px, fit.curve.pct, strict=True))

    def one(p: Published) -> dict[str, object]:
        return {
            **json_attributes(p, "a", "b_px", "c", "total", "radii_px"),
            "counted_on_grid_px": p.grid_px,
            "lines": p.equations,
            "light_beyond_pct": p.curve_pct.tolist(),
            "minus_default_points": [c - here[r] for r, c in zip(p.radii_px, p.curve_pct, strict=True)],
            "rounds": [{"fit": fit, "curve_pct": curve.tolist()} for fit, curve in p.rounds],
        }

    return {
        "whole": one(published) | {"spread_of_draws": published.spread},
        "one_bias_mended": {
            name: one(p) | {"minus_published_points": (p.curve_pct - published.curve_pct).tolist()}
            for name, p in fit.published_alone.items()
            if p.radii_px.size == published.radii_px.size
        },
    }
