"""The gap report as JSON (schema gap/1), and its summary sentence.

The named effects are those that the verdict names as the cause of the gap. The report lists them under "answer".
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.effect import Effect
from psfcore.gap.library.probes import PROBES
from psfcore.gap.verdict.closure import Interval
from psfcore.gap.verdict.correction import Corrected
from psfcore.gap.verdict.judge import ALARM, LEAST_IMAGES, TIE, Judgement, Tried
from psfcore.scatter.inversion import Inversion

SCHEMA = "gap/1"
MOST_READ = 12  # if an effect has more parameters, the report summarises them
PROBE_NAMES = {probe.name for probe in PROBES}
AXIS_WORDS = {
    "detector_x": "along detector x",
    "detector_y": "along detector y",
    "time": "in time",
    "pointing": "from pointing to pointing",
    "intensity": "with the intensity",
    "exposure": "with the exposure time",
    "gain_mode": "with the gain mode",
    "radius_in_disc": "with the radius in the disc",
    "azimuth_in_disc": "with the azimuth in the disc",
    "scattering_distance": "with the distance from which light scatters",
}


def gap_report(found: Diagnosis) -> dict[str, Any]:
    """The report of a diagnosis, schema gap/1."""
    judged = found.judgement
    refits = {c.label: c for c in found.corrected}
    fits = [(tried, _effect(found, tried, refits.get(tried.label))) for tried in judged.tried]
    return {
        "schema": SCHEMA,
        "sentence": sentence(found),
        "gap": {
            "before_refit_pct": found.before_refit.to_json(),
            "rms_pct": found.rms.to_json(),
            "after_pct": found.after.to_json(),
            "noise_pct": found.noise_pct,
            "p_value": judged.p_value,
        },
        "where": [axis.to_json() for axis in found.where],
        "verdict": judged.verdict,
        "answer": list(judged.answer),
        "effects": [
            fit for tried, fit in sorted(fits, key=lambda fit: _place(found, fit[0])) if len(tried.names) == 1
        ],
        "together": [fit for tried, fit in fits if len(tried.names) > 1],
        "ties": [list(judged.tied)] if judged.verdict == "tie" else [],
        "would_separate": would_separate(found),
        "untestable": [
            {"name": name, "why": why}
            for name, why in found.evidence.untestable.items()
            if name not in PROBE_NAMES
        ],
        "looks_like": [
            {"form": _by_name(found, probe.names[0]).cause, "score": probe.score, "p_value": probe.p_value}
            for probe in judged.probes[:3]
        ]
        if judged.verdict in ("unknown", "inconclusive")
        else [],
        "cautions": list(found.cautions),
        "expected": {
            "residual_pct": found.expected.residual_pct,
            "disc_chi2_a_cell": found.expected.disc_scale,
            "lit_chi2_a_block": found.expected.unocculted_scale,
        },
        "psf": {
            "shape": found.solution.inversion.shape.name,
            "refitted": _values(found.solution.inversion, found.model.base.covariance),
            "with_answer": _values(found.corrected[0].solution.inversion, found.corrected[0].covariance)
            if found.corrected
            else None,
        },
        "shape": list(found.solution.transit.shape),
        "images": _images(found),
        "inputs_sha256": found.solution.transit.sha256,
    }


def _place(found: Diagnosis, tried: Tried) -> tuple[bool, bool]:
    """Sort key of a fit. The named effects come first, because each may explain little without the other.

    Among the named effects, an effect that was measured in the unocculted field comes last, because it fits that field
    whatever the cause.
    """
    best = found.judgement.best
    together = best is not None and len(best.names) > 1
    here = tried.names[0] in found.judgement.answer
    return not here, here and together and found.evidence.numbers_of(tried.step.columns) > 0


def fits_of(report: dict[str, Any]) -> list[dict[str, Any]]:
    """All fits of a report, in the order of display: first the fits of several effects together, then the fits of single effects."""
    return [*report["together"], *report["effects"]]


def _values(inversion: Inversion, covariance: NDArray[np.float64]) -> dict[str, Any]:
    """The parameters of the shape. covariance: of its coordinates, from the linear model; the errors therefore contain the floor."""
    values, sigma = inversion.values, np.sqrt(np.diag(covariance))
    return {
        p.name: {
            "value": values[p.name],
            "sigma": float(abs(p.slope(float(at))) * s),
            "unit": p.unit,
        }
        for p, at, s in zip(inversion.shape.parameters, inversion.coordinates, sigma, strict=True)
    }


def _by_name(found: Diagnosis, name: str) -> Effect:
    return next(effect for effect in found.evidence.effects if effect.name == name)


def _effect(found: Diagnosis, tried: Tried, refit: Corrected | None) -> dict[str, Any]:
    shrinking = found.shrinking[tried.label]
    values = tried.values if refit is None else refit.values
    return {
        "name": tried.label,
        "parameters": {
            name: {"value": value, "sigma": sigma, "unit": unit}
            for name, (value, sigma, unit) in values.items()
        },
        "p_value": tried.p_value,
        "delta_chi2": tried.gain,
        "score": tried.score,
        "delta_chi2_held_out": shrinking.held_out_fall,
        "closure": _interval(shrinking.closure),
        "closure_by_pointing": _interval(shrinking.closure_by_pointing),
        "refitted": refit is not None,
        "cause": " ".join(_by_name(found, name).cause for name in tried.names),
    }


def _interval(interval: Interval | None) -> dict[str, Any] | None:
    return None if interval is None else interval.to_json()


def _images(found: Diagnosis) -> list[dict[str, Any]]:
    """The disc of every image: its position, its brightness, and its held-out residuals without and with the named effects."""
    before, after = found.residual, found.residual_after
    at_before = {} if before is None else dict(zip(before.images, before.residual_pct, strict=True))
    noise = {} if before is None else dict(zip(before.images, before.noise_pct, strict=True))
    at_after = {} if after is None else dict(zip(after.images, after.residual_pct, strict=True))
    noise_after = {} if after is None else dict(zip(after.images, after.noise_pct, strict=True))
    out = []
    for disc in found.evidence.discs:
        taken = found.evidence.image_info[disc.index]
        out.append(
            {
                "file": taken.file,
                "fov": taken.pointing,
                "x_px": taken.x_px,
                "y_px": taken.y_px,
                "time_s": taken.time_s,
                "exposure_s": taken.exposure_s,
                "gain_mode": taken.gain_mode,
                "observed_dn_s": disc.observed,
                "residual_pct": _number(at_before.get(disc.index)),
                "noise_pct": _number(noise.get(disc.index)),
                "residual_after_pct": _number(at_after.get(disc.index)),
                "noise_after_pct": _number(noise_after.get(disc.index)),
            }
        )
    return out


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def would_separate(found: Diagnosis) -> str:
    """The observations that would separate the tied effects, as text; empty for other verdicts."""
    if found.judgement.verdict != "tie":
        return ""
    said = [_by_name(found, name).settled_by for name in found.judgement.tied]
    return "; ".join(dict.fromkeys(said))


def sentence(found: Diagnosis) -> str:
    """The summary of a diagnosis: one to four sentences."""
    judged = found.judgement
    images = len(found.evidence.discs)
    if judged.verdict == "inconclusive" and judged.p_value > ALARM:
        return (
            f"No gap is visible in these {images} images (p = {judged.p_value:.2g}), but a gap may exist. With fewer than "
            f"{LEAST_IMAGES} images, no image can be held out, and only a large gap can be excluded."
        )
    left = f"{found.rms.value:.1f} % ({found.rms.low:.1f} to {found.rms.high:.1f})"
    if judged.verdict == "none" and found.residual is None:
        return (
            f"No gap is visible in these {images} images (p = {judged.p_value:.2g}). There are too few images to hold any of them out, so the "
            "largest gap that noise could hide is unknown."
        )
    if judged.verdict == "none":
        return (
            f"No gap beyond noise and the error of the fit was found: on held-out images the gap is {left}, the noise is "
            f"{found.noise_pct:.1f} %, and p = {judged.p_value:.2g}."
        )
    strongest = found.where[0]
    lead = f"There is a gap of {left}. It varies most {AXIS_WORDS[strongest.name]} and is largest in {_pointings(strongest.at)}."
    if found.rms.value < found.noise_pct and _unocculted_alone(found):
        lead = (
            f"There is a gap in the unocculted field, and it varies most {AXIS_WORDS[strongest.name]}. The discs do not show it "
            f"(the gap in the discs is {left})."
        )
    best = judged.best
    if judged.verdict == "unknown" or best is None:
        like = _by_name(found, judged.probes[0].names[0]).cause if judged.probes else ""
        close = f"; the gap most resembles {like}" if like and judged.probes[0].score > 0 else ""
        return f"{lead} No effect of the library explains the gap{close}."
    if judged.verdict == "tie":
        return (
            f"{lead} These data cannot show which effect causes the gap: {tied_words(judged)}. To separate these effects, take "
            f"{would_separate(found)}."
        )
    if judged.discs_unexplained:
        return f"{lead} {_capital(discs_unexplained_words(judged))}."
    if judged.verdict == "inconclusive":
        return (
            f"{lead} This gap is likely (p = {judged.p_value:.2g}), but its cause is uncertain: the best effect changes with the "
            "assumed floor, does not improve the prediction of held-out images, or fits no better than a pattern of unknown cause. "
            f"The best effect so far is {words(best.label)}."
        )
    return f"{lead} {_explained(found, best)}.{_excluded(found, best)}"


def _unocculted_alone(found: Diagnosis) -> bool:
    """Whether the blocks of the unocculted field show a gap, but the cells of the discs do not."""
    model = found.model
    left = model.left(model.base)
    cells = sum(float(one @ one) for one in left)
    freedom = sum(one.size for one in left)
    unocculted = model.evidence.steady_unocculted
    return bool(
        chdtrc(freedom, cells)
        > ALARM
        > chdtrc(unocculted.freedom, max(model.left_unocculted(model.base), 0.0))
    )


def _explained(found: Diagnosis, best: Tried) -> str:
    values = found.corrected[0].values if found.corrected else best.values
    numbers = [
        f"{words(name)} {value:.3g} ± {sigma:.2g} {unit}".strip()
        for name, (value, sigma, unit) in values.items()
    ]
    in_short = in_short_if_many([value for value, _, _ in values.values()])
    return (
        f"The gap is explained by {words(best.label)} ({in_short or ', '.join(numbers)}): on held-out images it falls from "
        f"{found.rms.value:.1f} % to {found.after.value:.1f} %, and the noise is {found.noise_pct:.1f} %"
    )


def tied_words(judged: Judgement) -> str:
    """The tied effects, and the certain effects that act together with them, as text."""
    among = " or ".join(words(name) for name in judged.tied)
    beside = " and ".join(words(name) for name in judged.certain)
    return f"{beside}, together with {among}" if beside else among


def discs_unexplained_words(judged: Judgement) -> str:
    """The statement that an effect explains the unocculted field, but not the gap in the discs."""
    shown = words(judged.best.label) if judged.best is not None else "an effect"
    return (
        f"{shown} explains the unocculted field, but the cause of the gap in the discs cannot be identified"
    )


def in_short_if_many(values: Sequence[float]) -> str | None:
    """A summary of parameters if there are more than MOST_READ; otherwise None."""
    if len(values) <= MOST_READ:
        return None
    return f"{len(values)} parameters, root sum of squares {float(np.linalg.norm(values)):.2g}"


def _excluded(found: Diagnosis, best: Tried) -> str:
    """A sentence that says why the next best effect was excluded; empty if there is no such effect."""
    gone = found.judgement.amiss  # the cautions name these effects
    others = [t for t in found.judgement.tried if not set(t.names) & set(best.names) and t.label not in gone]
    if not others:
        return ""
    next_best = max(others, key=lambda t: t.score)
    name = words(next_best.label)
    if best.score - next_best.score < TIE:  # the held-out images excluded it
        return f" {_capital(name)} fits about equally well, but predicts held-out images clearly worse."
    sigmas = (best.score - next_best.score) ** 0.5
    shrunk = found.shrinking[next_best.label].closure
    closes = "" if shrunk is None else f" closes {100 * max(shrunk.value, 0.0):.0f} % of the gap and"
    return f" The next best effect, {name},{closes} is excluded at {sigmas:.1f} sigma."


def _pointings(at: dict[str, Any]) -> str:
    numbers = at.get("pointings", [])
    return f"pointing{'s' if len(numbers) > 1 else ''} {' and '.join(map(str, numbers))}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def words(name: str) -> str:
    """The name of an effect or parameter, with spaces, for text."""
    return name.replace("_", " ")


def best_words(found: Diagnosis) -> str:
    """The effects of the first full refit, as text."""
    return " + ".join(words(effect.name) for effect in found.corrected[0].effects)
