"""The gap report as JSON (schema gap/3), and its three lines: where the gap lies, which cause explains it, and how far
it shrinks.

The told causes are the most probable alternatives of each cause of the answer (`verdict.answer`), without the Sun.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from psfcore.gap.verdict.axes import SIGNIFICANT, Axis
from psfcore.gap.verdict.closure import HeldOut, Interval
from psfcore.scatter.reconstruction import Inversion

SCHEMA = "gap/3"
MOST_READ = 12  # if an effect has more parameters, the table summarises them
MOST_TOLD = 3  # parameters of an effect in the second line
LEAST_SHARE = 1e-3  # hypotheses and labels with a smaller probability are not listed
LEAST_SHARE_OF_AXIS = 0.05  # an axis with a smaller share is not part of the first line
MOST_AXES, MOST_LIMITS = 3, 3
# The fewest pointings with at least this share of the gap are told: one, or two.
LARGEST = (0.6, 0.8)
ALL = 0.995  # a closure that is written as 100 %
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
        "unocculted": unocculted_size(found).to_json(),
        "where": [axis.to_json() for axis in found.where],
        "verdict": answer.verdict,
        "answer": list(answer.named),
        "level": answer.level,
        "causes": [_cause(found, cause) for cause in answer.causes],
        "closure": None if found.shrinking_of_told is None else _interval(found.shrinking_of_told.closure),
        "would_separate": would_separate(found),
        "would_confirm": would_confirm(found),
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

    Parameters
    ----------
    covariance
        The covariance of the coordinates, from the linear model.
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
    nothing = (None, None, None)
    before, after = _residuals(found.residual), _residuals(found.residual_after)
    out = []
    for disc in found.evidence.discs:
        taken = found.evidence.image_info[disc.index]
        residual, noise, unocculted = before.get(disc.index, nothing)
        residual_after, noise_after, unocculted_after = after.get(disc.index, nothing)
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
                "unocculted": unocculted,
                "unocculted_after": unocculted_after,
            }
        )
    return out


def _residuals(held_out: HeldOut | None) -> dict[int, tuple[float, float, float | None]]:
    """Three numbers of each held-out image, by the number of the image: the residual and the noise of its disc, in
    percent, and the residual of its unocculted field, in units of the noise (None if it has no blocks).
    """
    if held_out is None:
        return {}
    chi2, expected = held_out.unocculted_chi2.tolist(), held_out.unocculted_expected.tolist()
    blocks = [float(np.sqrt(a / b)) if b > 0 else None for a, b in zip(chi2, expected, strict=True)]
    numbers = zip(held_out.residual_pct.tolist(), held_out.noise_pct.tolist(), blocks, strict=True)
    return dict(zip(held_out.images, numbers, strict=True))


@dataclass(frozen=True)
class UnoccultedSize:
    """The gap in the unocculted field.

    Attributes
    ----------
    before, after
        The rms residual of the blocks of the field in held-out images, in units of the noise, without and with the told
        causes; 1 if only noise remains, None if no image can be held out.
    noise_pct
        The median noise of a block, in percent of its light.
    shows_the_gap
        Whether the unocculted field shows the gap and the discs do not.
    """

    before: float | None
    after: float | None
    noise_pct: float
    shows_the_gap: bool

    def to_json(self) -> dict[str, object]:
        """The size as JSON, for the gap report."""
        return {
            "residual": self.before,
            "residual_after": self.after,
            "noise_pct": self.noise_pct,
            "shows_the_gap": self.shows_the_gap,
        }


def unocculted_size(found: Diagnosis) -> UnoccultedSize:
    """The gap in the unocculted field, without and with the told causes."""

    def rms(held_out: HeldOut | None) -> float | None:
        if held_out is None or held_out.unocculted_expected.sum() <= 0:
            return None
        return float(np.sqrt(held_out.unocculted_chi2.sum() / held_out.unocculted_expected.sum()))

    blocks = found.evidence.unocculted
    noise = np.sqrt(blocks.variance[blocks.free]) / np.maximum(np.abs(blocks.means[blocks.free]), 1e-300)
    noise_pct = 100 * float(np.median(noise)) if noise.size else 0.0
    shows = bool(found.answer.causes) and shown_by_blocks(found)
    return UnoccultedSize(rms(found.residual), rms(found.residual_after), noise_pct, shows)


def would_separate(found: Diagnosis) -> str:
    """The observations that would separate the alternatives of the causes, as text; empty if every cause has one
    alternative, or if no observation is known.
    """
    several = [
        one for cause in found.answer.causes if len(cause.alternatives) > 1 for one in cause.alternatives
    ]
    return listed(_settled_by(found, one) for one in several)


def would_confirm(found: Diagnosis) -> str:
    """The observations that would confirm the causes with one alternative, as text; empty if there is no such cause, or
    if no observation is known.
    """
    single = [cause.alternatives[0] for cause in found.answer.causes if len(cause.alternatives) == 1]
    return "; and ".join(dict.fromkeys(filter(None, (_settled_by(found, one) for one in single))))


def _settled_by(found: Diagnosis, one: Alternative) -> str:
    """The observation that would confirm or exclude an alternative; empty if none is known."""
    of_effects = {effect.name: effect.settled_by for effect in found.evidence.effects}
    return of_effects.get(str(one.effect), one.family.settled_by)


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
    what = "no gap is detected" if found.rms.low <= 0 else "no cause of a gap is detected"
    return (
        f"{what}: on held-out images the discs differ from the model by {_gap_words(found.rms)} beyond the "
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
        f"{words(name)} ({words(one.name)} above {one.excluded_95:.2g} {unit_words(one.unit)}".rstrip() + ")"
        for name, one in ((name, each.leading) for name, each in found.limits.effects.items())
        if one.excluded_95 is not None and one.found_90 is not None
    ]
    if not told:
        return "these data exclude no effect."
    return f"these data exclude (95 %) {', '.join(told[:MOST_LIMITS])}; the limits of all effects are in the report."


def _gap_words(gap: Interval) -> str:
    return f"{gap.value:.1f} % ({gap.low:.1f} to {gap.high:.1f})"


def _where(found: Diagnosis) -> str:
    size = unocculted_size(found)
    if size.shows_the_gap:
        lead = (
            f"a gap in the unocculted field{_times_words(size)}; the discs show none, {_gap_words(found.rms)}"
        )
    else:
        lead = f"a gap of {_gap_words(found.rms)} in the discs"
    families = (cause.alternatives[0].family.name for cause in found.answer.causes)
    place = next((_place(found.shapes[one]) for one in families if one in found.shapes), "")
    varies = axes_words(found.where) or ("" if place else "; it varies along no single axis")
    return f"{lead}{varies}{_largest(found, size.shows_the_gap)}{place}."


def _times_words(size: UnoccultedSize) -> str:
    """The size of a gap in the unocculted field, as the end of a sentence; empty if no image can be held out."""
    if size.before is None:
        return ""
    return (
        f", whose blocks differ between the images of a pointing by {size.before:.1f} times their noise of "
        f"{size.noise_pct:.2g} %"
    )


def axes_words(where: Sequence[Axis]) -> str:
    """Along which axes a gap varies, as the end of a sentence; empty if it varies significantly along none.

    If an axis that is not significant has a larger share than all of these, the text says so: the axes of a transit
    vary together, and the share alone does not tell which of them the gap follows.
    """
    told = [axis for axis in where if axis.p_value <= SIGNIFICANT and axis.share >= LEAST_SHARE_OF_AXIS]
    told = sorted(told, key=lambda axis: -axis.share)[:MOST_AXES]
    if not told:
        return ""
    *others, last = (f"{AXIS_WORDS[axis.name]} ({100 * axis.share:.0f} %)" for axis in told)
    shown = f"{', '.join(others)} and {last}" if others else last
    most = max(where, key=lambda axis: axis.share)
    if most.p_value <= SIGNIFICANT:
        return f"; it varies {shown}"
    return (
        f"; it varies most clearly {shown}, although the share {AXIS_WORDS[most.name]} is {100 * most.share:.0f} %, "
        f"which is not significant (p = {most.p_value:.2g})"
    )


def pointing_shares(found: Diagnosis, *, unocculted: bool = False) -> dict[int, float]:
    """The share of each pointing in the chi2 beyond noise, the largest first; empty if there is none.

    Parameters
    ----------
    unocculted
        Whether the chi2 is that of the blocks of the unocculted field in held-out images; else it is that of the discs.
    """
    infos = found.evidence.image_info
    if unocculted and found.residual is not None:
        more = found.residual.unocculted_chi2 - found.residual.unocculted_expected
        each = zip(found.residual.images, more.tolist(), strict=True)
    elif unocculted:
        return {}
    else:
        left = found.model.left(found.model.base)
        indices = (disc.index for disc in found.evidence.discs)
        each = zip(indices, [float(one @ one) - one.size for one in left], strict=True)
    sums: dict[int, float] = {}
    for n, more in each:
        sums[infos[n].pointing] = sums.get(infos[n].pointing, 0.0) + more
    above = {pointing: max(more, 0.0) for pointing, more in sums.items()}
    total = sum(above.values())
    shares = {pointing: more / total for pointing, more in above.items()} if total > 0 else {}
    return dict(sorted(shares.items(), key=lambda one: -one[1]))


def _largest(found: Diagnosis, unocculted: bool) -> str:
    """The one or two pointings that hold most of the gap, as the end of a sentence; empty if there are none."""
    shares = pointing_shares(found, unocculted=unocculted)
    for count, least in enumerate(LARGEST, 1):
        chosen = sorted(list(shares)[:count])
        share = sum(shares[one] for one in chosen)
        if count < len(shares) and share >= least:
            numbers = f"pointing{'s' if count > 1 else ''} {' and '.join(map(str, chosen))}"
            return f"; {percent_words(share)} of the chi2 of the gap is in {numbers}"
    return ""


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
    first, *others = causes = found.answer.causes
    out = cause_words(first, _numbers(found, first))
    for cause in others:
        out += f"; beside it {cause_words(cause, _numbers(found, cause))}"
    several = [cause for cause in causes if len(cause.alternatives) > 1]
    if several:
        out += ". These data cannot separate the alternatives; "
        observation = would_separate(found)
        out += (
            f"to separate them, take {observation}" if observation else "no observation is known that would"
        )
    observation = would_confirm(found)
    if observation:
        single = len(causes) - len(several)
        out += f". To confirm {('the other cause' if several else 'it') if single == 1 else 'them'}, take {observation}"
    return f"{out}."


def _numbers(found: Diagnosis, cause: Cause) -> str:
    """The fitted parameters of the first alternative, the clearest ones, as text; empty if it has none."""
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
    clearest = sorted(own, key=lambda label: -abs(own[label][0]) / max(own[label][1], 1e-300))[:MOST_TOLD]
    shown = [
        f"{words(label)} = {with_error(v, sigma)} {unit_words(unit)}".rstrip()
        for label, (v, sigma, unit) in own.items()
        if label in clearest
    ]
    more = len(own) - len(shown)
    return ", ".join(shown) + (f" and {more} more parameter{'s' if more > 1 else ''}" if more else "")


def _how_far(found: Diagnosis) -> str:
    told, shrinking = found.told, found.shrinking_of_told
    if told is None or shrinking is None:
        return "a changing Sun has no form that could be taken out of the images; the fit of the PSF is not changed."
    if found.residual is None:
        return "these data cannot say: no image can be held out."
    if shrinking.closure is None:
        return "these data cannot say: too few images are left to fit the causes, or the held-out images show no gap."
    closed = {cause_names(told): shrinking.closure}
    for name in found.answer.causes[0].effects:
        other = found.shrinking[name].closure if name in found.shrinking else None
        if name not in told.names and other is not None:
            closed[words(name)] = other
    out = "; ".join(closing_words(name, closure) for name, closure in closed.items())
    beside = f"; with {cause_names(told)}, " if len(closed) > 1 else "; "
    size = unocculted_size(found)
    if not size.shows_the_gap:
        return (
            f"on held-out images, {out}{beside}the gap in the discs {change_words(found.rms, found.after)}; the "
            f"noise is {found.noise_pct:.1f} %."
        )
    if size.before is None or size.after is None:
        return f"on held-out images, {out}."
    verb = "falls" if size.after < size.before else "changes"
    return (
        f"on held-out images, {out}{beside}the difference in the unocculted field {verb} from {size.before:.1f} to "
        f"{size.after:.1f} times the noise."
    )


def change_words(before: Interval, after: Interval) -> str:
    """How a gap changes, as text: it falls or rises only if the change is larger than its 90 % intervals."""
    verb, more = "changes", ", which is within the errors"
    if after.value < before.low and after.high < before.value:
        verb, more = "falls", ""
    elif after.value > before.high and after.low > before.value:
        verb, more = "rises", ""
    return f"{verb} from {_gap_words(before)} to {_gap_words(after)}{more}"


def closing_words(name: str, closure: Interval) -> str:
    """How much of the gap some causes close, as text; no number if the interval reaches from none of it to all."""
    value, low, high = (round(100 * one) + 0 for one in (closure.value, closure.low, closure.high))
    if closure.low <= 0 and closure.high >= ALL:
        return f"these data cannot say whether {name} closes none or all of the gap"
    if closure.value <= 0:
        return f"{name} closes none of the gap (at most {max(high, 0)} %)"
    return f"{name} closes {value} % ({'less than 0' if low < 0 else low} to {high}) of the gap"


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


def promise_words(calibration: Mapping[str, Any]) -> str:
    """How often the alternatives contained a true cause: where the level comes from, and with effects of another
    author.

    Parameters
    ----------
    calibration
        The entry ``calibration`` of the report.
    """
    other = calibration["another_author"]
    low, high = other["ci95"]
    return (
        f"The level comes from {calibration['cases']} simulated transits of known cause: in "
        f"{100 * calibration['covered']:.0f} % of them, the alternatives contained a true cause. "
        f"{calibration['holds_for']} With the effects of another author, the alternatives covered "
        f"{100 * other['covered']:.0f} % ({100 * low:.0f} to {100 * high:.0f}) of {other['causes']} causes that "
        f"left {other['left_pct']} % in the discs. For other data the fraction is not known."
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


def in_short_if_many(values: Sequence[float]) -> str | None:
    """A summary of parameters if there are more than MOST_READ; otherwise None."""
    if len(values) <= MOST_READ:
        return None
    return f"{len(values)} parameters, root sum of squares {float(np.linalg.norm(values)):.2g}"


def unit_words(unit: str) -> str:
    """A unit as text for a reader, for example "px²"."""
    return re.sub(r"(?<=[a-z])2\b", "²", unit)


def words(name: str) -> str:
    """The name of an effect or parameter, with spaces, for text."""
    return name.replace("_", " ")
