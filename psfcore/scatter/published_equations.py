"""The system of equations of the published inversion, and the fits to it: steps (g) to (i) of the paper.

Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm":

    I_o = sum over S of psf_S A_S + (1 - sum over S of n_S psf_S) B      Eq. (1)

Each selected pixel gives one equation; I_o is the observed intensity of this pixel. Every equation is divided by its scale
(see `Equations`). The coefficients psf_S are fitted to 100 random subsets of the equations. A subset contains 1000
equations of occulted pixels and 100 equations of unocculted pixels near the edge of the disc. Each shell of the mask that
selects the occulted pixels contributes the same number of equations. No equation occurs twice in a subset, so a subset
is not a bootstrap sample. The 30 fits with the largest misfit are dropped, and the other 70 are averaged.

    free fit        psf_S >= 0, by the Trust Region Reflective algorithm              Eq. (2)
    power law       psf_S = mean of a / (b + r)^c over S, by the same algorithm       Eq. (3)

| symbol | name | unit |
|---|---|---|
| S | segment of the PSF: a shell around the centre | - |
| A_S | ring_sums: sum of the scene over the segment S around the pixel | DN/s px^2 |
| B | unscattered: the scene convolved with the diffraction PSF, at the pixel | DN/s |
| n_S | counts: number of pixels in S | px^2 |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear
from threadpoolctl import threadpool_limits

from psfcore.errors import DataError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Solve = Callable[[Matrix, Vector], tuple[Vector, float]]

SUBSETS = 100
KEPT_SUBSETS = 70
OCCULTED_EQUATIONS = 1000
UNOCCULTED_EQUATIONS = 100
UNOCCULTED = -1
LEAST_LIGHT = 1e-5
# With this weight, a shell that contains all light has as much misfit as one equation that is wrong by 10 times its scale.
PRIOR_WEIGHT = 10.0
PIVOT_PX = 15.0


@dataclass(frozen=True, eq=False)
class Equations:
    """Eq. (1) for n pixels: observed, unscattered and scale have shape (n,); ring_sums has shape (n, segments).

    stratum: for an occulted pixel, the shell of the selection mask that contains it (0: outermost); for other pixels,
    UNOCCULTED. scale: the number by which the equation is divided.
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
        return Equations(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("observed", "ring_sums", "unscattered", "scale", "stratum")
            )
        )


@dataclass(frozen=True, eq=False)
class SubsetFits:
    """Fits to subsets of equations; the worst fits are dropped.

    fits: coefficients, (subsets kept, n): of the segments, or a, b (px) and c. cost: sum of the squared misfits divided
    by the number of equations. mean: mean coefficients over the kept subsets. For the power law, the mean is computed in
    coordinates with nearly Gaussian errors, because a varies by powers of ten between subsets.
    """

    fits: Matrix
    cost: Vector
    mean: Vector


