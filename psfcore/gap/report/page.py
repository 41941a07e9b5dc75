"""The page of a gap diagnosis: first the summary sentence, then numbers and figures, the most important ones first.

The named effects are those that the verdict names as the cause of the gap ("answer" in the report).
"""

from __future__ import annotations

import re
from typing import Any

from psfcore.drawing.page import (
    DASH,
    Figure,
    Page,
    Part,
    Section,
    Table,
    Value,
    Values,
    with_error,
)
from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.report.appendix import doubts, made_of, psf_parts
from psfcore.gap.report.bars import MOST_EFFECTS
from psfcore.gap.report.limits_tables import limits_parts
from psfcore.gap.report.plot import (
    SLICE_ROWS,
    cells_png,
    effects_png,
    has_after,
    largest_residual,
    map_png,
    residuals_png,
    slices_png,
    where_png,
)
from psfcore.gap.report.report import (
    AXIS_WORDS,
    best_words,
    fits_of,
    hypothesis_words,
    in_short_if_many,
    percent_words,
    tied_words,
    words,
)
from psfcore.gap.verdict.where import SIGN_FLIPS

Report = dict[str, Any]

VERDICTS = {
    "none": "most probably there is no gap: noise and the error of the fit explain the residuals",
    "attributed": "there is a gap, and the answer set contains one cause",
    "tie": "there is a gap, and the answer set contains several effects or pairs of effects",
    "unknown": "there is a gap, and the answer set contains no effect of the library",
    "inconclusive": "the answer set contains different kinds of causes, for example an effect and an unknown cause",
}
MOST_HYPOTHESES = 8
AXIS_UNITS = {
    "detector_x": "px",
    "detector_y": "px",
    "time": "s after the first image",
    "intensity": "DN/s",
    "exposure": "s",
    "scattering_distance": "px",
}


def gap_page(found: Diagnosis, report: Report) -> Page:
    """The page of a diagnosis. report: its report (schema gap/2).

    The optional entry "provenance" of the report states the software, the libraries, the seed and the PSF at which the fit
    started.
    """
    of = found.solution.transit.instrument or "a transit"
    sections = [
        Section("What was found", _found(found, report)),
        Section("Where the gap lies", _where(found, report)),
        Section("Which effect causes the gap", _which(found, report)),
        Section("What these data could have shown", limits_parts(found.limits)),
        Section(
            "The PSF, without and with the named effects" if found.corrected else "The PSF", psf_parts(found)
        ),
        Section("Reasons for caution", doubts(report)),
        Section("All images, settings and input files", made_of(found, report)),
    ]
    version = report.get("provenance", {}).get("software_version", "")
    return Page(
        f"Gap between model and images of {of}", report["sentence"], sections, f"heliopsf {version}".strip()
    )


# --- what was found ---------------------------------------------------------------------------------------


def _found(found: Diagnosis, report: Report) -> list[Part]:
    gap = report["gap"]
    answer = ", ".join(words(name) for name in report["answer"]) or "none"
    unsure = report["verdict"] == "inconclusive" and bool(report["answer"])
    values = [
        Value("verdict", report["verdict"], meaning=VERDICTS[report["verdict"]]),
        Value(
            "most probable effects" if unsure else "named effects", answer, meaning=_answer_meaning(report)
        ),
        Value(
            "answer set",
            "; ".join(hypothesis_words(tuple(names)) for names in report["set"]["members"]),
            meaning=f"the hypotheses that belong to the answer; on data like the simulated ones, this set contains the true cause in {100 * report['set']['coverage']:.0f} % of the cases",
        ),
        Value(
            "probability of no gap",
            percent_words(report["probabilities"]["none"]),
            meaning="probability that no effect and no unknown cause acts",
        ),
        Value(
            "p-value of the gap",
            f"{gap['p_value']:.2g}",
            meaning="probability of residuals at least as large as these if there is no gap",
        ),
    ]
    answered = report["verdict"] in ("attributed", "tie")
    if answered:
        values.append(
            _gap(
                "gap before the refit",
                gap["before_refit_pct"],
                "the PSF was fitted together with the named effects; then these effects were left out",
            )
        )
    values.append(
        _gap(
            "gap, PSF refitted",
            gap["rms_pct"],
            "rms residual of held-out images without any effect; the noise is subtracted in quadrature",
        )
    )
    if answered:
        values.append(
            _gap(
                "gap with the named effects in the model",
                gap["after_pct"],
                "rms residual of the same images, with these effects added; 0 if only noise and the error of the fit remain",
            )
        )
    values.append(
        Value(
            "noise",
            f"{gap['noise_pct']:.2g}",
            unit="%",
            meaning="rms error of the mean of a disc, from photon noise, read noise and the error of the fit",
        )
    )
    parts: list[Part] = [Values(values)]
    if report["would_separate"]:
        parts.append(f"To separate the tied effects, take {report['would_separate']}.")
    elif report["verdict"] == "attributed":
        settled = [e.settled_by for e in found.effects if e.settled_by]
        parts.append(f"To confirm the named effects, take {'; '.join(dict.fromkeys(settled))}.")
    if report["verdict"] == "tie" and found.corrected:
        parts.append(
            f"Below, “with the named effects” means with the best of the tied effects: {best_words(found)}. With another tied effect, the PSF and the "
            "residuals would differ."
        )
    if report["looks_like"]:
        parts += _looks_like(report)
    if found.residual is None:
        parts.append("No image could be held out, so this report has no residuals of held-out images.")
    else:
        parts.append(_map_figure(report))
    return parts


