"""The inversion exactly as published, and variants that each correct one of its four biases.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm", steps (a) to (j).
The steps are repeated in six rounds. Each round deconvolves the images with Richardson-Lucy, locates the occulters,
sets their discs to zero, and fits subsets of equations. Three rounds fit free shells; then three rounds fit a softened
power law. Where the text of the paper leaves a choice, a comment beside the constant explains the choice made here.
`Choices` describes the four biases and their corrections.

    I_o = sum over S of psf_S A_S + (1 - sum over S of n_S psf_S) B      Eq. (1)

Each selected pixel gives one equation; I_o is the observed intensity of this pixel. Every equation is divided by its
scale (see `Equations`). The coefficients psf_S are fitted to 100 random subsets of the equations. A subset contains
1000 equations of occulted pixels and 100 equations of unocculted pixels near the edge of the disc. Each shell of the
mask that selects the occulted pixels contributes the same number of equations. No equation occurs twice in a subset, so
a subset is not a bootstrap sample. The 30 fits with the largest misfit are dropped, and the other 70 are averaged.

    free fit        psf_S >= 0, by the Trust Region Reflective algorithm              Eq. (2)
    power law       psf_S = mean of a / (b + r)^c over S, by the same algorithm       Eq. (3)

| symbol | name | unit |
|---|---|---|
| a, b, c | Published.a, b_px, c | px^c, px, - |
| S | segment of the PSF: a shell around the centre | - |
| A_S | ring_sums: sum of the scene over the segment S around the pixel | DN/s px^2 |
| B | unscattered: the scene convolved with the diffraction PSF, at the pixel | DN/s |
| n_S | counts: number of pixels in S | px^2 |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear
from threadpoolctl import threadpool_limits

from psfcore.arrays import Kernel, Matrix, Vector
from psfcore.convolution.convolver import Convolver
from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs
from psfcore.deconvolve.methods.registry import method_named
from psfcore.errors import DataError
from psfcore.image import Image
from psfcore.psf import (
    CENTRE_TOLERANCE,
    CURVE_RADII_PX,
    REACH_GRID_PX,
    Psf,
    crop_or_pad,
    cumulative_curve,
    squared_radii,
)
from psfcore.scatter.reconstruction import Progress
from psfcore.scatter.segments import Segments, segment_sums, shells_as_published
from psfcore.scatter.shapes import pixel_radii
from psfcore.transit.occulter import FoundPlace, disc_distance, find_occulter, fully_dark
from psfcore.transit.transit import Frame, Transit

Solve = Callable[
    [Matrix, Vector], tuple[Vector, float]
]  # to the coefficients and their sum of squared misfits

SUBSETS = 100
KEPT_SUBSETS = 70  # of SUBSETS
OCCULTED_EQUATIONS = 1000
UNOCCULTED_EQUATIONS = 100
UNOCCULTED = -1
LEAST_LIGHT = 1e-5
# With this weight, a shell that contains all light has as much misfit as one equation that is wrong by 10 times its
# scale.
PRIOR_WEIGHT = 10.0
PIVOT_PX = 15.0
MOST_RINGS = 40

LUCY_STEPS = 20
FREE_ROUNDS = 3
POWER_LAW_ROUNDS = 3
SHRUNK_PX = 1.0
UNOCCULTED_WITHIN_PX = 5.0
UNOCCULTED_A_FRAME = 10
LEAST_LEVEL_DN_S = 1e-3
# Each equation is divided by its observed value. In discs with only a few photons, some observed values are zero or
# negative, and their weight would be infinite. Therefore no divisor is smaller than this fraction of the disc's mean.
LEAST_OF_MEAN = 0.5


@dataclass(frozen=True)
class Choices:
    """The four biases of the published fit. True: as published. False: corrected.

    Attributes
    ----------
    weighed_by_observed
        Each equation is divided by the noisy intensity of its pixel; the fitted light in faint discs is then too low.
        Corrected: each equation is divided by the noise expected at the mean of the disc.
    added
        The scatter kernel is added to the diffraction PSF, Eq. (1). Corrected: kernel and diffraction PSF are
        convolved, so the ring sums are computed from the diffracted scene.
    counted_on_array
        The unscattered light is 1 minus the scatter summed over the array of the diffraction PSF. Corrected: the sum
        covers the full reach.
    whole_disc_blanked
        All pixels whose centres lie within the radius are set to zero. Corrected: only the fully dark pixels are set to
        zero.
    """

    weighed_by_observed: bool = True
    added: bool = True
    counted_on_array: bool = True
    whole_disc_blanked: bool = True


AS_PUBLISHED = Choices()
CORRECTED_ALONE = {
    "weights from the expected intensity": replace(AS_PUBLISHED, weighed_by_observed=False),
    "scatter and diffraction convolved": replace(AS_PUBLISHED, added=False),
    "light counted on the full reach": replace(AS_PUBLISHED, counted_on_array=False),
    "only fully dark pixels blanked": replace(AS_PUBLISHED, whole_disc_blanked=False),
}


# --- the equations and the fits to their subsets ----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Equations:
    """The equations (1) of n pixels: observed, unscattered and scale (n,), and ring_sums (n, segments).

    Attributes
    ----------
    stratum
        For an occulted pixel, the shell of the selection mask that contains it (0: outermost); for other pixels,
        UNOCCULTED.
    scale
        The number by which the equation is divided.
    """

    observed: Vector
    ring_sums: Matrix
    unscattered: Vector
    scale: Vector
    stratum: NDArray[np.int64]

    def __len__(self) -> int:
        return int(self.observed.size)

    @staticmethod
    def joined(parts: Sequence[Equations]) -> Equations:
        """The equations of several frames, concatenated."""
        columns = ([getattr(part, field.name) for part in parts] for field in fields(Equations))
        return Equations(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True, eq=False)
class SubsetFits:
    """Fits to subsets of equations; the worst fits are dropped.

    Attributes
    ----------
    fits
        Coefficients (subsets kept, n) of the segments, or a, b (px) and c.
    mean
        Mean coefficients over the kept subsets. For the power law, the mean is computed in coordinates with nearly
        Gaussian errors, because a varies by powers of ten between subsets.
    """

    fits: Matrix
    mean: Vector


def choose_subset(equations: Equations, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of one random subset of the equations; no equation occurs twice.

    All strata of occulted pixels contribute the same number of equations. A stratum with too few equations contributes
    all of them. Equations of unocculted pixels follow. Raises DataError "no-lines" if there is no equation of an
    occulted pixel.
    """
    strata = np.unique(equations.stratum[equations.stratum != UNOCCULTED])
    if strata.size == 0:
        raise DataError(
            "no-lines",
            "expected occulted pixels in the images; got none; check the positions of the discs in transit.json",
        )
    share = -(-OCCULTED_EQUATIONS // strata.size)
    numbers = [(stratum, share) for stratum in strata] + [(UNOCCULTED, UNOCCULTED_EQUATIONS)]
    parts = []
    for stratum, number in numbers:
        members = np.flatnonzero(equations.stratum == stratum)
        parts.append(members if members.size <= number else rng.choice(members, number, replace=False))
    return np.concatenate(parts)


def free_fit(
    equations: Equations, counts: Vector, *, seed: int, subsets: int = SUBSETS, towards: Vector | None = None
) -> SubsetFits:
    """The free fit of Eq. (2): coefficients, (subsets kept, segments), as fractions of the light per pixel.

    The paper has no prior. A prior is needed because no occulted pixel is close enough to the edge of the disc to
    separate the innermost shells from the centre. Without a prior, the fit assigns these shells more light than there
    is (a fraction of 1.3 in the first round on simulated transits).

    Parameters
    ----------
    towards
        The coefficients that the prior favours; shells that no equation constrains keep these coefficients. The prior
        is weak: if a shell doubles or vanishes, the misfit grows as much as if one equation were wrong by its scale.
        Default: the prior favours zero for all shells, with PRIOR_WEIGHT.
    """
    prior_at = np.zeros_like(counts) if towards is None else towards
    prior_weight = np.full_like(counts, PRIOR_WEIGHT)
    if towards is not None:
        prior_weight = 1 / np.maximum(towards * counts, LEAST_LIGHT)

    def solve(matrix: Matrix, target: Vector) -> tuple[Vector, float]:
        """Solve Eq. (2) for the light n_S psf_S of each shell."""
        used = (counts > 0) & (np.linalg.norm(matrix, axis=0) > 0)
        coefficients = prior_at.copy()
        target = target - matrix[:, ~used] @ prior_at[~used]
        light = matrix[:, used] / counts[used]
        extended = np.concatenate((light, np.diag(prior_weight[used])))
        extended_target = np.concatenate((target, (prior_weight * prior_at * counts)[used]))
        # The triangular factor of a QR factorisation gives the same least-squares solution from a twentieth of the
        # rows.
        turned, triangle = np.linalg.qr(extended)
        solved = lsq_linear(triangle, turned.T @ extended_target, bounds=(0.0, np.inf), method="trf")
        coefficients[used] = solved.x / counts[used]
        return coefficients, float(np.sum((light @ solved.x - target) ** 2))

    return _fit_subsets(equations, counts, seed, subsets, solve)


def power_law_fit(
    equations: Equations, segments: Segments, start: Vector, *, seed: int, subsets: int = SUBSETS
) -> SubsetFits:
    """The fit of Eq. (3): a, b (px) and c.

    Parameters
    ----------
    start
        The values of a, b and c at which the fit starts.
    """
    mean = _segment_mean(segments)
    a, b, c = start
    pivot_start = np.array([np.log(a) - c * np.log(b + PIVOT_PX), np.log(b), c])

    def solve(matrix: Matrix, target: Vector) -> tuple[Vector, float]:
        # a, b and c are strongly correlated. The fit uses the weight at PIVOT_PX instead of a, because the data
        # determine this weight well.
        def misfit(theta: Vector) -> Vector:
            return np.asarray(matrix @ mean(theta) - target)

        solved = least_squares(
            misfit,
            pivot_start,
            method="trf",
            bounds=([-np.inf, np.log(0.05), 0.5], [np.inf, np.log(500.0), 8.0]),
            x_scale=[0.1, 0.3, 0.1],
        )
        return solved.x, float(2 * solved.cost)

    def law(theta: Vector) -> Vector:
        b = np.exp(theta[1])
        return np.array([np.exp(theta[0] + theta[2] * np.log(b + PIVOT_PX)), b, theta[2]])

    fitted = _fit_subsets(equations, segments.counts.astype(np.float64), seed, subsets, solve)
    return SubsetFits(np.array([law(fit) for fit in fitted.fits]), law(fitted.mean))


def _segment_mean(segments: Segments) -> Callable[[Vector], Vector]:
    """Eq. (3) averaged over the pixels of each segment, as a function of (ln weight at PIVOT_PX, ln b, c).

    A segment whose pixels have more than MOST_RINGS distances is divided into as many rings, each with its mean
    distance.
    """
    distance, count = pixel_radii(segments.reach_grid_px)
    shell = np.searchsorted(segments.edges_px, distance, side="right") - 1
    radii, shares = [], []
    for k in range(segments.size):
        here = shell == k
        r, n = distance[here], count[here]
        if r.size > MOST_RINGS:
            ring = np.linspace(0, MOST_RINGS, r.size, endpoint=False).astype(int)
            total = np.bincount(ring, weights=n)
            r, n = np.bincount(ring, weights=n * r) / total, total
        if not r.size:  # a shell without pixels has a mean of 0
            r, n = np.array([segments.edges_px[k]]), np.zeros(1)
        radii.append(r)
        shares.append(n / max(float(n.sum()), 1.0))
    first = np.cumsum([0, *(r.size for r in radii[:-1])])
    radius, share = np.concatenate(radii), np.concatenate(shares)

    def mean(theta: Vector) -> Vector:
        b = np.exp(theta[1])
        weight = np.exp(theta[0] - theta[2] * np.log((b + radius) / (b + PIVOT_PX)))
        return np.asarray(np.add.reduceat(weight * share, first))

    return mean


def _fit_subsets(equations: Equations, counts: Vector, seed: int, subsets: int, solve: Solve) -> SubsetFits:
    """Fit many random subsets, and keep the best 70 %, as the paper does."""
    matrix = (equations.ring_sums - equations.unscattered[:, None] * counts) / equations.scale[:, None]
    target = (equations.observed - equations.unscattered) / equations.scale
    rng = np.random.default_rng(seed)
    fits, cost = [], []
    # These factorisations are so small that threads make them slower, above all when the cores are busy.
    with threadpool_limits(limits=1, user_api="blas"):
        for _ in range(subsets):
            chosen = choose_subset(equations, rng)
            fit, misfit = solve(matrix[chosen], target[chosen])
            fits.append(fit)
            cost.append(misfit / chosen.size)
    best = np.argsort(cost, kind="stable")[: max(1, subsets * KEPT_SUBSETS // SUBSETS)]
    kept = np.array(fits)[best]
    return SubsetFits(kept, kept.mean(axis=0))


# --- the rounds -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Published:
    """The result of the published recipe.

    Attributes
    ----------
    a, b_px, c
        The power law of the last round.
    spread
        Standard deviations of a, b_px and c over the subsets; None if fewer than two subsets were kept.
    total
        The fraction of scattered light, summed over a square grid of grid_px pixels.
    rounds
        For each round, "free shells" or "softened power law", and 1 - encircled energy (in percent) at radii_px of the
        total PSF, which is the scatter kernel convolved with the diffraction PSF.
    equations
        The number of equations in the last round.
    """

    a: float
    b_px: float
    c: float
    spread: dict[str, float] | None
    total: float
    grid_px: int
    radii_px: Vector
    rounds: tuple[tuple[str, Vector], ...]
    equations: int

    @property
    def curve_pct(self) -> Vector:
        """1 - encircled energy of the final total PSF at radii_px, percent."""
        return self.rounds[-1][1]

    @property
    def scatter(self) -> Kernel:
        """The scatter kernel [y, x] on (grid_px, grid_px)."""
        return _power_law_kernel(np.array([self.a, self.b_px, self.c]), self.grid_px)


def invert_as_published(
    transit: Transit,
    choices: Choices = AS_PUBLISHED,
    *,
    seed: int = 1,
    subsets: int = SUBSETS,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> Published:
    """Run steps (a) to (j).

    Raises DataError "no-lines" if no pixel is occulted. Raises DataError "no-scatter" if the fit is not physical: it
    scatters more than all light, or the maximum of its PSF is not at the centre.
    """
    return _Recipe(transit, choices, seed, threads, progress).run(subsets)


class _Recipe:
    def __init__(
        self, transit: Transit, choices: Choices, seed: int, threads: int, progress: Progress
    ) -> None:
        self.transit, self.choices, self.seed = transit, choices, seed
        self.threads, self.progress = threads, progress
        # The paper counts scatter "out to the edge of the PSF". Here this is the edge of the array of the diffraction
        # PSF. In the paper, this array is as large as the images.
        self.grid = (
            min(transit.diffraction.shape[0], REACH_GRID_PX) if choices.counted_on_array else REACH_GRID_PX
        )
        reach = float(np.hypot(self.grid // 2, self.grid // 2)) + 1.0
        self.segments = Segments(shells_as_published(reach), reach_grid_px=self.grid)
        self.psf_size = min(2 * max(transit.shape), REACH_GRID_PX)
        self.to_total = Convolver(
            transit.diffraction, (self.psf_size, self.psf_size), dtype=np.float64, threads=threads
        )
        self.diffract = Engine(transit.diffraction, transit.shape, threads=threads)
        self.radii = np.array([r for r in CURVE_RADII_PX if r < self.psf_size // 2])

    def run(self, subsets: int) -> Published:
        kernel = crop_or_pad(self.transit.diffraction, self.psf_size)
        rounds = []
        law, middle = np.array([0.15, 6.0, 2.5]), self.grid // 2
        for n in range(FREE_ROUNDS + POWER_LAW_ROUNDS):
            equations, seed = self._equations(kernel, n), self.seed * 100 + n
            if n < FREE_ROUNDS:
                counts = self.segments.counts.astype(np.float64)
                name, fitted = "free shells", free_fit(equations, counts, seed=seed, subsets=subsets)
                scatter = self._free_kernel(fitted.mean)
            else:
                fitted = power_law_fit(equations, self.segments, law, seed=seed, subsets=subsets)
                name, law = "softened power law", fitted.mean
                scatter = _power_law_kernel(law, self.grid)
            centre = float(scatter[middle, middle])
            if not centre > 0:
                raise DataError(
                    "no-scatter",
                    f"round {n + 1}, {name}: expected scatter of less than 100 % of the light; got "
                    f"{100 * (1 - centre):.3g} %: fit without the published recipe (--as-published)",
                )
            kernel = np.maximum(self.to_total.apply(crop_or_pad(scatter, self.psf_size)), 0.0)
            _check_brightest_at_centre(kernel, f"round {n + 1}: {name}")
            rounds.append((name, cumulative_curve(kernel, self.radii)))
        spread = None
        if len(fitted.fits) > 1:
            spread = dict(zip(("a", "b_px", "c"), fitted.fits.std(axis=0, ddof=1).tolist(), strict=True))
        a, b_px, c = law.tolist()
        return Published(
            a=a,
            b_px=b_px,
            c=c,
            spread=spread,
            total=1 - centre,
            grid_px=self.grid,
            radii_px=self.radii,
            rounds=tuple(rounds),
            equations=len(equations),
        )

    def _equations(self, kernel: Kernel, n: int) -> Equations:
        """The equations of all images, from steps (d) to (h)."""
        frames = self.transit.frames
        scenes = self._deconvolved(kernel, n)
        places = [frame.place for frame in frames]
        rng = np.random.default_rng([self.seed, n])
        parts = []
        for k, frame in enumerate(frames):
            self.progress(f"round {n + 1}: equations", k, len(frames))
            found = find_occulter(
                k, frames, scenes.__getitem__, places, kernel, self.transit.noise
            )  # step (e)
            parts.append(self._equations_of_frame(frame, scenes[k], found, rng))
        return Equations.joined(parts)

    def _deconvolved(self, kernel: Kernel, n: int) -> list[NDArray[np.float32]]:
        """Step (d): the scenes of all images, deconvolved with Richardson-Lucy."""
        psf = Psf(kernel, name="round", version=str(n), instrument=None, status="draft")
        conditions = Conditions(
            edges="zero", margin_px=0, threads=self.threads, engine_for=PreparedPsfs().engine_for
        )
        scenes = []
        for k, frame in enumerate(self.transit.frames):
            self.progress(f"round {n + 1}: deconvolving", k, len(self.transit.frames))
            image = Image(
                pixels=frame.pixels.astype(np.float64),
                mask=np.zeros(frame.pixels.shape, np.uint8),
                header=Header(),
                unit="DN/s",
                exposure_s=frame.exposure_s,
            )
            scene = method_named("richardson-lucy")(image, psf, conditions, steps=LUCY_STEPS).pixels
            scenes.append(scene.astype(np.float32))
        return scenes

    def _equations_of_frame(
        self, frame: Frame, scene: NDArray[np.float32], found: FoundPlace, rng: np.random.Generator
    ) -> Equations:
        """The equations of one image, from steps (f) to (h); none if no pixel of the image is occulted."""
        shape, place = self.transit.shape, found.place
        distance = disc_distance(shape, place)
        within = distance <= place.radius_px
        blanked = within if self.choices.whole_disc_blanked else fully_dark(shape, place)
        true = np.where(blanked, np.float32(0), scene)  # step (f)
        occulted = distance <= place.radius_px - SHRUNK_PX
        if frame.filled is not None:
            occulted &= ~frame.filled
        dark = np.flatnonzero(occulted)
        outside = np.flatnonzero(~within & (distance <= place.radius_px + UNOCCULTED_WITHIN_PX))
        outside = outside[:0] if dark.size == 0 else outside
        outside = rng.choice(outside, min(UNOCCULTED_A_FRAME, outside.size), replace=False)
        pixels = np.concatenate((dark, outside))
        stratum = np.floor(place.radius_px - SHRUNK_PX - distance.flat[dark]).astype(np.int64)  # step (g)
        stratum = np.concatenate((np.maximum(stratum, 0), np.full(outside.size, UNOCCULTED)))
        observed = frame.pixels.flat[pixels].astype(np.float64)
        diffracted = self.diffract.apply(true)
        summed = true if self.choices.added else diffracted
        targets = np.stack(np.unravel_index(pixels, shape), axis=1)
        return Equations(
            observed=observed,
            ring_sums=segment_sums(summed, targets, self.segments, threads=self.threads),
            unscattered=diffracted.flat[pixels].astype(np.float64),
            scale=self._scale(frame, observed, stratum),
            stratum=stratum,
        )  # step (h)

    def _scale(self, frame: Frame, observed: Vector, stratum: NDArray[np.int64]) -> Vector:
        """The number by which each equation is divided."""
        level = np.empty_like(observed)
        for here in (stratum == UNOCCULTED, stratum != UNOCCULTED):
            level[here] = max(float(observed[here].mean()), LEAST_LEVEL_DN_S) if here.any() else 1.0
        if self.choices.weighed_by_observed:
            return np.maximum(observed, LEAST_OF_MEAN * level)
        return np.sqrt(self.transit.noise.variance(level, frame.exposure_s))

    def _free_kernel(self, coefficients: Vector) -> Kernel:
        label = self.segments.label_map(self.grid)
        kernel = np.where(label >= 0, coefficients[np.maximum(label, 0)], 0.0)
        kernel[self.grid // 2, self.grid // 2] = 1 - kernel.sum()
        return np.asarray(kernel)


def _check_brightest_at_centre(kernel: Kernel, label: str) -> None:
    """Raise DataError "no-scatter" if the central pixel is not the maximum; such a PSF is not physical."""
    middle = (kernel.shape[0] // 2, kernel.shape[1] // 2)
    if kernel[middle] < kernel.max() * (1 - CENTRE_TOLERANCE):
        y, x = np.unravel_index(int(kernel.argmax()), kernel.shape)
        distance = np.hypot(y - middle[0], x - middle[1])
        raise DataError(
            "no-scatter",
            f"{label}: expected a PSF with its maximum at the centre; got {kernel[middle]:.3g} of the light there "
            f"and {kernel.max():.3g} in a pixel at a distance of {distance:.3g} px: fit without the published recipe "
            "(--as-published)",
        )


def _power_law_kernel(law: Vector, size: int) -> Kernel:
    a, b, c = law
    kernel = a * (b + np.sqrt(squared_radii((size, size)))) ** -c
    kernel[size // 2, size // 2] = 0.0
    kernel[size // 2, size // 2] = 1 - kernel.sum()
    return np.asarray(kernel)
