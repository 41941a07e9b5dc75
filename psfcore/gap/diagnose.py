"""The verdict: is there a gap, where does it lie, which effect causes it, and how far does it shrink.

Everything is linear algebra on the evidence (`evidence`). An effect is tried beside the PSF's own parameters, which
are refitted with it: what they absorb is not its. Its gain is what chi2 falls by,

    gain = v^T A^-1 v - v_0^T A_00^-1 v_0                       Eq. (1)    0: the PSF's parameters alone

under no effect a chi2 of as many degrees of freedom as it has parameters; the smallest of the p-values counts times
the number of effects (Bonferroni). Two effects are compared by gain - PENALTY times parameters; what lies within
TIE of the best cannot be told from it. Pairs are searched exhaustively where one effect is not enough.

"Enough" is judged by what is left: the discs' means and the lit parts after the fit, against their noise. What no
effect explains stays unknown, for a wrong effect closes much of any gap. The verdict is repeated with half and twice
the floor; where it flips, it is inconclusive.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from psfcore.gap.effect import Effect
from psfcore.gap.evidence import Evidence
from psfcore.transit.blocks import folds

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]
Verdict = Literal["none", "attributed", "tie", "unknown", "inconclusive"]

SCHEMA = "gap/1"
FLOOR = 0.003
ALARM = 0.005  # p-value below which there is a gap
ENOUGH = 1e-3  # p-value of what is left, above which an effect is enough
CLEAR = 12.0  # gain of a second effect, beyond its parameters' due, that is worth it
PENALTY = 2.0
TIE = 9.0
PERMUTATIONS = 2000
DRAWS = 400
LIT_WIDTH = 0.03  # chi2 a degree of freedom that the lit parts may be off by, with no effect


@dataclass(frozen=True)
class Tried:
    """One effect, or two, fitted beside the PSF: values and errors by "effect.parameter", gain, what is left."""

    names: tuple[str, ...]
    values: dict[str, tuple[float, float, str]]
    gain: float
    p_value: float
    left_p_value: float
    step: Vector
    columns: tuple[int, ...]
    trials: int = 1

    @property
    def penalised(self) -> float:
        """Gain less what parameters, and a search over many places, gain from noise."""
        return self.gain - PENALTY * (len(self.values) + math.log(self.trials))


@dataclass(frozen=True)
class Interval:
    """A value with its 90 % interval."""

    value: float
    low: float
    high: float

    def to_json(self) -> dict[str, Any]:
        """As a gap report has it."""
        return {"value": self.value, "ci90": [self.low, self.high]}


@dataclass(frozen=True)
class Axis:
    """How much of the residuals' variance beyond noise follows one axis."""

    name: str
    share: float
    p_value: float
    at: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a transit says of the gap between it and the fitted model."""

    verdict: Verdict
    answer: tuple[str, ...]
    sentence: str
    p_value: float
    rms: Interval
    after: Interval
    before_refit: Interval
    noise_pct: float
    where: tuple[Axis, ...]
    tried: tuple[Tried, ...]
    closure: dict[str, Interval | None]
    held_out_gain: dict[str, float]
    ties: tuple[tuple[str, ...], ...]
    would_separate: str
    untestable: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """The report, schema gap/1."""
        return {
            "schema": SCHEMA,
            "sentence": self.sentence,
            "gap": {
                "before_refit_pct": self.before_refit.to_json(),
                "rms_pct": self.rms.to_json(),
                "after_pct": self.after.to_json(),
                "noise_pct": self.noise_pct,
                "p_value": self.p_value,
            },
            "where": [
                {"axis": a.name, "share": a.share, "p_value": a.p_value, "at": a.at} for a in self.where
            ],
            "verdict": self.verdict,
            "answer": list(self.answer),
            "effects": [
                {
                    "name": " + ".join(t.names),
                    "parameters": {
                        name: {"value": value, "sigma": sigma, "unit": unit}
                        for name, (value, sigma, unit) in t.values.items()
                    },
                    "p_value": t.p_value,
                    "delta_chi2_held_out": self.held_out_gain.get(" + ".join(t.names)),
                    "closure": _json_of(self.closure.get(" + ".join(t.names))),
                }
                for t in self.tried
            ],
            "ties": [list(tie) for tie in self.ties],
            "would_separate": self.would_separate,
            "untestable": [{"name": name, "why": why} for name, why in self.untestable.items()],
        }


def _json_of(interval: Interval | None) -> dict[str, Any] | None:
    return None if interval is None else interval.to_json()


def diagnose(evidence: Evidence, *, seed: int = 1) -> Diagnosis:
    """The verdict on a solution's evidence, with its figures."""
    judged = {factor: _judge(evidence, FLOOR * factor) for factor in (1.0, 0.5, 2.0)}
    verdict, answer, tried, p_value = judged[1.0]
    if any(other[:2] != (verdict, answer) for other in judged.values()) and verdict != "none":
        kept = set(answer)
        union = tuple(sorted({name for other in judged.values() for name in other[1]} | kept))
        if any(other[0] in ("none", "unknown") for other in judged.values()):
            verdict, answer = "inconclusive", answer
        elif set(union) != kept:
            verdict, answer = "tie", union
    rng = np.random.default_rng(seed)
    best = next((t for t in tried if set(t.names) == set(answer)), tried[0] if tried else None)
    closure, held_out = _held_out(evidence, tried, rng, gap=verdict != "none")
    residual, noise = _residuals(evidence, None)
    after = _residuals(evidence, best)[0] if best is not None and verdict != "none" else residual
    where = _where(evidence, rng)
    ties = () if verdict != "tie" else (answer,)
    rms, after_rms = _gap(residual, noise, rng), _gap(after, noise, rng)
    found = Diagnosis(
        verdict=verdict,
        answer=answer,
        sentence="",
        p_value=p_value,
        rms=rms,
        after=after_rms,
        before_refit=_before_refit(evidence, best if verdict in ("attributed", "tie") else None, noise, rng),
        noise_pct=float(np.sqrt(np.mean(noise**2))),
        where=where,
        tried=tried,
        closure=closure,
        held_out_gain=held_out,
        ties=ties,
        would_separate=_would_separate(evidence.effects, answer) if verdict == "tie" else "",
        untestable=evidence.untestable,
    )
    return Diagnosis(**{**vars(found), "sentence": _sentence(found, best)})