def _answer_meaning(report: Report) -> str:
    named = set(report["answer"])
    return " ".join(effect["cause"] for effect in report["effects"] if effect["name"] in named)


def _gap(name: str, interval: dict[str, Any], meaning: str) -> Value:
    return Value(name, interval_words(interval), unit="%", meaning=meaning)


def interval_words(interval: dict[str, Any]) -> str:
    """A value with its 90 % interval, "5.1 (4.4 to 5.9)"."""
    value, low, high = (round(one, 1) + 0.0 for one in (interval["value"], *interval["ci90"]))
    return f"{value:.1f} ({low:.1f} to {high:.1f})"


def _looks_like(report: Report) -> list[Part]:
    rows = [[one["form"], percent_words(one["probability"])] for one in report["looks_like"]]
    return [
        Table(
            ["pattern", "probability"],
            rows,
            "If the cause is not in the library: the patterns that the gap resembles, the most probable first. They do not identify a cause.",
        )
    ]


def _map_figure(report: Report) -> Figure:
    after = has_after(report)
    caption = (
        "Every disc at its position on the detector. The colour shows the residual of its mean: simulated minus observed, divided by the "
        "observed mean. Each residual comes from a fit without this image and its neighbours. The symbols distinguish the pointings. The next "
        "figure shows the errors of the residuals."
    )
    if after:
        caption += (
            " Left: the fitted model. Right: the model with the named effects, on the same colour scale."
        )
    return Figure(map_png(report), caption, "Map of the residuals of all discs on the detector")


# --- where, which -----------------------------------------------------------------------------------------


def _where(found: Diagnosis, report: Report) -> list[Part]:
    strongest = report["where"][0]
    parts: list[Part] = []
    if report["verdict"] == "none":
        parts.append(
            "There is no gap to locate. The figures below show only noise: no axis should have a much larger share than the others."
        )
    else:
        at = strongest["at"]
        parts.append(
            f"The gap varies most {AXIS_WORDS[strongest['axis']]}{_range_words(strongest['axis'], at)}. It is largest in "
            f"{'pointings' if len(at['pointings']) > 1 else 'pointing'} {' and '.join(map(str, at['pointings']))}."
        )
    if found.residual is not None:
        parts.append(
            Figure(
                residuals_png(report), _residuals_caption(report), "Residuals against detector x, y and time"
            )
        )
    parts.append(
        Figure(
            where_png(report),
            "The share of the gap that varies along each axis. All axes together explain a decrease of chi2; the share is the contribution of one axis to it. "
            "In a transit the axes vary together, so the share is averaged over all orders in which the axes can be added. "
            "The p-value is the probability that the axis explains at least as much in noise alone, times the number of axes. It comes from "
            f"{SIGN_FLIPS} random sign flips of the residuals, so for the discs it cannot be below {len(report['where']) / (SIGN_FLIPS + 1):.2g}.",
            "Bars of the share of the gap along each axis",
        )
    )
    after = " Right: with the named effects in the model and the PSF refitted." if found.corrected else ""
    parts.append(
        Figure(
            cells_png(found),
            "Where the gap lies in the disc. The disc is divided into cells. Each number is the residual (%) of a cell, averaged over all images, with its "
            f"error from noise. The fit used all images.{after} Distances are in units of the radius of the outermost dark pixels.",
            "Map of mean residuals by radius and azimuth in the disc",
        )
    )
    return parts


def _range_words(axis: str, at: dict[str, Any]) -> str:
    """The range of an axis in the pointings with the largest gap, as text."""
    if "range" not in at:
        return ""
    low, high = at["range"]
    return f" (from {low:.4g} to {high:.4g} {AXIS_UNITS[axis]})"


def _residuals_caption(report: Report) -> str:
    caption = (
        "Residuals of the discs' means in held-out images, against the position of the disc and against time. Each bar is one standard deviation of "
        "noise and of the error of the fit. If there is no gap, about one bar in three does not reach zero."
    )
    return caption + (
        " Full symbols: the fitted model. Open symbols: the model with the named effects; these bars include the errors of the effects."
        if has_after(report)
        else ""
    )


