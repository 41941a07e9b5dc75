"""Where a gap lies: what share of it goes with each axis.

Axes are confounded: a transit has three pointings and one track, so that place, time and brightness go together. The
share of an axis is what it adds to the others, averaged over all orders in which they could be taken (Shapley's
value), of what all axes explain together; its p-value counts how often images with their signs drawn anew fall as far
with this axis alone, times the number of axes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.cells import DiscCells
from psfcore.gap.evidence import Evidence, Taken
from psfcore.gap.linear_model import LinearModel
from psfcore.gap.patterns import in_disc

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]

DRAWS = 999
AS_GOOD = 0.6  # of the best axis' own fall: an axis that explains so much may be the strongest
SIGNIFICANT = 0.05  # an axis that chance explains does not come before one that it does not
SUSPECT = 2  # pointings that are named


@dataclass(frozen=True)
class Axis:
    """How much of a gap follows one axis, and where along it."""

    name: str
    share: float
    p_value: float
    alone: float
    at: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """As a gap report has it."""
        return {"axis": self.name, "share": self.share, "p_value": self.p_value, "at": self.at}


def where(model: LinearModel, rng: np.random.Generator, favoured: Sequence[str] = ()) -> tuple[Axis, ...]:
    """All axes, the strongest first: of those that chance does not explain, the one with the largest share.

    favoured: axes of the effect that was found; of axes that explain about as much, they come first, for the effect was
    found by more than its place on the track.
    """
    designs = _designs(model.evidence)
    disc, lit = _equations(model, designs)
    names = list(designs)
    spans = _spans(designs)
    subset = {
        chosen: _fall(disc, lit, [c for name in chosen for c in spans[name]])
        for size in range(len(names) + 1)
        for chosen in itertools.combinations(names, size)
    }
    shares = _shapley(names, subset)
    total = max(sum(max(share, 0.0) for share in shares.values()), 1e-300)
    draws = _drawn(model, designs, rng)
    out = []
    for name in names:
        alone = subset[(name,)]
        beaten = sum(_fall(d, None, spans[name]) >= _fall(disc, None, spans[name]) for d in draws)
        p_value = min(1.0, (1 + beaten) / (1 + len(draws)) * len(names))
        if lit is not None and _fall_of(lit, spans[name]) > 0:
            p_value = min(p_value, _p_of_lit(lit, spans[name], len(names)))
        out.append(Axis(name, max(shares[name], 0.0) / total, p_value, alone, _at(model, name)))
    best = max((axis.alone for axis in out), default=0.0)
    return tuple(
        sorted(
            out,
            key=lambda a: (
                not (a.name in favoured and a.alone >= AS_GOOD * best),
                a.p_value > SIGNIFICANT,
                -a.share,
            ),
        )
    )


def _designs(evidence: Evidence) -> dict[str, list[Matrix]]:
    """For each axis along which these images differ, a pattern (columns, cells) in DN/s for each disc."""
    taken = [evidence.taken[disc.index] for disc in evidence.discs]
    level = [np.full(disc.expected.size, disc.mean_expected) for disc in evidence.discs]
    out: dict[str, list[Matrix]] = {}
    for name, values in _along(evidence.discs, taken).items():
        columns = _curve(values) if name not in ("pointing", "gain_mode") else _kinds(values)
        if columns is not None:
            out[name] = [column[:, None] * one for column, one in zip(columns.T, level, strict=True)]
    inside = [in_disc(disc) for disc in evidence.discs]
    out["radius_in_disc"] = [p[:1] * one for p, one in zip(inside, level, strict=True)]
    out["azimuth_in_disc"] = [p[1:] * one for p, one in zip(inside, level, strict=True)]
    return out


def _along(discs: Sequence[DiscCells], taken: Sequence[Taken]) -> dict[str, Vector]:
    """Each image's value on each axis."""
    return {
        "detector_x": np.array([t.x_px for t in taken]),
        "detector_y": np.array([t.y_px for t in taken]),
        "time": np.array([t.time_s for t in taken]),
        "pointing": np.array([float(t.fov) for t in taken]),
        "intensity": np.log(np.array([max(d.mean_expected, 1e-6) for d in discs])),
        "exposure": np.log(np.array([t.exposure_s for t in taken])),
        "gain_mode": np.array([float((t.gain_mode or "").lower() == "combined") for t in taken]),
        "scattering_distance": np.array([t.scattering_distance_px for t in taken]),
    }


def _curve(values: Vector) -> Matrix | None:
    """A slope and a bend along an axis, (2 or 1, images); none where all images lie at one place of it."""
    spread = float(values.std())
    if spread <= 1e-9 * max(1.0, float(np.abs(values).max())):
        return None
    x = (values - values.mean()) / spread
    if np.unique(values).size < 3:
        return x[None, :]
    bend = x**2 - np.polyval(np.polyfit(x, x**2, 1), x)
    return np.array([x, bend]) if float(bend.std()) > 1e-6 else x[None, :]


def _kinds(values: Vector) -> Matrix | None:
    """Which kind an image is of, less the mean: (kinds - 1, images)."""
    kinds = np.unique(values)
    if kinds.size < 2:
        return None
    return np.array([(values == kind) - np.mean(values == kind) for kind in kinds[1:]])