def _judge(evidence: Evidence, floor: float) -> tuple[Verdict, tuple[str, ...], tuple[Tried, ...], float]:
    """Verdict, answer, all that was tried (best first) and the gap's p-value, under one floor."""
    system = _System(evidence, floor)
    tried = sorted((system.fit((effect.name,)) for effect in evidence.effects), key=lambda t: -t.penalised)
    nothing = system.fit(())
    p_gap = min(1.0, 2 * min(nothing.left_p_value, min((t.p_value for t in tried), default=1.0) * len(tried)))
    if p_gap > ALARM or not tried:
        return "none", (), tuple(tried), p_gap
    best = tried[0]
    if best.p_value * len(tried) > ALARM:
        return "unknown", (), tuple(tried), p_gap
    if best.left_p_value < ENOUGH:
        pairs = [system.fit(pair) for pair in itertools.combinations([e.name for e in evidence.effects], 2)]
        pair = max(pairs, key=lambda t: t.penalised)
        if pair.penalised - best.penalised > CLEAR and (
            pair.left_p_value > ENOUGH or pair.gain > 3 * max(system.left(pair), 1.0)
        ):
            return "attributed", tuple(sorted(pair.names)), (pair, *tried), p_gap
        # A gap that an effect fills but for a trifle is its; one that it leaves is nobody's.
        if best.gain < 3 * max(system.left(best), 1.0):
            return "unknown", (), tuple(tried), p_gap
    rivals = [t for t in tried[1:] if best.penalised - t.penalised < TIE]
    if rivals:
        return "tie", tuple(sorted({best.names[0], *(t.names[0] for t in rivals)})), tuple(tried), p_gap
    return "attributed", best.names, tuple(tried), p_gap


