"""The gap report as JSON (schema gap/2), and its summary sentence.

The named effects are those that the verdict names as the cause of the gap. The report lists them under "answer".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.discrepancy import WORDS
from psfcore.gap.evidence.effect_fits import EffectFit, left_chi2
from psfcore.gap.evidence.fields import FieldShape
from psfcore.gap.verdict.closure import HeldOut
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Names
from psfcore.gap.verdict.verdict import LEAST_IMAGES, Judgement
from psfcore.scatter.reconstruction import Inversion

SCHEMA = "gap/2"
MOST_READ = 12  # if an effect has more parameters, the report summarises them
LIKELY_ORDER = 0.05  # an unknown cause resembles the patterns with at least this probability
LEAST_SHARE = 1e-3  # hypotheses with a smaller probability are not listed
MOST_ORDERS = 3
MOST_LISTED = 4  # hypotheses in the summary sentence
VISIBLE_P = 0.005  # the discs show a gap if its p-value is below this
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
    """The report of a diagnosis, schema gap/2."""
    judged = found.judgement
    fits = [_fit(found, fit) for fit in found.fits]
    singles = sum(len(fit.names) == 1 for fit in found.fits)  # they come first
    stated = found.limits.as_json()
    refit = found.corrected[0] if found.corrected else None
    return {
        "schema": SCHEMA,
        "sentence": sentence(found),
        "gap": {
            "before_refit_pct": found.before_refit.to_json(),
            "rms_pct": found.rms.to_json(),
            "after_pct": found.after.to_json(),
            "noise_pct": found.noise_pct,
            "p_value": found.p_value,
        },
        "where": [axis.to_json() for axis in found.where],
        "verdict": judged.verdict,
        "answer": list(judged.answer),
        "set": {"coverage": judged.coverage, "members": [list(names) for names in judged.members]},
        "hypotheses": [
            {"effects": list(names), "probability": share}
            for names, share in judged.hypotheses.items()
            if share >= LEAST_SHARE or names in judged.members
        ],
        "probabilities": dict(judged.effects),
        "limits": stated["limits"],
        "alike": stated["alike"],
        "calibration": found.calibration.to_json(),
        "effects": fits[:singles],
        "together": fits[singles:],
        "ties": [list(judged.tied)] if judged.verdict == "tie" else [],
        "would_separate": would_separate(found),
        "untestable": [{"name": name, "why": why} for name, why in found.evidence.untestable.items()],
        "looks_like": [{"form": form, "probability": share} for form, share in looks_like(judged)],
        "unknown": unknown(judged),
        "cautions": list(found.cautions),
        "expected": {
            "residual_pct": found.expected.residual_pct,
            "disc_chi2_a_cell": found.expected.disc_scale,
            "lit_chi2_a_block": found.expected.unocculted_scale,
        },
        "psf": {
            "shape": found.solution.inversion.shape.name,
            "refitted": _values(found.solution.inversion, found.model.base.covariance),
            "with_answer": refit and _values(refit.solution.inversion, refit.covariance),
        },
        "shape": list(found.solution.transit.shape),
        "images": _images(found),
        "inputs_sha256": found.solution.transit.sha256,
    }


def looks_like(judged: Judgement) -> list[tuple[str, float]]:
    """If the cause may be unknown: the patterns that the gap resembles, and their probabilities, the most probable first."""
    if UNKNOWN not in judged.members:
        return []
    forms = {order_words(orders): share for orders, share in judged.orders.items()}
    forms |= {field.words: share for field, share in judged.fields.items()}
    ordered = sorted(forms.items(), key=lambda one: -one[1])
    return [(form, share) for form, share in ordered if share >= LIKELY_ORDER]


def unknown(judged: Judgement) -> dict[str, Any] | None:
    """The most probable field of an unknown cause, with its shape; None if the answer set does not contain "unknown".

    The probabilities hold if the cause is unknown.
    """
    shape = judged.shape
    if UNKNOWN not in judged.members or shape is None:
        return None
    stages: dict[str, float] = {}
    for field, share in judged.fields.items():
        stages[field.stage] = stages.get(field.stage, 0.0) + share
    return asdict(shape.field) | {
        "stages": stages,
        "probability": judged.fields[shape.field],
        "words": shape.field.words,
        "axes": list(shape.axes),
        "at": shape.at.tolist(),
        "values": shape.values.tolist(),
        "sigma": shape.sigma.tolist(),
        "unit": shape.unit,
    }


def clearest_words(shape: FieldShape) -> str:
    """The value and the place at which a field is clearest, as text."""
    k = shape.clearest
    names = {
        "x_px": "x = {:.0f} px",
        "y_px": "y = {:.0f} px",
        "time_s": "{:.0f} s",
        "radius_px": "{:.0f} px from the centre of the PSF",
    }
    place = ", ".join(names[axis].format(at) for axis, at in zip(shape.axes, shape.at[k], strict=True))
    return f"{shape.values[k]:.2g} ± {shape.sigma[k]:.1g} {shape.unit}".rstrip() + f" at {place}"


def order_words(orders: Names) -> str:
    """A text that describes a change along these orders of the data (see `discrepancy`)."""
    if len(orders) > MOST_ORDERS:
        return "a change along many orders of the data"
    return "a change that varies with " + " and ".join(WORDS[order] for order in orders)


def fits_of(report: dict[str, Any]) -> list[dict[str, Any]]:
    """All fits of a report, in the order of display: first the fits of several effects together, then the fits of single effects."""
    return [*report["together"], *report["effects"]]


def _values(inversion: Inversion, covariance: NDArray[np.float64]) -> dict[str, Any]:
    """The parameters of the shape, with errors that contain the floor of the linear model.

    covariance: the covariance of the coordinates, from the linear model.
    """
    sigma = np.sqrt(np.diag(covariance))
    return {
        p.name: {
            "value": inversion.values[p.name],
            "sigma": float(abs(p.slope(float(at))) * s),
            "unit": p.unit,
        }
        for p, at, s in zip(inversion.shape.parameters, inversion.coordinates, sigma, strict=True)
    }


def _by_name(found: Diagnosis, names: Names) -> list[Effect]:
    effects = {effect.name: effect for effect in found.evidence.effects}
    return [effects[name] for name in names]


def _fit(found: Diagnosis, fit: EffectFit) -> dict[str, Any]:
    """The fit of one or several effects, with the parameters of their full refit if there is one."""
    shrinking, judged = found.shrinking[fit.label], found.judgement
    refit = next((one for one in found.corrected if one.label == fit.label), None)
    alone = len(fit.names) == 1
    return {
        "name": fit.label,
        "probability": judged.effects.get(fit.names[0], 0.0)
        if alone
        else judged.hypotheses.get(fit.names, 0.0),
        "parameters": {
            name: {"value": value, "sigma": sigma, "unit": unit}
            for name, (value, sigma, unit) in (refit or fit).values.items()
        },
        "p_value": fit.p_value,
        "delta_chi2": fit.gain,
        "delta_chi2_held_out": shrinking.held_out_fall,
        "closure": shrinking.closure and shrinking.closure.to_json(),
        "closure_by_pointing": shrinking.closure_by_pointing and shrinking.closure_by_pointing.to_json(),
        "refitted": refit is not None,
        "cause": " ".join(effect.cause for effect in _by_name(found, fit.names)),
    }


def _images(found: Diagnosis) -> list[dict[str, Any]]:
    """The disc of every image: its position, its brightness, and its held-out residuals without and with the named effects."""
    before, after = _residuals(found.residual), _residuals(found.residual_after)
    out = []
    for disc in found.evidence.discs:
        taken = found.evidence.image_info[disc.index]
        residual, noise = before.get(disc.index, (None, None))
        residual_after, noise_after = after.get(disc.index, (None, None))
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
                "residual_pct": residual,
                "noise_pct": noise,
                "residual_after_pct": residual_after,
                "noise_after_pct": noise_after,
            }
        )
    return out


def _residuals(held_out: HeldOut | None) -> dict[int, tuple[float, float]]:
    """The residual and the noise of each held-out image, in percent, by the number of the image."""
    if held_out is None:
        return {}
    percents = zip(held_out.residual_pct.tolist(), held_out.noise_pct.tolist(), strict=True)
    return dict(zip(held_out.images, percents, strict=True))


def would_separate(found: Diagnosis) -> str:
    """The observations that would separate the tied effects, as text; empty for other verdicts."""
    if found.judgement.verdict != "tie":
        return ""
    return "; ".join(dict.fromkeys(effect.settled_by for effect in _by_name(found, found.judgement.tied)))


def sentence(found: Diagnosis) -> str:
    """The summary of a diagnosis: two to four sentences."""
    judged = found.judgement
    images = len(found.evidence.discs)
    left = f"{found.rms.value:.1f} % ({found.rms.low:.1f} to {found.rms.high:.1f})"
    probable = f"with a probability of {percent_words(judged.effects['none'])} there is none"
    if judged.members[0] == NONE:
        if found.residual is None:
            return (
                f"No gap is visible in these {images} images ({probable}), but a gap may exist. With fewer than {LEAST_IMAGES} images, no "
                "image can be held out, and only a large gap can be excluded."
            )
        return (
            f"No gap beyond noise and the error of the fit was found: {probable}; on held-out images the gap is {left}, and the noise is "
            f"{found.noise_pct:.1f} %.{_not_excluded(judged)}"
        )
    strongest = found.where[0]
    numbers = strongest.at.get("pointings", [])
    where = f"pointing{'s' if len(numbers) > 1 else ''} {' and '.join(map(str, numbers))}"
    lead = f"There is a gap of {left}. It varies most {AXIS_WORDS[strongest.name]} and is largest in {where}."
    if found.rms.value < found.noise_pct and _unocculted_alone(found):
        lead = (
            f"There is a gap in the unocculted field, and it varies most {AXIS_WORDS[strongest.name]}. The discs do not show it "
            f"(the gap in the discs is {left})."
        )
    if judged.verdict == "unknown":
        like = looks_like(judged)
        close = f"; it most resembles {like[0][0]}" if like else ""
        if judged.shape is not None and like and like[0][0] == judged.shape.field.words:
            close += f" ({clearest_words(judged.shape)})"
        return f"{lead} Its cause is not in the library{close}."
    if judged.verdict == "tie":
        return (
            f"{lead} These data cannot show which effect causes the gap: {tied_words(judged)}. To separate these effects, take "
            f"{would_separate(found)}."
        )
    if judged.verdict == "inconclusive":
        return (
            f"{lead if NONE not in judged.members else 'There may be a gap.'} These data do not decide its cause: "
            f"{_listed(judged.members, judged)}."
        )
    return f"{lead} {_explained(found)}.{_not_excluded(judged)}"


def _not_excluded(judged: Judgement) -> str:
    """A sentence about the hypotheses in the answer set that the verdict does not name; empty if there are none."""
    decided = 1 if judged.verdict == "none" else len(judged.deciding)
    others = judged.members[decided:]
    return f" These data do not exclude {_listed(others, judged)}." if others else ""


def _listed(members: Sequence[Names], judged: Judgement) -> str:
    """Hypotheses with their probabilities, as text; at most MOST_LISTED, the most probable first."""
    shown = [
        f"{hypothesis_words(names)} ({percent_words(judged.hypotheses[names])})"
        for names in members[:MOST_LISTED]
    ]
    more = len(members) - len(shown)
    rest = [f"{more} other{'s' if more > 1 else ''} of smaller probability"] if more else []
    *first, last = [*shown, *rest]
    return f"{', '.join(first)} or {last}" if first else last


def hypothesis_words(names: Names) -> str:
    """A hypothesis as text."""
    fixed = {NONE: "no gap", UNKNOWN: "a cause outside the library"}
    return fixed.get(names) or " together with ".join(map(words, names))


def percent_words(share: float) -> str:
    """A probability as text. The text never says 0 % or 100 %."""
    percent = 100 * share
    if percent >= 99.5:
        return "> 99 %"
    return "< 1 %" if percent < 0.5 else f"{percent:.0f} %"


def _unocculted_alone(found: Diagnosis) -> bool:
    """Whether the blocks of the unocculted field show a gap, but the cells of the discs do not."""
    model = found.model
    cells, blocks = left_chi2(model, model.base)
    freedom = sum(disc.residual.size for disc in model.discs)
    free_blocks = model.evidence.steady_unocculted.freedom
    return bool(chdtrc(freedom, cells) > VISIBLE_P > chdtrc(free_blocks, max(blocks, 0.0)))


def _explained(found: Diagnosis) -> str:
    judged = found.judgement
    best = next(fit for fit in found.fits if fit.names == judged.best)
    values = found.corrected[0].values if found.corrected else best.values
    numbers = [
        f"{words(name)} {value:.3g} ± {sigma:.2g} {unit}".strip()
        for name, (value, sigma, unit) in values.items()
    ]
    in_short = in_short_if_many([value for value, _, _ in values.values()])
    # If the discs do not show the gap, the gap in the discs can only change within the noise.
    shrinks = "falls" if found.after.value < found.rms.value else "changes"
    return (
        f"The gap is explained by {words(best.label)} ({in_short or ', '.join(numbers)}), with a probability of "
        f"{percent_words(judged.hypotheses[best.names])}: on held-out images the gap in the discs {shrinks} from "
        f"{found.rms.value:.1f} % to {found.after.value:.1f} %, and the noise is {found.noise_pct:.1f} %"
    )


def tied_words(judged: Judgement) -> str:
    """The text for a tie: the effects that the data cannot separate, and the effects that all deciding members contain, if any."""
    among = " or ".join(words(name) for name in judged.tied)
    beside = " and ".join(words(name) for name in judged.certain)
    alone = " alone or" if any(set(names) == set(judged.certain) for names in judged.named) else ""
    return f"{beside},{alone} together with {among}" if beside else among


def in_short_if_many(values: Sequence[float]) -> str | None:
    """A summary of parameters if there are more than MOST_READ; otherwise None."""
    if len(values) <= MOST_READ:
        return None
    return f"{len(values)} parameters, root sum of squares {float(np.linalg.norm(values)):.2g}"


def words(name: str) -> str:
    """The name of an effect or parameter, with spaces, for text."""
    return name.replace("_", " ")


def best_words(found: Diagnosis) -> str:
    """The effects of the first full refit, as text."""
    return " + ".join(words(effect.name) for effect in found.corrected[0].effects)
