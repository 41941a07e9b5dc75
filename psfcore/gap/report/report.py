"""The gap report as JSON (schema gap/2), and its summary sentence.

The named effects are those that the verdict names as the cause of the gap. The report lists them under "answer".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.evidence.effect_fits import left_chi2
from psfcore.gap.evidence.fields import UNKNOWN as UNKNOWN_NAME
from psfcore.gap.evidence.fields import Field, FieldShape
from psfcore.gap.verdict.closure import HeldOut
from psfcore.gap.verdict.posterior import NONE, Form, Names, known_effects
from psfcore.gap.verdict.unknown import UnknownField
from psfcore.gap.verdict.verdict import LEAST_IMAGES, Judgement
from psfcore.scatter.reconstruction import Inversion

SCHEMA = "gap/2"
MOST_READ = 12  # if an effect has more parameters, the report summarises them
LEAST_SHARE = 1e-3  # hypotheses with a smaller probability are not listed
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
    fits = [(form, _fit(found, form)) for form in found.fits]
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
        "effects": [fit for form, fit in fits if len(form.effects) == 1 and form.field is None],
        "together": [fit for form, fit in fits if len(form.effects) > 1 or form.field is not None],
        "ties": [list(judged.tied)] if judged.verdict == "tie" else [],
        "would_separate": would_separate(found),
        "untestable": [{"name": name, "why": why} for name, why in found.evidence.untestable.items()],
        "unknown": unknown(found),
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


def unknown(found: Diagnosis) -> dict[str, Any]:
    """The unknown cause: its probability, its most probable fields if it is in the answer set, and the bounds of all fields.

    The probability of a field holds if an unknown cause acts.
    """
    return {
        "probability": found.judgement.effects[UNKNOWN_NAME],
        "fields": [_field(found, one) for one in found.unknown],
        "excluded_95": [
            _kind(field) | {"strength": strength, "unit": unit}
            for field, (strength, unit) in found.bounds.items()
            if math.isfinite(strength)
        ],
    }


def _kind(field: Field) -> dict[str, Any]:
    told = {"stage": field.stage, "form": field.form, "width": field.width}
    return told if field.pointing is None else told | {"pointing": field.pointing}


def _field(found: Diagnosis, one: UnknownField) -> dict[str, Any]:
    shape, shrinking = one.shape, found.shrinking.get(one.form)
    axes: dict[str, Any] = {}
    if shape.axes == ("x_px", "y_px"):
        x_px, y_px = (np.unique(along) for along in shape.at.T)
        grid = y_px.size, x_px.size
        values, sigma = (part.reshape(grid).tolist() for part in (shape.values, shape.sigma))
        axes = {"map": {"x_px": x_px.tolist(), "y_px": y_px.tolist(), "value": values, "sigma": sigma}}
    elif shape.axes:
        (axis,) = shape.axes
        at = shape.at[:, 0].tolist()
        axes = {"curve": {axis: at, "value": shape.values.tolist(), "sigma": shape.sigma.tolist()}}
    value = one.strength
    return {
        **_kind(one.field),
        "beside": list(one.beside),
        "unit": shape.unit,
        "probability": one.probability,
        "words": one.field.words,
        "strength": None if value is None else dict(zip(("value", "sigma"), value, strict=True)),
        **axes,
        "closure": shrinking and shrinking.closure and shrinking.closure.to_json(),
        "resembles": [{"effect": name, "distance": distance} for name, distance in one.resembles],
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


def _fit(found: Diagnosis, form: Form) -> dict[str, Any]:
    """The fit of one or several effects, with the parameters of their full refit if there is one."""
    fit, shrinking, judged = found.fits[form], found.shrinking[form], found.judgement
    refit = next((one for one in found.corrected if one.label == fit.label), None)
    alone = len(fit.names) == 1 and form.field is None
    effects = {effect.name: effect for effect in fit.model.evidence.effects}
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
        "cause": " ".join(effects[name].cause for name in fit.names),
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
    """The observations that would separate the tied effects, or decide an inconclusive verdict, as text; empty for other verdicts."""
    judged = found.judgement
    open_effects: Names = judged.tied
    if judged.verdict == "inconclusive":
        open_effects = tuple(dict.fromkeys(name for names in judged.named for name in names))
    settled_by = {effect.name: effect.settled_by for effect in found.evidence.effects}
    return "; or ".join(dict.fromkeys(settled_by[name] for name in known_effects(open_effects)))


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
    along = AXIS_WORDS[strongest.name] + (", as the best effect does" if strongest.of_best else "")
    numbers = strongest.at.get("pointings", [])
    where = f"pointing{'s' if len(numbers) > 1 else ''} {' and '.join(map(str, numbers))}"
    comma = "," if strongest.of_best else ""
    lead = f"There is a gap of {left}. It varies most {along}{comma} and is largest in {where}."
    if _shown_by_blocks(found):
        lead = f"There is a gap in the unocculted field. It varies most {along}. The discs do not show it."
    if judged.verdict == "unknown":
        return f"{lead} Its cause is not in the library{_unknown_words(found)}."
    if judged.verdict == "tie":
        return (
            f"{lead} These data cannot show which effect causes the gap: {tied_words(judged)}. To separate these effects, take "
            f"{would_separate(found)}."
        )
    if judged.verdict == "inconclusive":
        observation = would_separate(found)
        return (
            f"{lead if NONE not in judged.members else 'There may be a gap.'} These data do not decide its cause: "
            f"{_listed(judged.members, judged)}.{observation and f' To decide, take {observation}.'}"
        )
    return f"{lead} {_explained(found)}.{_not_excluded(judged)}"


def _unknown_words(found: Diagnosis) -> str:
    """The most probable field of an unknown cause, as the end of a sentence."""
    if not found.unknown:
        return ""
    first = found.unknown[0]
    at = f" ({clearest_words(first.shape)})" if first.shape.axes else ""
    return f"; it most resembles {first.field.words}{at}"


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
    if names == NONE:
        return "no gap"
    return " together with ".join(
        "a cause outside the library" if name == UNKNOWN_NAME else words(name) for name in names
    )


def p_words(p_value: float) -> str:
    """A p-value as text. The text never says 0."""
    return f"{p_value:.2g}" if p_value > 1e-300 else "< 1e-300"


def percent_words(share: float) -> str:
    """A probability as text. The text never says 0 % or 100 %."""
    percent = 100 * share
    if percent >= 99.5:
        return "> 99 %"
    return "< 1 %" if percent < 0.5 else f"{percent:.0f} %"


def _shown_by_blocks(found: Diagnosis) -> bool:
    """Whether the blocks of the unocculted field show a gap, but the discs and their cells do not."""
    model = found.model
    if found.rms.value >= found.noise_pct:
        return False
    cells, blocks = left_chi2(model, model.base)
    freedom = sum(disc.residual.size for disc in model.discs)
    free_blocks = model.evidence.steady_unocculted.freedom
    return bool(chdtrc(freedom, cells) > VISIBLE_P > chdtrc(free_blocks, max(blocks, 0.0)))


def _explained(found: Diagnosis) -> str:
    judged = found.judgement
    best = found.fits[judged.form(judged.named[0])]
    values = found.corrected[0].values if found.corrected else best.values
    numbers = [
        f"{words(name)} {value:.3g} ± {sigma:.2g} {unit}".strip()
        for name, (value, sigma, unit) in values.items()
    ]
    in_short = in_short_if_many([value for value, _, _ in values.values()])
    told = (
        f"The gap is explained by {words(best.label)} ({in_short or ', '.join(numbers)}), with a probability of "
        f"{percent_words(judged.hypotheses[judged.named[0]])}"
    )
    closure = found.shrinking[judged.form(judged.named[0])].closure
    if _shown_by_blocks(found):
        return (
            told
            if closure is None
            else f"{told}; on held-out images it closes {100 * closure.value:.0f} % of the gap"
        )
    shrinks = "falls" if found.after.value < found.rms.value else "changes"
    return (
        f"{told}: on held-out images the gap in the discs {shrinks} from "
        f"{found.rms.value:.1f} % to {found.after.value:.1f} %, and the noise is {found.noise_pct:.1f} %"
    )


def tied_words(judged: Judgement) -> str:
    """The text for a tie: the effects that the data cannot separate, and the effects that all deciding members contain, if any."""
    among = " or ".join(hypothesis_words((name,)) for name in judged.tied)
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
