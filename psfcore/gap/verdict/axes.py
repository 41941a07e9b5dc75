"""What the gap depends on: the share of the gap that each axis explains.

An axis is a property of an image (for example its time) or of a cell in the disc (for example its radius). The axes are
confounded: a transit has few pointings and one track, so position, time and brightness vary together. All axes together
explain a decrease of chi2. The share of an axis is its contribution to this decrease, averaged over all orders in which
the axes can be added (Shapley value).

The p-value of an axis comes from random sign flips: each flip reverses the sign of the residuals of random images. A
flip counts if this axis alone then decreases chi2 at least as much as for the true residuals. The p-value is the
fraction of flips that count, times the number of axes. If the brightness of the unocculted field gives a smaller
p-value, that p-value is used.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from psfcore.arrays import Matrix, Vector
from psfcore.gap.evidence.cells import DiscCells
from psfcore.gap.evidence.linear_model import LinearModel, Step
from psfcore.gap.evidence.responses import Evidence, ImageInfo
from psfcore.gap.schema import AxisJson

SIGN_FLIPS = 999
# an axis of the best effect comes first if it explains at least this fraction of what the best axis explains
AS_GOOD = 0.3
SIGNIFICANT = 0.05  # axes with a p-value below this level come before the others
SUSPECT = 2  # number of pointings that the report names


@dataclass(frozen=True)
class Axis:
    """How much of the gap varies along one axis, and where the gap is largest.

    Attributes
    ----------
    share
        The share of the gap that varies along the axis, 0 to 1.
    alone
        The decrease of chi2 by this axis alone.
    at
        The pointings with the largest residuals, and the range of the axis in them.
    of_best
        Whether the axis comes first because the best effect varies along it, although p-value and share would put
        another axis first.
    """

    name: str
    share: float
    p_value: float
    alone: float
    at: dict[str, list[int] | list[float]]
    of_best: bool = False

    def to_json(self) -> AxisJson:
        """The axis as JSON, for the gap report."""
        return {
            "axis": self.name,
            "share": self.share,
            "p_value": self.p_value,
            "at": self.at,
            "of_best": self.of_best,
        }


def ranked_axes(
    model: LinearModel, rng: np.random.Generator, favoured: Sequence[str] = (), explained: Step | None = None
) -> tuple[Axis, ...]:
    """All axes, the strongest first. Significant axes come before the others; then the share decides.

    Parameters
    ----------
    favoured
        The axes of the best effect. They come first if they explain at least the fraction AS_GOOD of what the best axis
        explains, because more data than the position on the track identified this effect.
    explained
        The fit of an effect that explains the gap. If `explained` is given, the shares are computed from the part of
        the residuals that this effect explains. This part is computed from the fitted model, so it does not contain the
        pixel noise of the residuals.
    """
    designs = _designs(model.evidence)
    names, spans, columns = list(designs), {}, 0
    for name, patterns in designs.items():
        spans[name] = list(range(columns, columns := columns + patterns[0].shape[0]))
    design, absorbed = _of_cells(model, designs)
    normal = design @ design.T

    def left(of_discs: Sequence[Vector]) -> Vector:
        """The residuals of all discs in one vector, without the component that a change of the PSF can absorb."""
        residual = np.concatenate(of_discs)
        return np.asarray(residual - absorbed @ (absorbed.T @ residual))

    residual = left([one.residual for one in model.discs])
    seen = score = (design @ residual)[None]
    if explained is not None:
        base = len(model.evidence.base)
        here, values = list(explained.columns[base:]), explained.values[base:]
        seen = (design @ left([disc.jacobian[here].T @ values for disc in model.discs]))[None]
    in_blocks, score_of_blocks = _of_unocculted(model, designs)
    subset = {}
    for chosen in itertools.chain(*(itertools.combinations(names, size) for size in range(len(names) + 1))):
        here = [c for name in chosen for c in spans[name]]
        subset[chosen] = float((_falls(normal, seen, here) + _falls(in_blocks, score_of_blocks, here))[0])
    shares = shapley(names, subset)
    total = max(sum(max(share, 0.0) for share in shares.values()), 1e-300)
    signs = np.array([rng.choice((-1.0, 1.0), len(model.discs)) for _ in range(SIGN_FLIPS)])
    flips = (np.repeat(signs, [d.residual.size for d in model.discs], axis=1) * residual) @ design.T
    axes = []
    for name, here in spans.items():
        as_good = int((_falls(normal, flips, here) >= _falls(normal, score, here)).sum())
        p_value = min(1.0, (1 + as_good) / (1 + SIGN_FLIPS) * len(names))
        of_blocks = float(_falls(in_blocks, score_of_blocks, here)[0])
        if of_blocks > 0:
            p_value = min(p_value, len(names) * float(chdtrc(len(here), of_blocks + len(here))))
        share = max(shares[name], 0.0) / total
        axes.append(Axis(name, share, p_value, subset[(name,)], _at(model, name)))
    best = max((axis.alone for axis in axes), default=0.0)
    axes.sort(key=lambda axis: (axis.p_value > SIGNIFICANT, -axis.share))
    leading = [axis for axis in axes if axis.name in favoured and axis.alone >= AS_GOOD * best]
    others = [axis for axis in axes if axis not in leading]
    if leading and leading[0] != axes[0]:
        leading[0] = replace(leading[0], of_best=True)
    return (*leading, *others)


def _designs(evidence: Evidence) -> dict[str, list[Matrix]]:
    """The patterns of each axis along which these images vary: for each disc an array (patterns, cells), DN/s."""
    taken = [evidence.image_info[disc.index] for disc in evidence.discs]
    level = [np.full(disc.expected.size, disc.mean_expected) for disc in evidence.discs]
    out: dict[str, list[Matrix]] = {}
    for name, values in _along(evidence.discs, taken).items():
        columns = _curve(values) if name not in ("pointing", "gain_mode") else _kinds(values)
        if columns is not None:
            out[name] = [column[:, None] * one for column, one in zip(columns.T, level, strict=True)]
    inside = [disc.patterns for disc in evidence.discs]
    out["radius_in_disc"] = [p[:1] * one for p, one in zip(inside, level, strict=True)]
    out["azimuth_in_disc"] = [p[1:] * one for p, one in zip(inside, level, strict=True)]
    return out


def _along(discs: Sequence[DiscCells], taken: Sequence[ImageInfo]) -> dict[str, Vector]:
    """The value of each image on each axis: (images,)."""
    return {
        "detector_x": np.array([t.x_px for t in taken]),
        "detector_y": np.array([t.y_px for t in taken]),
        "time": np.array([t.time_s for t in taken]),
        "pointing": np.array([float(t.pointing) for t in taken]),
        "intensity": np.log(np.array([max(d.mean_expected, 1e-6) for d in discs])),
        "exposure": np.log(np.array([t.exposure_s for t in taken])),
        "gain_mode": np.array([float((t.gain_mode or "").lower() == "combined") for t in taken]),
        "scattering_distance": np.array([t.scattering_distance_px for t in taken]),
    }


def _curve(values: Vector) -> Matrix | None:
    """Functions of the values of an axis (functions, images): a slope, and a curvature if at least three values differ.

    None if all images have the same value.
    """
    spread = float(values.std())
    if spread <= 1e-9 * max(1.0, float(np.abs(values).max())):
        return None
    x = (values - values.mean()) / spread
    if np.unique(values).size < 3:
        return np.asarray(x[None, :])
    bend = x**2 - np.polyval(np.polyfit(x, x**2, 1), x)
    return np.array([x, bend]) if float(bend.std()) > 1e-6 else x[None, :]


def _kinds(values: Vector) -> Matrix | None:
    """For each value that occurs, except the smallest: 1 for the images with this value, otherwise 0; minus the mean.

    Returns an array (values - 1, images); None if all images have the same value.
    """
    rows = [(values == kind) - np.mean(values == kind) for kind in np.unique(values)[1:]]
    return np.array(rows) if rows else None


def _of_cells(model: LinearModel, designs: dict[str, list[Matrix]]) -> tuple[Matrix, Matrix]:
    """Two results for the whitened cells of all discs: the patterns of the axes (patterns, cells), without the
    component that a change of the PSF can absorb; and an orthonormal basis of this component (cells, coordinates).
    """
    base, each = list(model.evidence.base), enumerate(model.discs)
    rows = [np.vstack([patterns[k] for patterns in designs.values()]) @ disc.white for k, disc in each]
    design = np.hstack(rows)
    absorbed = np.linalg.qr(np.hstack([disc.jacobian[base] for disc in model.discs]).T)[0]
    return design - (design @ absorbed) @ absorbed.T, absorbed


def _of_unocculted(model: LinearModel, designs: dict[str, list[Matrix]]) -> tuple[Matrix, Matrix]:
    """The normal matrix and the right-hand side (1, patterns) of the patterns of all axes, for the brightness of the
    unocculted field.

    The brightness of an image is relative to the mean of its pointing, and divided by its usual spread (`gain_width`).
    """
    evidence, images = model.evidence, list(model.evidence.images)
    gains = evidence.all_unocculted.gains[images] / evidence.unocculted.gain_width
    columns = np.array(
        [
            np.concatenate([patterns[k].mean(axis=1) for patterns in designs.values()]) / disc.mean_expected
            for k, disc in enumerate(evidence.discs)
        ]
    ).T
    pointing = evidence.unocculted.pointing[images]
    for one in np.unique(pointing):  # only brightness relative to the same pointing is known
        here = pointing == one
        columns[:, here] -= columns[:, here].mean(axis=1, keepdims=True)
        gains = np.where(here, gains - gains[here].mean(), gains)
    return columns @ columns.T, (columns @ gains)[None]


def _falls(normal: Matrix, scores: Matrix, columns: list[int]) -> Vector:
    """The decrease of chi2 by these columns, minus their number, at least 0: one value for each flip.

    Parameters
    ----------
    scores
        Right-hand sides of the normal equations (flips, columns).
    """
    if not columns:
        return np.zeros(scores.shape[0])
    normal, scores = normal[np.ix_(columns, columns)], scores[:, columns]
    size = np.sqrt(np.maximum(np.diag(normal), 1e-12))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-6, hermitian=True)
    scores = scores / size
    return np.asarray(np.maximum(np.einsum("ni,ij,nj->n", scores, inverse, scores) - len(columns), 0.0))


def shapley(names: list[str], worth: dict[tuple[str, ...], float]) -> dict[str, float]:
    """The Shapley value of each name, from the decrease of chi2 by each subset of the names (`worth`)."""
    out = dict.fromkeys(names, 0.0)
    for chosen, value in worth.items():
        for name in (one for one in names if one not in chosen):
            more = worth[tuple(one for one in names if one in chosen or one == name)] - value
            out[name] += 1 / (len(names) * math.comb(len(names) - 1, len(chosen))) * more
    return out


def _at(model: LinearModel, name: str) -> dict[str, list[int] | list[float]]:
    """The pointings with the largest residuals, and the range of the axis in these pointings."""
    discs, taken = model.evidence.discs, [model.evidence.image_info[n] for n in model.evidence.images]
    excess = np.array([float(r @ r) - r.size for r in model.left(model.base)])
    pointing = np.array([info.pointing for info in taken])
    by_pointing = {int(one): float(excess[pointing == one].sum()) for one in np.unique(pointing)}
    strongest = sorted(by_pointing, key=lambda one: -by_pointing[one])[:SUSPECT]
    out: dict[str, list[int] | list[float]] = {"pointings": sorted(strongest)}
    values = _along(discs, taken).get(name)
    if values is not None and name not in ("pointing", "gain_mode"):
        here = values[np.isin(pointing, strongest)]
        ends = float(here.min()), float(here.max())
        out["range"] = [math.exp(end) if name in ("intensity", "exposure") else end for end in ends]
    return out