class _System:
    """Discs and lit parts as one set of normal equations, under one floor."""

    def __init__(self, evidence: Evidence, floor: float) -> None:
        self._evidence, self._floor = evidence, floor
        self._normal, self._score = evidence.summed(floor)
        self._first = len(evidence.base)
        if evidence.lit is not None:
            self._normal[self._first :, self._first :] += evidence.lit.normal
            self._score[self._first :] += evidence.lit.score
        self._units = {e.name: [(p.name, p.unit) for p in e.parameters] for e in evidence.effects}
        self._trials = {e.name: e.trials for e in evidence.effects}
        self._alone, _, _ = self._solve(())

    def _solve(self, columns: Sequence[int]) -> tuple[float, Vector, Matrix]:
        """v A^-1 v, the step over the PSF's and these columns, and its covariance."""
        here = [*self._evidence.base, *columns]
        normal, score = self._normal[np.ix_(here, here)], self._score[here]
        size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        covariance = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-9, hermitian=True) / np.outer(
            size, size
        )
        step = covariance @ score
        return float(score @ step), step, covariance

    def fit(self, names: tuple[str, ...]) -> Tried:
        """The PSF's parameters with these effects."""
        columns = tuple(c for name in names for c in self._evidence.columns[name])
        total, step, covariance = self._solve(columns)
        gain = max(total - self._alone, 0.0)
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        values = {}
        k = self._first
        for name in names:
            for parameter, unit in self._units[name]:
                label = parameter if len(names) == 1 else f"{name}.{parameter}"
                values[label] = (float(step[k]), float(sigma[k]), unit)
                k += 1
        trials = math.prod(self._trials[name] for name in names)
        p_value = min(1.0, trials * float(chi2_distribution.sf(gain, len(columns)))) if columns else 1.0
        return Tried(names, values, gain, p_value, self._left_p_value(step, columns), step, columns, trials)

    def _left_p_value(self, step: Vector, columns: Sequence[int]) -> float:
        """The smaller of the p-values of what is left in the discs' means and in the lit parts, twice."""
        means, freedom = self._disc_chi2(step, columns)
        p_discs = float(chi2_distribution.sf(means, freedom))
        lit = self._evidence.lit
        if lit is None:
            return p_discs
        # Blocks are not quite as noisy as photons alone: a small excess a degree of freedom is allowed for.
        left = self._lit_chi2(step, columns) / (1 + LIT_WIDTH)
        return min(1.0, 2 * min(p_discs, float(chi2_distribution.sf(left, lit.freedom))))

    def _disc_chi2(self, step: Vector, columns: Sequence[int]) -> tuple[float, int]:
        here = [*self._evidence.base, *columns]
        total = 0.0
        for disc in self._evidence.discs:
            left = disc.observed - disc.expected - float(disc.answer[here] @ step)
            total += left**2 / (disc.noise**2 + (self._floor * disc.expected) ** 2)
        return total, max(1, len(self._evidence.discs) - len(here))

    def _lit_chi2(self, step: Vector, columns: Sequence[int]) -> float:
        lit = self._evidence.lit
        assert lit is not None
        here = [c - self._first for c in columns]
        theta = step[self._first :]
        return float(lit.chi2 - 2 * theta @ lit.score[here] + theta @ lit.normal[np.ix_(here, here)] @ theta)

    def left(self, tried: Tried) -> float:
        """chi2 beyond what is expected that a fit leaves, in discs and lit parts together."""
        means, freedom = self._disc_chi2(tried.step, tried.columns)
        excess = max(means - freedom, 0.0)
        lit = self._evidence.lit
        if lit is not None:
            excess += max(self._lit_chi2(tried.step, tried.columns) - lit.freedom * (1 + LIT_WIDTH), 0.0)
        return excess


def _residuals(evidence: Evidence, tried: Tried | None) -> tuple[Vector, Vector]:
    """Residuals of the discs' means and their noise, percent; with an effect's step taken out."""
    residual, noise = [], []
    for disc in evidence.discs:
        expected = disc.expected
        if tried is not None:
            expected += float(disc.answer[[*evidence.base, *tried.columns]] @ tried.step)
        residual.append(100 * (expected - disc.observed) / disc.observed)
        noise.append(100 * disc.noise / disc.observed)
    return np.array(residual), np.array(noise)