def choose_subset(equations: Equations, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of one random subset of the equations; no equation occurs twice.

    All strata of occulted pixels contribute the same number of equations. A stratum with too few equations contributes
    all of them. Equations of unocculted pixels follow. Raises DataError "no-lines" if there is no equation of an occulted
    pixel.
    """
    strata = np.unique(equations.stratum[equations.stratum != UNOCCULTED])
    if strata.size == 0:
        raise DataError(
            "no-lines", "expected equations of occulted pixels; got none; check the position of the occulter"
        )
    share = -(-OCCULTED_EQUATIONS // strata.size)
    chosen = [_some(np.flatnonzero(equations.stratum == stratum), share, rng) for stratum in strata]
    unocculted = np.flatnonzero(equations.stratum == UNOCCULTED)
    return np.concatenate([*chosen, _some(unocculted, UNOCCULTED_EQUATIONS, rng)])


def _some(of: NDArray[np.intp], number: int, rng: np.random.Generator) -> NDArray[np.intp]:
    return of if of.size <= number else rng.choice(of, number, replace=False)


def free_fit(
    equations: Equations, counts: Vector, *, seed: int, subsets: int = SUBSETS, towards: Vector | None = None
) -> SubsetFits:
    """The free fit of Eq. (2): coefficients, (subsets kept, segments), as fractions of the light per pixel.

    towards: the coefficients that the prior favours; shells that no equation constrains keep these coefficients. The
    prior is weak: if a shell doubles or vanishes, the misfit grows as much as if one equation were wrong by its scale.
    Default: the prior favours zero for all shells, with PRIOR_WEIGHT.
    """
    prior_at = np.zeros_like(counts) if towards is None else towards
    light = prior_at * counts
    prior_weight = (
        np.full_like(counts, PRIOR_WEIGHT) if towards is None else 1 / np.maximum(light, LEAST_LIGHT)
    )

    def solve(matrix: Matrix, target: Vector) -> tuple[Vector, float]:
        return _solve_free(matrix, target, counts, prior_at, prior_weight)

    return _fit_subsets(equations, counts, seed, subsets, solve)


def power_law_fit(
    equations: Equations,
    counts: Vector,
    radii: Sequence[tuple[Vector, Vector]],
    start: Vector,
    *,
    seed: int,
    subsets: int = SUBSETS,
) -> SubsetFits:
    """The fit of Eq. (3): a, b (px) and c.

    radii: for each segment, the distances of its pixels (px) and the number of pixels at each distance. start: the values
    of a, b and c at which the fit starts.
    """
    mean = SegmentMean(radii)
    a, b, c = start
    pivot_start = np.array([np.log(a) - c * np.log(b + PIVOT_PX), np.log(b), c])

    def solve(matrix: Matrix, target: Vector) -> tuple[Vector, float]:
        def misfit(theta: Vector) -> Vector:
            return np.asarray(matrix @ mean(theta) - target)

        # a, b and c are strongly correlated. The fit uses the weight at PIVOT_PX instead of a, because the data
        # determine this weight well.
        solved = least_squares(
            misfit,
            pivot_start,
            method="trf",
            bounds=([-np.inf, np.log(0.05), 0.5], [np.inf, np.log(500.0), 8.0]),
            x_scale=[0.1, 0.3, 0.1],
        )
        return solved.x, float(2 * solved.cost)

    fitted = _fit_subsets(equations, counts, seed, subsets, solve)
    law = np.array([_from_pivot(fit) for fit in fitted.fits])
    return SubsetFits(law, fitted.cost, _from_pivot(fitted.mean))


class SegmentMean:
    """Eq. (3) averaged over the pixels of each segment, as a function of (ln weight at PIVOT_PX, ln b, c)."""

    def __init__(self, radii: Sequence[tuple[Vector, Vector]]) -> None:
        self._radius = np.concatenate([r for r, _ in radii])
        counts = np.array([n.sum() for _, n in radii])
        share = [n / max(float(n.sum()), 1.0) for _, n in radii]
        self._share = np.concatenate(share)
        self._start = np.concatenate(([0], np.cumsum([r.size for r, _ in radii])[:-1])).astype(np.intp)
        self._empty = counts == 0

    def __call__(self, theta: Vector) -> Vector:
        weight = np.exp(
            theta[0] - theta[2] * np.log((np.exp(theta[1]) + self._radius) / (np.exp(theta[1]) + PIVOT_PX))
        )
        mean = np.add.reduceat(weight * self._share, np.minimum(self._start, self._share.size - 1))
        return np.where(self._empty, 0.0, mean)


def _from_pivot(theta: Vector) -> Vector:
    b = np.exp(theta[1])
    return np.array([np.exp(theta[0] + theta[2] * np.log(b + PIVOT_PX)), b, theta[2]])


def _solve_free(
    matrix: Matrix, target: Vector, counts: Vector, towards: Vector, prior_weight: Vector
) -> tuple[Vector, float]:
    """Solve Eq. (2) for the light n_S psf_S of each shell, with a prior for shells that no equation constrains.

    The paper has no prior. A prior is needed because no occulted pixel is close enough to the edge of the disc to
    separate the innermost shells from the centre. Without a prior, the fit assigns these shells more light than there
    is (a fraction of 1.3 in the first round on simulated transits).
    """
    used = (counts > 0) & (np.linalg.norm(matrix, axis=0) > 0)
    out = towards.copy()
    target = target - matrix[:, ~used] @ towards[~used]
    light = matrix[:, used] / counts[used]
    extended = np.concatenate((light, np.diag(prior_weight[used])))
    extended_target = np.concatenate((target, (prior_weight * towards * counts)[used]))
    # The triangular factor of a QR factorisation gives the same least-squares solution from a twentieth of the rows.
    turned, triangle = np.linalg.qr(extended)
    solved = lsq_linear(triangle, turned.T @ extended_target, bounds=(0.0, np.inf), method="trf")
    out[used] = solved.x / counts[used]
    return out, float(np.sum((light @ solved.x - target) ** 2))


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
    return SubsetFits(kept, np.array(cost)[best], kept.mean(axis=0))