def _which(found: Diagnosis, report: Report) -> list[Part]:
    said = {
        "none": "Most probably there is no gap. An effect that is in the answer set or in the table may still act, but too weakly for these data.",
        "unknown": "No effect of the library, alone or together with others, is in the answer set. A change of the data that no effect describes is more probable.",
        "inconclusive": "These data do not decide between the hypotheses of the answer set.",
        "tie": f"Tied: {tied_words(found.judgement)}. All these effects are in the answer set.",
    }
    parts: list[Part] = [said[report["verdict"]]] if report["verdict"] in said else []
    parts += [_hypotheses_table(report), _probabilities_note(report)]
    if report["verdict"] != "none":
        parts.append(_effects_figure(report))
    parts.append(_effects_table(report))
    if found.corrected:
        parts += _slices(found)
    return parts


def _hypotheses_table(report: Report) -> Table:
    members = [tuple(names) for names in report["set"]["members"]]
    rows = [
        [
            hypothesis_words(tuple(one["effects"])),
            percent_words(one["probability"]),
            "yes" if tuple(one["effects"]) in members else "",
        ]
        for one in report["hypotheses"][:MOST_HYPOTHESES]
    ]
    return Table(
        ["hypothesis", "probability", "in the answer set"],
        rows,
        f"The most probable hypotheses about the cause (at most {MOST_HYPOTHESES}). Two or three effects together are listed only if they are more probable than fewer of them.",
    )


def _probabilities_note(report: Report) -> str:
    made = report["calibration"]
    return (
        f"The limits of the answer set come from {made['cases']} simulated transits of known cause. {made['holds_for']} On data that "
        "differ from these, the stated coverage is not guaranteed."
    )


def _effects_figure(report: Report) -> Figure:
    return Figure(
        effects_png(report),
        f"The effects of the library, the most probable first (at most {MOST_EFFECTS}). Each bar is the closure by one effect: the fraction of the gap in "
        "held-out images that disappears when the effect is added to the model. The line is its 90 % interval; an arrow marks where the chart cuts it. Blue: the named effects, or the tied effects. A wrong effect may also close much of a gap, so the probability decides. "
        "The probability in the row of an effect is the probability that it acts, alone or with others. In the row of several effects, all of them act.",
        "Bars of held-out closure by effect",
    )


def _effects_table(report: Report) -> Table:
    return Table(
        [
            "effect",
            "probability",
            "parameters",
            "delta chi2, held out",
            "closure (%)",
            "90 % interval",
            "p-value",
        ],
        [_effect_row(effect) for effect in fits_of(report)],
        "Every effect that was tested. Each was fitted together with the PSF. First come effects that act together, then single effects. Errors are one standard deviation. For the named effects, the parameters are those of "
        "the full refit. Delta chi2, held out: the decrease of -2 ln likelihood of the held-out images, including the errors of the parameters.",
    )


def _effect_row(effect: Report) -> list[str]:
    numbers = "; ".join(
        f"{words(name)} {with_error(p['value'], p['sigma'])} {unit_words(p['unit'])}".rstrip()
        for name, p in effect["parameters"].items()
    )
    fall = effect["delta_chi2_held_out"]
    return [
        words(effect["name"]),
        percent_words(effect["probability"]),
        in_short_if_many([p["value"] for p in effect["parameters"].values()]) or numbers,
        DASH if fall is None else f"{fall:.1f}",
        *_closure_cells(effect["closure"]),
        f"{effect['p_value']:.2g}",
    ]


def unit_words(unit: str) -> str:
    """A unit as text for the page, for example "px²"."""
    return re.sub(r"(?<=[a-z])2\b", "²", unit)


def _closure_cells(closure: dict[str, Any] | None) -> list[str]:
    if closure is None:
        return [DASH, DASH]
    value, low, high = (f"{round(100 * one) + 0}" for one in (closure["value"], *closure["ci90"]))
    return [value, f"{low} to {high}"]


def _slices(found: Diagnosis) -> list[Part]:
    taken = found.evidence.image_info[largest_residual(found)]
    return [
        Figure(
            slices_png(found),
            f"The mean of {2 * SLICE_ROWS + 1} rows through the centre of the occulter in {taken.file} (pointing {taken.pointing}). Of all discs, this one differs most from the model, in units of the "
            "noise. Points: observed, with noise. Line: simulated. Grey: fully dark pixels, where all light is scattered light. Outside the grey area the scene is "
            "reconstructed from this image, so the line follows the points. Left: the fitted model. Right: the model with the named effects.",
            "Observed and simulated light along x through an occulter, without and with the named effects",
        )
    ]
