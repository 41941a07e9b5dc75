"""The gap report as JSON (schema gap/3), and its three lines: where the gap lies, which cause explains it, and how far
it shrinks.

The told causes are the most probable alternatives of each cause of the answer (`verdict.answer`), without the Sun.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from psfcore.drawing.numbers import with_error
from psfcore.gap.diagnose import Diagnosis, Shrinking
from psfcore.gap.evidence.columns import FieldShape, another
from psfcore.gap.evidence.effect_fits import EffectFit, left_chi2
from psfcore.gap.evidence.tree import FAMILIES, SUN, family_of, listed
from psfcore.gap.schema import CauseJson, FieldJson, FitJson, GapReport, IntervalJson, ParameterJson
from psfcore.gap.verdict.answer import LEAST_IMAGES, Alternative, Cause
from psfcore.gap.verdict.axes import SIGNIFICANT
from psfcore.gap.verdict.closure import HeldOut, Interval
from psfcore.scatter.reconstruction import Inversion

SCHEMA = "gap/3"
MOST_READ = 12  # if an effect has more parameters, the report summarises them
LEAST_SHARE = 1e-3  # hypotheses and labels with a smaller probability are not listed
LEAST_SHARE_OF_AXIS = 0.1  # an axis with a smaller share is not part of the first line
MOST_AXES, MOST_LIMITS = 3, 3
CLEAR = 2.0  # errors: the place of a field is told if its value there is larger
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


def gap_report(found: Diagnosis) -> GapReport:
    """The report of a diagnosis, schema gap/3."""
    answer, stated, lines = found.answer, found.limits.as_json(), three_lines(found)
    several = found.told is not None and found.told.label not in found.fits
    where, which, how_far = (line.partition(": ")[2] for line in lines)
    return {
        "schema": SCHEMA,
        "lines": lines,
        "sentence": f"{where[0].upper()}{where[1:]} Cause: {which} {how_far[0].upper()}{how_far[1:]}",
        "gap": {
            "before_refit_pct": found.before_refit.to_json(),
            "rms_pct": found.rms.to_json(),
            "after_pct": found.after.to_json(),
            "noise_pct": found.noise_pct,
            "p_value": found.p_value,
        },
        "where": [axis.to_json() for axis in found.where],
        "verdict": answer.verdict,
        "answer": list(answer.named),
        "level": answer.level,
        "causes": [_cause(found, cause) for cause in answer.causes],
        "closure": None if found.shrinking_of_told is None else _interval(found.shrinking_of_told.closure),
        "would_separate": would_separate(found),
        "hypotheses": [
            {
                "causes": [{"family": one, "effect": effect} for one, effect in sorted(labels, key=str)],
                "probability": share,
            }
            for labels, share in answer.hypotheses.items()
            if share >= LEAST_SHARE
        ],
        "probabilities": {"none": answer.none, **_probabilities(found)},
        "limits": stated["limits"],
        "alike": stated["alike"],
        "calibration": found.calibration.to_json(answer.level),
        "effects": [_fit(found, fit, found.shrinking[name]) for name, fit in found.fits.items()],
        "together": [_fit(found, found.told, found.shrinking_of_told)] if several and found.told else [],
        "untestable": [{"name": name, "why": why} for name, why in found.evidence.untestable.items()],
        "cautions": list(found.cautions),
        "expected": {
            "residual_pct": found.expected.residual_pct,
            "disc_chi2_a_cell": found.expected.disc_scale,
            "lit_chi2_a_block": found.expected.unocculted_scale,
        },
        "psf": {
            "shape": found.solution.inversion.shape.name,
            "refitted": _values(found.solution.inversion, found.model.base.covariance),
            "with_answer": None
            if found.corrected is None
            else _values(found.corrected.solution.inversion, found.corrected.covariance),
        },
        "shape": list(found.solution.transit.shape),
        "images": _images(found),
        "inputs_sha256": found.solution.transit.sha256,
    }


def _probabilities(found: Diagnosis) -> dict[str, float]:
    """The probability that each effect acts, and each other form of a family."""
    return {
        effect or another(family): share
        for (family, effect), share in found.answer.labels.items()
        if share >= LEAST_SHARE or effect is not None
    }


def _cause(found: Diagnosis, cause: Cause) -> CauseJson:
    """One cause of the answer, as JSON."""
    first = cause.alternatives[0]
    shape = found.shapes.get(first.family.name)
    alone = len(found.answer.causes) == 1 and found.shrinking_of_told is not None
    return {
        "level": cause.level,
        "words": cause_words(cause),
        "alternatives": [
            {
                "stage": one.stage,
                "family": one.family.name,
                "effect": one.effect,
                "probability": one.probability,
                "words": one.words,
            }
            for one in cause.alternatives
        ],
        "field": None if shape is None or not shape.axes else _shape(shape, first),
        "closure": _interval(found.shrinking_of_told.closure) if alone and found.shrinking_of_told else None,
    }


def _shape(shape: FieldShape, of: Alternative) -> FieldJson:
    """The map or the curve of a field, as JSON."""
    k = shape.clearest
    told: FieldJson = {
        "words": of.family.words,
        "unit": shape.unit,
        "strength": {"value": float(shape.values[k]), "sigma": float(shape.sigma[k])},
    }
    if shape.axes == ("x_px", "y_px"):
        x_px, y_px = (np.unique(along) for along in shape.at.T)
        values, sigma = (part.reshape(y_px.size, x_px.size).tolist() for part in (shape.values, shape.sigma))
        return {
            **told,
            "map": {"x_px": x_px.tolist(), "y_px": y_px.tolist(), "value": values, "sigma": sigma},
        }
    at = {shape.axes[0]: shape.at[:, 0].tolist()}
    return {**told, "curve": at | {"value": shape.values.tolist(), "sigma": shape.sigma.tolist()}}


def fits_of(report: GapReport) -> list[FitJson]:
    """All fits of a report, in the order of display: first the told causes together, then single effects."""
    return [*report["together"], *report["effects"]]


def _interval(interval: Interval | None) -> IntervalJson | None:
    return None if interval is None else interval.to_json()


def _values(inversion: Inversion, covariance: NDArray[np.float64]) -> dict[str, ParameterJson]:
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


def _fit(found: Diagnosis, fit: EffectFit, shrinking: Shrinking | None) -> FitJson:
    """The fit of one or several causes, with the parameters of their full refit if there is one."""
    refit = found.corrected if found.corrected is not None and found.corrected.label == fit.label else None
    causes = {effect.name: effect.cause for effect in fit.model.evidence.effects}
    probabilities = _probabilities(found)
    return {
        "name": fit.label,
        "words": cause_names(fit),
        "probability": min(probabilities.get(name, 0.0) for name in fit.names),
        "parameters": {
            name: {"value": value, "sigma": sigma, "unit": unit}
            for name, (value, sigma, unit) in (refit or fit).values.items()
        },
        "p_value": fit.p_value,
        "delta_chi2": fit.gain,
        "delta_chi2_held_out": None if shrinking is None else shrinking.held_out_fall,
        "closure": None if shrinking is None else _interval(shrinking.closure),
        "closure_by_pointing": None if shrinking is None else _interval(shrinking.closure_by_pointing),
        "refitted": refit is not None,
        "cause": " ".join(causes[name] for name in fit.names),
    }


def _images(found: Diagnosis) -> list[dict[str, Any]]:
    """The disc of every image: its position, its brightness, and its held-out residuals without and with the told
    causes.
    """
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
    """The observations that would separate the alternatives of the causes, as text; empty if every cause has one
    alternative.
    """
    settled_by = {effect.name: effect.settled_by for effect in found.evidence.effects}
    observations = [
        settled_by[one.effect] if one.effect is not None else one.family.settled_by
        for cause in found.answer.causes
        if len(cause.alternatives) > 1
        for one in cause.alternatives
    ]
    return listed(observations)


# --- the three lines --------------------------------------------------------------------------------------


def three_lines(found: Diagnosis) -> list[str]:
    """WHERE the gap lies, WHICH cause explains it, and HOW FAR it shrinks with it; or that these data cannot say."""
    if not found.answer.causes:
        return [f"WHERE: {_nowhere(found)}", f"WHICH: {_nothing(found)}", f"HOW FAR: {_weaker(found)}"]
    return [f"WHERE: {_where(found)}", f"WHICH: {_which(found)}", f"HOW FAR: {_how_far(found)}"]


def _nowhere(found: Diagnosis) -> str:
    images = len(found.evidence.discs)
    if found.residual is None:
        return (
            f"no gap is visible in these {images} images, but a gap may exist: with fewer than {LEAST_IMAGES} "
            "images, no image can be held out."
        )
    return (
        f"no gap is detected: on held-out images the discs differ from the model by {_gap_words(found)} beyond the "
        f"noise of {found.noise_pct:.1f} %."
    )


def _nothing(found: Diagnosis) -> str:
    likeliest = [
        f"; the most probable cause is {label_words(*label)} ({percent_words(share)})"
        for label, share in list(found.answer.labels.items())[:1]
    ]
    return f"no cause; the probability of none is {percent_words(found.answer.none)}{''.join(likeliest)}."


def _weaker(found: Diagnosis) -> str:
    told = [
        f"{words(name)} above {one.leading.excluded_95:.2g} {one.leading.unit}".rstrip()
        for name, one in found.limits.effects.items()
        if one.leading.excluded_95 is not None and one.leading.found_90 is not None
    ]
    if not told:
        return "these data exclude no effect."
    return f"these data exclude (95 %) {', '.join(told[:MOST_LIMITS])}; the limits of all effects are in the report."


def _gap_words(found: Diagnosis) -> str:
    return f"{found.rms.value:.1f} % ({found.rms.low:.1f} to {found.rms.high:.1f})"


def _where(found: Diagnosis) -> str:
    if shown_by_blocks(found):
        _, blocks = found.answer.closed.chi2_left([])
        lead = (
            f"a gap in the unocculted field, whose images differ by {np.sqrt(blocks):.1f} times their noise; the "
            "discs do not show it"
        )
    else:
        lead = f"a gap of {_gap_words(found)} in the discs"
    axes = [axis for axis in found.where if axis.p_value <= SIGNIFICANT and axis.share >= LEAST_SHARE_OF_AXIS]
    axes = sorted(axes, key=lambda axis: -axis.share)[:MOST_AXES]
    told = ", ".join(f"{AXIS_WORDS[axis.name]} ({100 * axis.share:.0f} %)" for axis in axes)
    families = (cause.alternatives[0].family.name for cause in found.answer.causes)
    place = next((_place(found.shapes[one]) for one in families if one in found.shapes), "")
    varies = f"; it varies {told}" if told else "" if place else "; it varies along no single axis"
    numbers = axes[0].at.get("pointings", []) if axes else []
    largest = (
        f", and is largest in pointing{'s' if len(numbers) > 1 else ''} {' and '.join(map(str, numbers))}"
    )
    return f"{lead}{varies}{largest if numbers and told else ''}{place}."


def _place(shape: FieldShape) -> str:
    """Where a field is clearest, as the end of a sentence; empty if it has no shape, or if it is clear nowhere."""
    if not shape.axes or abs(shape.values[shape.clearest]) < CLEAR * shape.sigma[shape.clearest]:
        return ""
    only = " (known only near the discs)" if "x_px" in shape.axes else ""
    return f"; the change is clearest with {clearest_words(shape)}{only}"


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
    return (
        f"{with_error(float(shape.values[k]), float(shape.sigma[k]))} {shape.unit}".rstrip() + f" at {place}"
    )


def _which(found: Diagnosis) -> str:
    first, *others = found.answer.causes
    out = cause_words(first, _numbers(found, first))
    for cause in others:
        out += f"; beside it {cause_words(cause, _numbers(found, cause))}"
    observation = would_separate(found)
    if observation:
        out += f". These data cannot separate them; to separate them, take {observation}"
    return f"{out}."


def _numbers(found: Diagnosis, cause: Cause) -> str:
    """The fitted parameters of the first alternative, as text; empty if it has none, or too many."""
    name = cause.alternatives[0].effect
    if name is None or name == SUN or found.told is None:
        return ""
    own = {
        label.removeprefix(f"{name}."): value
        for label, value in (found.corrected or found.told).values.items()
        if len(found.told.names) == 1 or label.startswith(f"{name}.")
    }
    if not own or len(own) > MOST_READ:
        return ""
    return ", ".join(
        f"{words(label)} {v:.3g} ± {sigma:.2g} {unit}".strip() for label, (v, sigma, unit) in own.items()
    )


def _how_far(found: Diagnosis) -> str:
    told, shrinking = found.told, found.shrinking_of_told
    if told is None or shrinking is None:
        return "a changing Sun has no form that could be taken out of the images; the fit of the PSF is not changed."
    closure = shrinking.closure
    if found.residual is None:
        return "these data cannot say: no image can be held out."
    if closure is None:
        return "these data cannot say: too few images are left to fit the causes, or the held-out images show no gap."
    out = f"in the model, {cause_names(told)} closes {_closure_words(closure)} of the gap on held-out images"
    others = [
        f"{words(name)} closes {_closure_words(other)}"
        for name in found.answer.causes[0].effects
        if name not in told.names
        and name in found.shrinking
        and (other := found.shrinking[name].closure) is not None
    ]
    out += "".join(f"; {other}" for other in others)
    if shown_by_blocks(found):
        return f"{out}."
    verb = "falls" if found.after.value < found.rms.value else "changes"
    return (
        f"{out}; the gap in the discs {verb} from {found.rms.value:.1f} % to {found.after.value:.1f} %, with a "
        f"noise of {found.noise_pct:.1f} %."
    )


def _closure_words(closure: Interval) -> str:
    value, low, high = (round(100 * one) + 0 for one in (closure.value, closure.low, closure.high))
    return f"{max(value, 0)} % ({'less than 0' if low < 0 else low} to {max(high, 0)})"


def cause_names(told: EffectFit) -> str:
    """The told causes as text."""
    causes = {effect.name: family_of(effect) for effect in told.model.evidence.effects}
    return " with ".join(
        label_words(causes[name], None if name == another(causes[name]) else name) for name in told.names
    )


def label_words(family: str, effect: str | None) -> str:
    """A label as text."""
    return Alternative(FAMILIES[family], effect, 0.0).words


def cause_words(cause: Cause, numbers: str = "") -> str:
    """A cause as text: its alternatives with their probabilities, and the level at which it is sure."""
    shown = []
    for k, one in enumerate(cause.alternatives):
        own = f"{numbers}; " if numbers and k == 0 else ""
        form = f"{one.family.words}, in a form that the library does not have"
        shown.append(f"{words(one.effect) if one.effect else form} ({own}{percent_words(one.probability)})")
    *first, last = shown
    told = f"{', '.join(first)} or {last}" if first else last
    if cause.level == "stage":
        told += f", all in the {cause.alternatives[0].stage}"
    return told


def shown_by_blocks(found: Diagnosis) -> bool:
    """Whether the blocks of the unocculted field show a gap, but the discs and their cells do not."""
    model = found.model
    cells, blocks = left_chi2(model, model.base)
    p_discs = chdtrc(sum(disc.residual.size for disc in model.discs), cells)
    p_blocks = chdtrc(model.evidence.all_unocculted.independent, max(blocks, 0.0))
    return bool(found.rms.value < found.noise_pct and p_discs > VISIBLE_P > p_blocks)


def p_words(p_value: float) -> str:
    """A p-value as text. The text never says 0."""
    return f"{p_value:.2g}" if p_value > 1e-300 else "< 1e-300"


def percent_words(share: float) -> str:
    """A probability as text. The text never says 0 % or 100 %."""
    percent = 100 * share
    if percent >= 99.5:
        return "> 99 %"
    return "< 1 %" if percent < 0.5 else f"{percent:.0f} %"


def in_short_if_many(values: Sequence[float]) -> str | None:
    """A summary of parameters if there are more than MOST_READ; otherwise None."""
    if len(values) <= MOST_READ:
        return None
    return f"{len(values)} parameters, root sum of squares {float(np.linalg.norm(values)):.2g}"


def words(name: str) -> str:
    """The name of an effect or parameter, with spaces, for text."""
    return name.replace("_", " ")
