"""How well a fit is known, from the images themselves: blocks held out, images drawn again.

Hofmeister et al., The point-spread function of HRI_EUV, section "Results": ten sequential blocks, each held out once
with a guard on both sides; in every other block images are drawn again with repetition; ten runs: 100 PSFs.

Two schemes. Exact: every fold is a fit of its own, from the start. Shared: about the solution of all images a fold
differs by a small step, which the images' shares of the normal equations give at once,

    q_f = q + (sum over images of k_i A_i)^-1 sum over images of k_i v_i        Eq. (1)

with k_i how often image i was drawn. It shares every reconstruction and costs nothing; the difference is second order.

| symbol | name |
|---|---|
| A_i, v_i | FrameFit.normal, FrameFit.score |
| k_i | Draw.counts |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.psf import cumulative_curve
from psfcore.scatter.inversion import Progress, Solution, invert
from psfcore.scatter.shapes import Shape, Vector, shape_named
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.blocks import Fold, folds
from psfcore.transit.transit import Transit

RUNS = 10
ONE_SIGMA, TWO_SIGMA = (15.865, 84.135), (2.275, 97.725)
RESOLVE_STEPS = 5


@dataclass(frozen=True)
class Draw:
    """One fold of one run: how often each image counts, and which are held out."""

    run: int
    fold: int
    counts: tuple[int, ...]
    held_out: tuple[int, ...]


@dataclass(frozen=True)
class FoldFit:
    """The PSF of one draw: coordinates, values by name, cumulative curve (percent), and residuals of images held out
    (percent of their observed mean, by index)."""

    run: int
    fold: int
    coordinates: tuple[float, ...]
    values: dict[str, float]
    curve_pct: tuple[float, ...]
    held_out_pct: dict[int, float]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**vars(self), "held_out_pct": {str(k): v for k, v in self.held_out_pct.items()}}

    @staticmethod
    def from_json(content: dict[str, Any]) -> FoldFit:
        """What to_json gave."""
        held_out = {int(k): float(v) for k, v in content["held_out_pct"].items()}
        return FoldFit(
            run=int(content["run"]),
            fold=int(content["fold"]),
            coordinates=tuple(content["coordinates"]),
            values=dict(content["values"]),
            curve_pct=tuple(content["curve_pct"]),
            held_out_pct=held_out,
        )


@dataclass(frozen=True, eq=False)
class Bands:
    """Median and bands over all draws: at radii_px the curve's 1 and 2 sigma limits, (5, radii): -2, -1, 0, 1, 2."""

    radii_px: Vector
    curve_pct: NDArray[np.float64]
    values: dict[str, Vector]
    totals: Vector
    held_out_pct: dict[int, float]

    @property
    def held_out(self) -> dict[str, float]:
        """Mean, rms and largest of the held-out residuals, percent; each image's mean over the draws counts once."""
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
        names = ("minus_2_sigma", "minus_1_sigma", "median", "plus_1_sigma", "plus_2_sigma")
        return {
            "radii_px": self.radii_px.tolist(),
            "light_beyond_pct": dict(zip(names, self.curve_pct.tolist(), strict=True)),
            "parameters": {
                name: dict(zip(names, limits.tolist(), strict=True)) for name, limits in self.values.items()
            },
            "totals": self.totals.tolist(),
            "held_out": self.held_out,
            "held_out_pct": {str(image): value for image, value in self.held_out_pct.items()},
        }


def draws(images: int, *, runs: int = RUNS, seed: int = 1) -> tuple[Draw, ...]:
    """All draws of all runs. Raises DataError "too-few-images" where there are not two blocks."""
    blocks = folds(images)
    if not blocks:
        raise DataError("too-few-images", f"expected at least 6 images to hold blocks out; got {images}")
    rng = np.random.default_rng(seed)
    return tuple(_draw(run, fold, blocks, images, rng) for run in range(runs) for fold in range(len(blocks)))


