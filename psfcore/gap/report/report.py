"""The gap report: schema gap/1, and the sentence that a person reads first."""

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
MOST_READ = 12  # numbers of an effect that a person reads one by one
PROBE_NAMES = {probe.name for probe in PROBES}
AXIS_WORDS = {
    "detector_x": "along detector x",
    "detector_y": "along detector y",
    "time": "in time",
    "pointing": "from pointing to pointing",
    "intensity": "with the intensity",
    "exposure": "with the exposure",
    "gain_mode": "with the gain mode",
    "radius_in_disc": "with the radius in the disc",
    "azimuth_in_disc": "with the azimuth in the disc",
    "scattering_distance": "with the distance that light scatters from",
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
    """Effects of an answer may each do little without the other, and go before what alone does more; of those that act
    together the one that was measured in the lit parts comes second, for it fits these whatever else acts on them."""
    best = found.judgement.best
    together = best is not None and len(best.names) > 1
    here = tried.names[0] in found.judgement.answer
    return not here, here and together and found.evidence.numbers_of(tried.step.columns) > 0


def fits_of(report: dict[str, Any]) -> list[dict[str, Any]]:
    """A report's fits of effects together, if there are any, and then of each alone: as they are shown."""
    return [*report["together"], *report["effects"]]


def _values(inversion: Inversion, covariance: NDArray[np.float64]) -> dict[str, Any]:
    """A shape's parameters; errors are those of the fit that the effects are judged by, floor included."""
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
    """Every image's disc: where, how bright, what was left, held out, before and after."""
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
    """What observation would tell tied effects apart, or settle an answer."""
    if found.judgement.verdict != "tie":
        return ""
    said = [_by_name(found, name).settled_by for name in found.judgement.tied]
    return "; ".join(dict.fromkeys(said))


def sentence(found: Diagnosis) -> str:
    """What a person reads first."""
    judged = found.judgement
    images = len(found.evidence.discs)
    if judged.verdict == "inconclusive" and judged.p_value > ALARM:
        return (
            f"No gap shows in these {images} images, and they could hide one: nothing can be held out of fewer than "
            f"{LEAST_IMAGES}, and p = {judged.p_value:.2g} with so few excludes little."
        )
    left = f"{found.rms.value:.1f} % ({found.rms.low:.1f} to {found.rms.high:.1f})"
    if judged.verdict == "none" and found.residual is None:
        return (
            f"No gap shows in these {images} images (p = {judged.p_value:.2g}); they are too few to hold any out, so that how "
            "large a gap could hide in them is not known."
        )
    if judged.verdict == "none":
        return (
            f"No gap beyond noise and the fit's own error: held-out residuals of {left} beyond a noise of "
            f"{found.noise_pct:.1f} %, p = {judged.p_value:.2g}."
        )
    strongest = found.where[0]
    pointings = " and ".join(str(p) for p in strongest.at.get("pointings", []))
    lead = f"A residual of {left} {AXIS_WORDS[strongest.name]}, most in pointings {pointings}"
    if found.rms.value < found.noise_pct and _unocculted_alone(found):
        lead = (
            f"The lit parts of neighbouring images differ {AXIS_WORDS[strongest.name]}, which the discs hide "
            f"(a residual of {left} there)"
        )
    best = judged.best
    if judged.verdict == "unknown" or best is None:
        like = _by_name(found, judged.probes[0].names[0]).cause if judged.probes else ""
        close = f"; it looks most like {like}" if like and judged.probes[0].score > 0 else ""
        return f"{lead}: no effect of the library explains it{close}."
    if judged.verdict == "tie":
        return f"{lead}: {tied_words(judged)}, which these data cannot tell apart; {would_separate(found)} would."
    if judged.discs_unexplained:
        return f"{lead}: {discs_unexplained_words(judged)}."
    if judged.verdict == "inconclusive":
        return (
            f"{lead} is likely (p = {judged.p_value:.2g}), but what causes it depends on what is taken for granted, or is "
            f"met as well by a form of unknown cause; best so far: {words(best.label)}."
        )
    return f"{lead}; {_explained(found, best)}{_excluded(found, best)}."


def _unocculted_alone(found: Diagnosis) -> bool:
    """Whether the lit blocks show a gap that the discs' cells do not."""
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
        f"{words(best.label)} explains it ({in_short or ', '.join(numbers)}); held-out gap {found.rms.value:.1f} -> "
        f"{found.after.value:.1f} %, noise {found.noise_pct:.1f} %"
    )


def tied_words(judged: Judgement) -> str:
    """What is tied, as a person writes it, and beside what."""
    among = " or ".join(words(name) for name in judged.tied)
    beside = " and ".join(words(name) for name in judged.certain)
    return f"{beside}, and beside it {among}" if beside else among


def discs_unexplained_words(judged: Judgement) -> str:
    """That what shows in the lit parts does not make the discs' gap."""
    shown = words(judged.best.label) if judged.best is not None else "a change"
    return f"{shown} shows in the lit parts, and what leaves a gap in the discs beside it cannot be told"


def in_short_if_many(values: Sequence[float]) -> str | None:
    """What a person reads in place of more numbers than MOST_READ; none of fewer."""
    if len(values) <= MOST_READ:
        return None
    return f"{len(values)} numbers, root of their summed squares {float(np.linalg.norm(values)):.2g}"


def _excluded(found: Diagnosis, best: Tried) -> str:
    """The next best effect, and by how many sigmas it is worse."""
    gone = found.judgement.amiss  # said among the cautions
    others = [t for t in found.judgement.tried if not set(t.names) & set(best.names) and t.label not in gone]
    if not others:
        return ""
    next_best = max(others, key=lambda t: t.score)
    if best.score - next_best.score < TIE:  # it was set aside by the images held out
        return f"; {words(next_best.label)} fits as well, but fails on images held out of its fit"
    sigmas = (best.score - next_best.score) ** 0.5
    shrunk = found.shrinking[next_best.label].closure
    closes = "" if shrunk is None else f" closes {100 * max(shrunk.value, 0.0):.0f} % and"
    return f"; {words(next_best.label)}{closes} is excluded at {sigmas:.1f} sigma"


def words(name: str) -> str:
    """A name as a person writes it."""
    return name.replace("_", " ")


def best_words(found: Diagnosis) -> str:
    """The effects of the first real refit."""
    return " + ".join(words(effect.name) for effect in found.corrected[0].effects)