def _spans(designs: dict[str, list[Matrix]]) -> dict[str, list[int]]:
    first, out = 0, {}
    for name, patterns in designs.items():
        out[name] = list(range(first, first + patterns[0].shape[0]))
        first += patterns[0].shape[0]
    return out


@dataclass(frozen=True, eq=False)
class _Normal:
    normal: Matrix
    score: Vector


def _equations(model: LinearModel, designs: dict[str, list[Matrix]]) -> tuple[_Normal, _Normal | None]:
    """Normal equations of all axes' columns, the PSF's part taken out: of the discs, and of the lit blocks' brightness."""
    design, residual = _projected(model, designs)
    return _Normal(design @ design.T, design @ residual), _of_lit(model, designs)


def _projected(model: LinearModel, designs: dict[str, list[Matrix]]) -> tuple[Matrix, Vector]:
    """Whitened columns and residuals of all cells, what the PSF's coordinates take up taken out."""
    base = list(model.evidence.base)
    rows, psf, residual = [], [], []
    for k, disc in enumerate(model.discs):
        rows.append(np.vstack([patterns[k] for patterns in designs.values()]) @ disc.white)
        psf.append(disc.answers[base])
        residual.append(disc.residual)
    design, absorbed, left = np.hstack(rows), np.linalg.qr(np.hstack(psf).T)[0], np.concatenate(residual)
    return design - (design @ absorbed) @ absorbed.T, left - absorbed @ (absorbed.T @ left)


def _of_lit(model: LinearModel, designs: dict[str, list[Matrix]]) -> _Normal | None:
    """The same of how bright the images are among those of their pointing: their gains over the width of these."""
    lit = model.evidence.lit
    gains = model.whole_lit.gains[list(model.evidence.images)] / lit.gain_width
    columns = np.vstack(
        [
            np.array(
                [patterns[k].mean(axis=1) / disc.mean_expected for k, disc in enumerate(model.evidence.discs)]
            ).T
            for patterns in designs.values()
        ]
    )
    fov = lit.fov[list(model.evidence.images)]
    for one in np.unique(fov):  # brightness is known among images of one pointing alone
        here = fov == one
        columns[:, here] -= columns[:, here].mean(axis=1, keepdims=True)
        gains = np.where(here, gains - gains[here].mean(), gains)
    return _Normal(columns @ columns.T, columns @ gains)


def _fall(disc: _Normal, lit: _Normal | None, columns: list[int]) -> float:
    return _fall_of(disc, columns) + (_fall_of(lit, columns) if lit is not None else 0.0)


def _fall_of(of: _Normal, columns: list[int]) -> float:
    if not columns:
        return 0.0
    normal, score = of.normal[np.ix_(columns, columns)], of.score[columns]
    size = np.sqrt(np.maximum(np.diag(normal), 1e-12))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-6, hermitian=True)
    return max(float((score / size) @ inverse @ (score / size)) - len(columns), 0.0)


def _p_of_lit(lit: _Normal, columns: list[int], axes: int) -> float:
    from scipy.stats import chi2

    return min(1.0, axes * float(chi2.sf(_fall_of(lit, columns) + len(columns), len(columns))))


def _shapley(names: list[str], worth: dict[tuple[str, ...], float]) -> dict[str, float]:
    """What each name adds, averaged over all orders."""
    count = len(names)
    out = dict.fromkeys(names, 0.0)
    for chosen, value in worth.items():
        for name in names:
            if name in chosen:
                continue
            with_it = tuple(n for n in names if n in chosen or n == name)
            weight = 1 / (count * math.comb(count - 1, len(chosen)))
            out[name] += weight * (worth[with_it] - value)
    return out


def _drawn(model: LinearModel, designs: dict[str, list[Matrix]], rng: np.random.Generator) -> list[_Normal]:
    """Equations with every image's residuals turned over or not."""
    design, residual = _projected(model, designs)
    which = np.repeat(np.arange(len(model.discs)), [d.residual.size for d in model.discs])
    normal = design @ design.T
    return [
        _Normal(normal, design @ (residual * rng.choice((-1.0, 1.0), len(model.discs))[which]))
        for _ in range(DRAWS)
    ]


def _at(model: LinearModel, name: str) -> dict[str, Any]:
    """The pointings where the residuals are largest, and the axis' range in them."""
    evidence = model.evidence
    left = model.left(model.base)
    excess = np.array([float(r @ r) - r.size for r in left])
    fov = np.array([evidence.taken[d.index].fov for d in evidence.discs])
    by_fov = {int(one): float(excess[fov == one].sum()) for one in np.unique(fov)}
    strongest = sorted(by_fov, key=lambda one: -by_fov[one])[:SUSPECT]
    out: dict[str, Any] = {"pointings": sorted(strongest)}
    taken = [evidence.taken[d.index] for d in evidence.discs]
    values = _along(evidence.discs, taken).get(name)
    if values is not None and name not in ("pointing", "gain_mode"):
        here = values[np.isin(fov, strongest)]
        low, high = float(here.min()), float(here.max())
        if name in ("intensity", "exposure"):
            low, high = math.exp(low), math.exp(high)
        out["range"] = [low, high]
    return out