def _before_refit(
    evidence: Evidence, best: Tried | None, noise: Vector, rng: np.random.Generator
) -> Interval:
    """The gap of the PSF that the effect's fit gives, the effect itself left out: what a refit then absorbs."""
    if best is None:
        return _gap(_residuals(evidence, None)[0], noise, rng)
    step = best.step.copy()
    step[len(evidence.base) :] = 0.0
    without = Tried(best.names, best.values, 0.0, 1.0, 1.0, step, best.columns)
    return _gap(_residuals(evidence, without)[0], noise, rng)


def _gap(residual: Vector, noise: Vector, rng: np.random.Generator) -> Interval:
    """Rms beyond noise, and its 90 % interval over images drawn again."""

    def rms(chosen: NDArray[np.intp]) -> float:
        return math.sqrt(max(float(np.mean(residual[chosen] ** 2 - noise[chosen] ** 2)), 0.0))

    every = np.arange(residual.size)
    drawn = [rms(rng.choice(every, every.size)) for _ in range(DRAWS)]
    return Interval(rms(every), float(np.percentile(drawn, 5)), float(np.percentile(drawn, 95)))


def _held_out(
    evidence: Evidence, tried: Sequence[Tried], rng: np.random.Generator, *, gap: bool
) -> tuple[dict[str, Interval | None], dict[str, float]]:
    """Closure and gain of each effect on blocks of images that took no part in its fit.

    chi2 of the discs' means, and where the lit parts show the effect, theirs beside it.
    """
    closure: dict[str, Interval | None] = {}
    gains: dict[str, float] = {}
    blocks = folds(len(evidence.discs))
    before = _held_out_chi2(evidence, (), blocks)
    for one in tried:
        name = " + ".join(one.names)
        if before is None:
            closure[name] = None
            continue
        after = _held_out_chi2(evidence, one.columns, blocks)
        assert after is not None
        gains[name] = float(before.sum() - after.sum())
        closure[name] = _closure(evidence, one, before, after, rng) if gap else None
    return closure, gains


def _closure(
    evidence: Evidence, one: Tried, before: Vector, after: Vector, rng: np.random.Generator
) -> Interval | None:
    lit_before = lit_after = 0.0
    lit = evidence.lit
    if lit is not None:
        here = [c - len(evidence.base) for c in one.columns]
        theta = one.step[len(evidence.base) :]
        less = float(2 * theta @ lit.score[here] - theta @ lit.normal[np.ix_(here, here)] @ theta)
        lit_before = max(lit.chi2 - lit.freedom * (1 + LIT_WIDTH), 0.0)
        lit_after = max(lit_before - less, 0.0) if lit_before > 0 else 0.0

    def value(chosen: NDArray[np.intp]) -> float:
        excess = float((before[chosen] - 1).sum()) + lit_before
        return float("nan") if excess <= 0 else 1 - (float((after[chosen] - 1).sum()) + lit_after) / excess

    every = np.arange(before.size)
    whole = value(every)
    drawn = np.array([value(rng.choice(every, every.size)) for _ in range(DRAWS)])
    drawn = drawn[np.isfinite(drawn)]
    if not np.isfinite(whole) or drawn.size < DRAWS // 2:
        return None
    return Interval(whole, float(np.percentile(drawn, 5)), float(np.percentile(drawn, 95)))


def _held_out_chi2(evidence: Evidence, columns: Sequence[int], blocks: Sequence[Any]) -> Vector | None:
    """chi2 of each disc's mean after a fit to images apart from it."""
    if not blocks:
        return None
    here = [*evidence.base, *columns]
    first = len(evidence.base)
    out = np.zeros(len(evidence.discs))
    for fold in blocks:
        normal, score = evidence.summed(FLOOR, fold.fitted)
        normal, score = normal[np.ix_(here, here)], score[here]
        if evidence.lit is not None and columns:
            lit = [c - first for c in columns]
            normal[first:, first:] += evidence.lit.normal[np.ix_(lit, lit)]
            score[first:] += evidence.lit.score[lit]
        size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        step = (
            np.linalg.pinv(normal / np.outer(size, size), rcond=1e-9, hermitian=True) @ (score / size) / size
        )
        for k in fold.held_out:
            disc = evidence.discs[k]
            left = disc.observed - disc.expected - float(disc.answer[here] @ step)
            out[k] = left**2 / (disc.noise**2 + (FLOOR * disc.expected) ** 2)
    return out


