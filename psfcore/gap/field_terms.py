"""The terms of a PSF whose scatter changes over the field, from the effect `field_dependent_scatter` of a full refit.

The effect changes the total scatter t by the share theta_x X + theta_y Y + theta_o (X^2 + Y^2), where X and Y run from
-1/2 to 1/2 across the images. The total PSF H is linear in t, so the terms of `psfcore.psf_field` are exact:

    K_u = theta_x s_x T,   K_v = theta_y s_y T,   K_uu = theta_o s_x^2 T,   K_vv = theta_o s_y^2 T        Eq. (1)
    T = t dH/dt,   X = s_x u,   s_x = (nx - 1) / (2 nx)                                                   Eq. (2)

How far the terms shrink the gap is measured on held-out images: for each block of time, the PSF is fitted to the other
images, once with terms and once without. With this PSF the images of the block are deconvolved, their discs set to 0,
and convolved again (`psfcore.evaluation`).

| symbol | name | unit |
|---|---|---|
| t | total scatter | - |
| theta | parameters of the effect | 1/field, 1/field^2 |
| T | `_amount_slope` | - |
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from psfcore.arrays import Kernel, Matrix, Vector
from psfcore.evaluation.evaluation import Evaluation, evaluate
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.library.optics import AMOUNT, FIELD_DEPENDENT
from psfcore.gap.verdict.closure import Interval, gap, time_blocks
from psfcore.gap.verdict.correction import Corrected
from psfcore.psf import REACH_GRID_PX, Psf
from psfcore.psf_field import FieldTerm, Place
from psfcore.psf_places import raise_to_zero
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.transit import Transit

_POWERS = ((1, 0), (0, 1), (2, 0), (0, 2))
# The images determine a change along a direction if its error is smaller: the likely size of a change.
_DETERMINED = 0.1


@dataclass(frozen=True, eq=False)
class HeldOutGaps:
    """The gap in held-out images with one kernel, and with terms; and the number of these images."""

    without_terms: Interval
    with_terms: Interval
    images: int

    def __str__(self) -> str:
        return (
            f"gap in {self.images} held-out images, deconvolved with the PSF of the others: "
            f"{self.without_terms.value:.2f} % with one kernel, {self.with_terms.value:.2f} % with terms"
            + ("" if self.with_terms.value < self.without_terms.value else ": these terms do not shrink it")
        )

    def to_json(self) -> dict[str, object]:
        """The gaps (percent) as JSON values."""
        return {
            "sentence": str(self),
            "images": self.images,
            "without_terms_pct": self.without_terms.to_json(),
            "with_terms_pct": self.with_terms.to_json(),
        }


def with_terms(psf: Psf, corrected: Corrected) -> Psf:
    """The PSF of a full refit, with the terms of Eq. (1); `psf` itself if the refit has none."""
    theta = _theta(corrected, _values(corrected))
    if not any(theta.values()):
        return psf
    solution = corrected.solution
    total = TotalPsf(
        solution.transit.diffraction,
        solution.inversion.shape,
        (REACH_GRID_PX, REACH_GRID_PX),
        threads=solution.threads,
    )
    return _changing(psf, total, solution.inversion.coordinates, theta, solution.transit)


def _values(corrected: Corrected) -> Vector:
    return np.array([value for value, _, _ in corrected.values.values()])


def _theta(corrected: Corrected, values: Vector) -> dict[str, float]:
    """The parameters x, y and outwards of the effect, from the values of all parameters of a refit; none if the refit
    is without the effect.
    """
    if all(effect.name != FIELD_DEPENDENT for effect in corrected.effects):
        return {}
    rows = zip(corrected.values.items(), values.tolist(), strict=True)
    moved = replace(corrected, values={label: (value, *rest) for (label, (_, *rest)), value in rows})
    return {name: value for name, (value, _) in moved.parameters(FIELD_DEPENDENT).items()}


def _amount_slope(total: TotalPsf, at: Vector) -> Kernel:
    """T of Eq. (2); the coordinate of the total scatter is its logit."""
    return total.slope(at, AMOUNT) / (1 - total.shape.values(at)["total"])


def _changing(psf: Psf, total: TotalPsf, at: Vector, theta: Mapping[str, float], transit: Transit) -> Psf:
    """The PSF with the terms of Eq. (1). Their weights are made smaller where the PSF would fall below 0."""
    ny, nx = transit.shape
    x, y = (nx - 1) / (2 * nx), (ny - 1) / (2 * ny)
    outwards = theta.get("outwards", 0.0)
    factors = (theta.get("x", 0.0) * x, theta.get("y", 0.0) * y, outwards * x**2, outwards * y**2)
    acting = [(powers, factor) for powers, factor in zip(_POWERS, factors, strict=True) if factor]
    slope = _amount_slope(total, at)
    planes = np.array([psf.kernel, *(factor * slope for _, factor in acting)])
    raise_to_zero(planes, [powers for powers, _ in acting])
    terms = tuple(FieldTerm(plane, a, b) for plane, ((a, b), _) in zip(planes[1:], acting, strict=True))
    return replace(psf, kernel=planes[0], field_terms=terms, place=Place.of_detector(nx, ny))


def held_out_gaps(
    solution: Solution,
    model: LinearModel,
    corrected: Corrected,
    *,
    seed: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> HeldOutGaps | None:
    """The gap in held-out images, with the images deconvolved; None if there are too few images to hold some out.

    Parameters
    ----------
    solution, model
        The fit without the effect, and its linear model.
    corrected
        The full refit with the effect.
    """
    transit, total, threads = solution.transit, solution.total, solution.threads
    base = len(model.evidence.base)
    every = range(base, corrected.model.evidence.size)
    # The refit is linear around the parameters that were subtracted from its images.
    around = _values(corrected) - corrected.model.fit(tuple(every)).values[base:]
    plain: dict[int, Kernel] = {}
    changing: dict[int, Psf] = {}
    for fold in time_blocks(model):
        fitted = [n for n in fold.fitted if n in model.evidence.images]
        if len(fitted) <= corrected.model.evidence.size:
            continue
        step = model.fit((), model.equations(fitted)).values
        kernel = np.maximum(total.kernel(solution.inversion.coordinates + step), 0.0)
        both = corrected.model.fit(tuple(every), corrected.model.equations(fitted)).values
        at = corrected.solution.inversion.coordinates + both[:base]
        psf = Psf(np.maximum(total.kernel(at), 0.0), "held out", "0", None, "user")
        psf = _changing(psf, total, at, _theta(corrected, around + both[base:]), transit)
        plain |= dict.fromkeys(fold.held_out, kernel)
        changing |= dict.fromkeys(fold.held_out, psf)
    if not plain or len(plain) < len(transit.frames):
        return None
    found = [
        evaluate(transit, of, noise_realisations=0, seed=seed, threads=threads, progress=progress)
        for of in (plain.__getitem__, changing.__getitem__)
    ]
    common = set.intersection(*({frame.index for frame in one.frames} for one in found))
    before, after = (_gap(one, common, seed) for one in found)
    return HeldOutGaps(before, after, len(common))


def _gap(found: Evaluation, images: set[int], seed: int) -> Interval:
    rows = [(one.residual_pct, one.noise_pct) for one in found.frames if one.index in images]
    residual, noise = np.array(rows).T
    return gap(residual, noise, np.random.default_rng(seed))


def directions(values: Sequence[float], covariance: Matrix) -> str:
    """What the images say of a change along x and y, in one sentence: along which directions they determine it.

    Parameters
    ----------
    values
        theta_x and theta_y.
    covariance
        Their covariance.
    """
    variances, ways = np.linalg.eigh(covariance)
    best, worst = np.sqrt(np.maximum(variances, 0.0))
    if worst <= _DETERMINED:
        return "the images determine the change along x and along y"
    # An eigenvector has no sign: the directions are those of angles from 0 to 180 degrees.
    angle = math.degrees(math.atan2(ways[1, 0], ways[0, 0])) % 180
    across = (angle + 90) % 180
    along, other = (
        values[0] * math.cos(math.radians(way)) + values[1] * math.sin(math.radians(way))
        for way in (angle, across)
    )
    return (
        f"the images cannot tell x from y: they determine the change along {angle:.0f} degrees from x to y, "
        f"{100 * along:+.1f} ± {100 * best:.1f} % across the field, but along {across:.0f} degrees only "
        f"{100 * other:+.1f} ± {100 * worst:.1f} %; a transit along another track would determine it"
    )