def _draw(run: int, fold: int, blocks: tuple[Fold, ...], images: int, rng: np.random.Generator) -> Draw:
    """Every block but the one held out gives as many images as it has left, drawn with repetition."""
    counts = np.zeros(images, dtype=np.int64)
    fitted = set(blocks[fold].fitted)
    for k, block in enumerate(blocks):
        left = [image for image in block.held_out if image in fitted]
        if k != fold and left:
            np.add.at(counts, rng.choice(left, len(left)), 1)
    return Draw(run, fold, tuple(int(c) for c in counts), blocks[fold].held_out)


def shared_fits(
    solution: Solution, wanted: tuple[Draw, ...], *, progress: Progress = lambda stage, step, steps: None
) -> tuple[FoldFit, ...]:
    """The PSFs of all draws by Eq. (1), from the solution of all images.

    Images left out of the solution are left out of every draw. Raises DataError "transit-says-too-little" where
    a draw leaves a parameter open.
    """
    inversion = solution.inversion
    frames = dict(zip(solution.part, inversion.frames, strict=True))
    out = []
    for step, draw in enumerate(wanted):
        progress("folds", step, len(wanted))
        drawn = [(draw.counts[n], frame) for n, frame in frames.items() if draw.counts[n]]
        normal = np.sum([k * frame.normal for k, frame in drawn], axis=0)
        if not drawn or np.linalg.cond(normal) > 1e12:
            message = (
                f"run {draw.run}, fold {draw.fold}: expected images that fix all parameters; got too few"
            )
            raise DataError("transit-says-too-little", message)
        move = np.linalg.solve(normal, np.sum([k * frame.score for k, frame in drawn], axis=0))  # Eq. (1)
        held_out = {
            n: 100
            * (frames[n].expected + float(frames[n].answer @ move) - frames[n].observed)
            / frames[n].observed
            for n in draw.held_out
            if n in frames
        }
        out.append(_fold_fit(draw, inversion.shape, solution.total, inversion.coordinates + move, held_out))
    return tuple(out)


def exact_fit(
    transit: Transit,
    shape: str,
    draw: Draw,
    *,
    start: Vector | None = None,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> FoldFit:
    """The PSF of one draw by a fit of its own; images held out are looked at with that PSF afterwards."""
    solution = invert(
        transit, shape_named(shape), start=start, counts=draw.counts, threads=threads, progress=progress
    )
    held_out = {}
    left_out = solution.inversion.left_out
    for n in draw.held_out:
        if transit.frames[n].file in left_out:
            continue
        solution.sky.scenes[n] = solution.optics.undo(
            solution.sky.observed[n], solution.sky.scenes[n], steps=RESOLVE_STEPS
        )
        residual, expected = solution.residual(n)
        held_out[n] = float(-100 * residual.mean() / (expected + residual).mean())
    inversion = solution.inversion
    return _fold_fit(draw, inversion.shape, solution.total, inversion.coordinates, held_out)


def _fold_fit(draw: Draw, shape: Shape, total: TotalPsf, at: Vector, held_out: dict[int, float]) -> FoldFit:
    return FoldFit(
        run=draw.run,
        fold=draw.fold,
        coordinates=tuple(float(q) for q in at),
        values=shape.values(at),
        curve_pct=tuple(float(c) for c in cumulative_curve(total.kernel(at), total.radii_px)),
        held_out_pct=held_out,
    )


def bands(fits: tuple[FoldFit, ...], radii_px: Vector) -> Bands:
    """Medians and percentiles over the draws."""
    limits = (TWO_SIGMA[0], ONE_SIGMA[0], 50.0, ONE_SIGMA[1], TWO_SIGMA[1])
    held_out: dict[int, list[float]] = {}
    for fit in fits:
        for image, residual in fit.held_out_pct.items():
            held_out.setdefault(image, []).append(residual)
    return Bands(
        radii_px=radii_px,
        curve_pct=np.percentile([fit.curve_pct for fit in fits], limits, axis=0),
        values={name: np.percentile([fit.values[name] for fit in fits], limits) for name in fits[0].values},
        totals=np.array([fit.values["total"] for fit in fits]),
        held_out_pct={image: float(np.mean(found)) for image, found in sorted(held_out.items())},
    )