def _where(evidence: Evidence, rng: np.random.Generator) -> tuple[Axis, ...]:
    """Along which axes the discs' residuals go, each within its pointing, by permutation; strongest first."""
    frames = [evidence.solution.transit.frames[d.index] for d in evidence.discs]
    places = [evidence.solution.sky.found[d.index].place for d in evidence.discs]
    residual, noise = _residuals(evidence, None)
    fov = np.array([f.fov for f in frames])
    axes: dict[str, Vector] = {
        "detector_x": np.array([p.x_px for p in places]),
        "detector_y": np.array([p.y_px for p in places]),
        "time": np.array([f.time_s for f in frames]),
        "intensity": np.log(np.array([max(d.observed, 1e-6) for d in evidence.discs])),
        "exposure": np.log(np.array([f.exposure_s for f in frames])),
        "pointing": fov.astype(np.float64),
        "gain_mode": np.array([float((f.gain_mode or "") == "combined") for f in frames]),
    }
    out = []
    for name, along in axes.items():
        design = _design(name, along, fov)
        if design is None:
            continue
        share = _share(design, residual, noise)
        shuffled = [
            _share(design, residual * rng.choice((-1, 1), residual.size), noise) for _ in range(PERMUTATIONS)
        ]
        p_value = (1 + sum(s >= share for s in shuffled)) / (1 + PERMUTATIONS)
        strongest = sorted(
            {int(f) for f in fov},
            key=lambda f: -float((residual[fov == f] ** 2 / noise[fov == f] ** 2).mean()),
        )
        at: dict[str, Any] = {"pointings": strongest[:2]}
        if name in ("detector_x", "detector_y"):
            at["range"] = [float(along.min()), float(along.max())]
        out.append(Axis(name, share, min(1.0, p_value * len(axes)), at))
    return tuple(sorted(out, key=lambda a: (a.p_value, -a.share)))


def _design(name: str, along: Vector, fov: NDArray[np.int64]) -> Matrix | None:
    """Columns that a residual along an axis is made of; none where all images lie at one place of it."""
    if np.ptp(along) == 0:
        return None
    if name == "pointing":
        return np.array([fov == f for f in np.unique(fov)], dtype=np.float64)
    centred = (along - along.mean()) / along.std()
    return np.array([np.ones_like(centred), centred])


def _share(design: Matrix, residual: Vector, noise: Vector) -> float:
    """Share of the weighted residuals' squares that a design takes up."""
    weighted = design / noise
    target = residual / noise
    fitted = np.linalg.lstsq(weighted.T, target, rcond=None)[0] @ weighted
    return float((fitted**2).sum() / max((target**2).sum(), 1e-300))


def _would_separate(effects: Sequence[Effect], answer: Sequence[str]) -> str:
    return "; ".join(e.settled_by for e in effects if e.name in answer)


def _sentence(found: Diagnosis, best: Tried | None) -> str:
    """What a person reads first."""
    left = f"{found.rms.value:.1f} % rms beyond a noise of {found.noise_pct:.1f} %"
    if found.verdict == "none":
        return f"No gap beyond noise and the fit's own error (residuals {left}, p = {found.p_value:.2g})."
    place = f", strongest along {found.where[0].name.replace('_', ' ')}" if found.where else ""
    if found.verdict == "unknown" or best is None:
        return f"A residual of {left}{place}: no effect of the library explains it."
    numbers = ", ".join(
        f"{name} {value:.3g} +- {sigma:.2g} {unit}".strip()
        for name, (value, sigma, unit) in best.values.items()
    )
    closed = found.closure.get(" + ".join(best.names))
    shrink = f"; held-out closure {100 * closed.value:.0f} %" if closed is not None else ""
    names = " and ".join(name.replace("_", " ") for name in best.names)
    if found.verdict == "attributed":
        return (
            f"A residual of {left}{place}; {names} explains it ({numbers}): "
            f"{found.rms.value:.1f} -> {found.after.value:.1f} %{shrink}."
        )
    among = ", ".join(name.replace("_", " ") for name in found.answer)
    if found.verdict == "tie":
        return f"A residual of {left}{place}; these data cannot tell apart {among}. {found.would_separate}."
    return f"A residual of {left}{place} is likely; what causes it ({among or 'no effect'}) these data cannot say."
