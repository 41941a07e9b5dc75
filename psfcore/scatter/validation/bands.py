"""Medians and error bands from the fits of a cross-validation, and the excess of the free fit over the formula.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "Results". The module
`psfcore.scatter.validation.cross_validation` defines the excess (Eq. (2)) and its error. Each fit belongs to one
bootstrap sample. A band extends from a low to a high percentile of a quantity over the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from psfcore.scatter.shapes import Vector
from psfcore.scatter.validation.cross_validation import FoldFit, FoldShells
from psfcore.scatter.validation.free_shells import shells

# The percentiles of a Gaussian at one and two standard deviations below and above its mean.
ONE_SIGMA: tuple[float, float] = (100 * float(ndtr(-1)), 100 * float(ndtr(1)))
TWO_SIGMA: tuple[float, float] = (100 * float(ndtr(-2)), 100 * float(ndtr(2)))
LIMITS = (TWO_SIGMA[0], ONE_SIGMA[0], 50.0, ONE_SIGMA[1], TWO_SIGMA[1])
LIMIT_NAMES = ("minus_2_sigma", "minus_1_sigma", "median", "plus_1_sigma", "plus_2_sigma")
# Within this distance, the free fit of the paper differs from the power law of the paper.
NEAR_CENTRE_PX = 3.0
PARTING_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class ShellBands:
    """The free fits and the formulas of all samples, shell by shell.

    Arrays (5, shells) contain percentiles over the samples, at -2, -1, 0, +1 and +2 sigma. "law" stands for the formula.
    edges_px: edges of the shells, (shells + 1,). free_weight, law_weight: weight per pixel of each shell, (5, shells).
    free_beyond_pct, law_beyond_pct: percentage of the light that is scattered beyond the inner edge of each shell,
    (5, shells). excess_pct: excess of Eq. (2) within the outer edge of each shell, in percentage points of all light,
    (5, shells). excess_sigma: error of the excess, (shells,). law_within_pct: median of the formula's light within the
    outer edge of each shell, (shells,).
    """

    edges_px: Vector
    free_weight: NDArray[np.float64]
    law_weight: NDArray[np.float64]
    free_beyond_pct: NDArray[np.float64]
    law_beyond_pct: NDArray[np.float64]
    excess_pct: NDArray[np.float64]
    excess_sigma: Vector
    law_within_pct: Vector

    def excess(self, shell: int) -> Excess:
        """The excess within the outer edge of a shell."""
        return Excess(
            within_px=float(self.edges_px[shell + 1]),
            points=float(self.excess_pct[2, shell]),
            sigma=float(self.excess_sigma[shell]),
            of_formula_pct=100 * float(self.excess_pct[2, shell] / self.law_within_pct[shell]),
        )

    @property
    def near_centre(self) -> Excess:
        """The excess within NEAR_CENTRE_PX.

        This excess includes all shells that contain only pixels up to this distance.
        """
        beyond = np.sqrt(NEAR_CENTRE_PX**2 + 1)
        return self.excess(int(np.flatnonzero(self.edges_px[1:] < beyond)[-1]))

    @property
    def largest(self) -> Excess:
        """The excess with the largest ratio of its absolute value to its error."""
        return self.excess(int(np.argmax(np.abs(self.excess_pct[2] / self.excess_sigma))))

    def to_json(self) -> dict[str, Any]:
        """Plain values."""

        def named(limits: NDArray[np.float64]) -> dict[str, list[float]]:
            return dict(zip(LIMIT_NAMES, limits.tolist(), strict=True))

        return {
            "edges_px": self.edges_px.tolist(),
            "weight": {"free": named(self.free_weight), "formula": named(self.law_weight)},
            "diffuse_light_beyond_inner_edge_pct": {
                "free": named(self.free_beyond_pct),
                "formula": named(self.law_beyond_pct),
            },
            "excess_within_outer_edge_points": named(self.excess_pct) | {"sigma": self.excess_sigma.tolist()},
            "excess_near_centre": vars(self.near_centre),
            "largest_excess": vars(self.largest) | {"parts": self.largest.parts},
        }


@dataclass(frozen=True)
class Excess:
    """The light of the free fit within a distance minus the light of the formula within the same distance.

    points: the difference in percent of all light. sigma: error of `points`. of_formula_pct: the same difference in
    percent of the light that the formula puts within the distance.
    """

    within_px: float
    points: float
    sigma: float
    of_formula_pct: float

    @property
    def parts(self) -> bool:
        """Whether the free fit and the formula differ by more than PARTING_SIGMAS standard errors."""
        return abs(self.points) > PARTING_SIGMAS * self.sigma


@dataclass(frozen=True, eq=False)
class Bands:
    """Medians and bands of all samples: percentiles at -2, -1, 0, +1 and +2 sigma.

    curve_pct: percentiles of C(R) at radii_px, (5, radii). values: percentiles of each parameter, (5,). totals: the total
    of scatter of each fit. held_out_pct: mean residual of each held-out image, percent. shells: percentiles by shell;
    None if the formula is not isotropic.
    """

    radii_px: Vector
    curve_pct: NDArray[np.float64]
    values: dict[str, Vector]
    totals: Vector
    held_out_pct: dict[int, float]
    shells: ShellBands | None

    @property
    def held_out(self) -> dict[str, float]:
        """Mean, rms and largest absolute value of the held-out residuals, in percent.

        Each image counts once, with its mean residual over the samples.
        """
        found = np.array(list(self.held_out_pct.values()))
        if found.size == 0:
            return {}
        return {
            "mean_pct": float(found.mean()),
            "rms_pct": float(np.sqrt((found**2).mean())),
            "largest_pct": float(np.abs(found).max()),
        }

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "radii_px": self.radii_px.tolist(),
            "light_beyond_pct": dict(zip(LIMIT_NAMES, self.curve_pct.tolist(), strict=True)),
            "parameters": {
                name: dict(zip(LIMIT_NAMES, limits.tolist(), strict=True))
                for name, limits in self.values.items()
            },
            "shells": None if self.shells is None else self.shells.to_json(),
            "totals": self.totals.tolist(),
            "held_out": self.held_out,
            "held_out_pct": {str(image): value for image, value in self.held_out_pct.items()},
        }


def bands(fits: tuple[FoldFit, ...], radii_px: Vector) -> Bands:
    """Medians and percentiles over the samples. radii_px: the radii at which the fits' curves C(R) are given."""
    held_out: dict[int, list[float]] = {}
    for fit in fits:
        for image, residual in fit.held_out_pct.items():
            held_out.setdefault(image, []).append(residual)
    with_shells = [fit.shells for fit in fits if fit.shells is not None]
    return Bands(
        radii_px=radii_px,
        curve_pct=np.percentile([fit.curve_pct for fit in fits], LIMITS, axis=0),
        values={name: np.percentile([fit.values[name] for fit in fits], LIMITS) for name in fits[0].values},
        totals=np.array([fit.values["total"] for fit in fits]),
        held_out_pct={image: float(np.mean(found)) for image, found in sorted(held_out.items())},
        shells=shell_bands(with_shells) if len(with_shells) == len(fits) else None,
    )


def shell_bands(folds: Sequence[FoldShells]) -> ShellBands:
    """Medians and percentiles over the samples, for each shell."""
    free, law = np.array([fold.free for fold in folds]), np.array([fold.law for fold in folds])
    counts = shells().counts
    excess = 100 * np.cumsum(free - law, axis=1)  # Eq. (2)
    spread = np.subtract(*np.percentile(excess, ONE_SIGMA[::-1], axis=0)) / 2
    expected = 100 * np.median([fold.excess_sigma for fold in folds], axis=0)

    def beyond_pct(light: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.percentile(100 * np.cumsum(light[:, ::-1], axis=1)[:, ::-1], LIMITS, axis=0))

    return ShellBands(
        edges_px=np.array(shells().edges_px),
        free_weight=np.percentile(free / counts, LIMITS, axis=0),
        law_weight=np.percentile(law / counts, LIMITS, axis=0),
        free_beyond_pct=beyond_pct(free),
        law_beyond_pct=beyond_pct(law),
        excess_pct=np.percentile(excess, LIMITS, axis=0),
        excess_sigma=np.maximum(spread, expected),
        law_within_pct=100 * np.median(np.cumsum(law, axis=1), axis=0),
    )
