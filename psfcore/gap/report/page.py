"""A gap diagnosis as one page that a person reads in a minute: the sentence, then numbers and figures by weight."""

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
    discs_unexplained_words,
    fits_of,
    in_short_if_many,
    tied_words,
    words,
)
from psfcore.gap.verdict.judge import ALARM, TIE, TIE_SHARE
from psfcore.gap.verdict.where import SIGN_FLIPS

Report = dict[str, Any]

VERDICTS = {
    "none": "no gap: nothing beyond noise and what the fit itself leaves",
    "attributed": "a gap, and what causes it",
    "tie": "a gap, and effects that explain it about as well as one another",
    "unknown": "a gap that no effect of the library explains",
    "inconclusive": "a gap is likely; these data cannot say what causes it",
}
AXIS_UNITS = {
    "detector_x": "px",
    "detector_y": "px",
    "time": "s after the first image",
    "intensity": "DN/s",
    "exposure": "s",
    "scattering_distance": "px",
}


def gap_page(found: Diagnosis, report: Report) -> Page:
    """The page of a diagnosis and its report (schema gap/1).

    What made the report, as software, libraries, seed or the PSF that it started from, is read from its "provenance",
    where it has one.
    """
    of = found.solution.transit.instrument or "a transit"
    sections = [
        Section("What was found", _found(found, report)),
        Section("Where the gap lies", _where(found, report)),
        Section("Which effect", _which(found, report)),
        Section("The PSF, before and with the answer" if found.corrected else "The PSF", psf_parts(found)),
        Section("What weakens this", doubts(report)),
        Section("Every image, and what it was made of", made_of(found, report)),
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
        Value("best so far" if unsure else "answer", answer, meaning=_answer_meaning(report)),
        Value(
            "p-value of there being no gap",
            f"{gap['p_value']:.2g}",
            meaning=f"a gap is claimed below {ALARM:g}",
        ),
    ]
    answered = report["verdict"] in ("attributed", "tie")
    if answered:
        values.append(
            _gap(
                "gap before the refit",
                gap["before_refit_pct"],
                "with the PSF that the answer leaves, the answer left out",
            )
        )
    values.append(
        _gap("gap, PSF refitted", gap["rms_pct"], "rms over images held out, noise taken out in quadrature")
    )
    if answered:
        values.append(
            _gap(
                "gap with the answer in the model",
                gap["after_pct"],
                "the same, on the same images; 0 where no more is left than noise and the fit's error",
            )
        )
    values.append(
        Value(
            "noise",
            f"{gap['noise_pct']:.2g}",
            unit="%",
            meaning="rms of a disc's mean: photons, readout and the fit's error",
        )
    )
    parts: list[Part] = [Values(values)]
    if report["would_separate"]:
        parts.append(f"What would tell them apart: {report['would_separate']}.")
    elif report["verdict"] == "attributed":
        settled = [e.settled_by for e in found.effects if e.settled_by]
        parts.append(f"What would settle it beyond doubt: {'; '.join(dict.fromkeys(settled))}.")
    if report["verdict"] == "tie" and found.corrected:
        parts.append(
            f"Below, “with the answer” is with the best of those that are tied: {best_words(found)}. With another the PSF and what is left "
            "would be others."
        )
    if report["looks_like"]:
        parts += _looks_like(report)
    if found.residual is None:
        parts.append("No image could be held out, so that there are no residuals to show.")
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
    rows = [[one["form"], f"{one['score']:.1f}", f"{one['p_value']:.2g}"] for one in report["looks_like"]]
    return [
        Table(
            ["form", "score", "p-value"],
            rows,
            "What the gap looks like: forms that gaps of causes outside the library have, best first. They name no cause.",
        )
    ]


def _map_figure(report: Report) -> Figure:
    after = has_after(report)
    caption = (
        "Every disc at its place on the detector, its colour the residual of its mean: simulated minus observed, over the "
        "observed mean, by a fit that this image and its neighbours took no part in. Symbols tell the pointings apart; how well each is "
        "known shows in the next figure."
    )
    if after:
        caption += " Left: the fitted model; right: with the answer's effects in it, on the same scale."
    return Figure(map_png(report), caption, "Map of the residuals of all discs on the detector")


# --- where, which -----------------------------------------------------------------------------------------


def _where(found: Diagnosis, report: Report) -> list[Part]:
    strongest = report["where"][0]
    parts: list[Part] = []
    if report["verdict"] == "none":
        parts.append(
            "There is no gap to place: what follows is how noise falls, and no axis should stand out."
        )
    else:
        at = strongest["at"]
        parts.append(
            f"It varies most {AXIS_WORDS[strongest['axis']]}{_range_words(strongest['axis'], at)}; it is largest in "
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
            "How much of what all axes explain together goes with each: its share, averaged over all orders in which axes can be "
            "taken, for they go together in a transit. Beside it how likely chance alone would do as well, counted for the number of axes; "
            f"{SIGN_FLIPS} draws cannot tell less than {len(report['where']) / (SIGN_FLIPS + 1):.2g} in the discs.",
            "Bars of the share of the gap that goes with each axis",
        )
    )
    after = " Right: with the answer's effects in the model, the PSF refitted." if found.corrected else ""
    parts.append(
        Figure(
            cells_png(found),
            "Where in the disc: the mean residual (%) of its cells over all images, laid on one another, with the error that noise gives it; "
            f"fitted to all images.{after} Radii are those of the outermost dark pixels.",
            "Map of mean residuals by radius and azimuth in the disc",
        )
    )
    return parts


def _range_words(axis: str, at: dict[str, Any]) -> str:
    """The part of an axis that its pointings cover."""
    if "range" not in at:
        return ""
    low, high = at["range"]
    return f" (from {low:.4g} to {high:.4g} {AXIS_UNITS[axis]})"


def _residuals_caption(report: Report) -> str:
    caption = (
        "Residuals of the discs' means on images held out, by place and time. Bars: one standard deviation of noise and the fit's "
        "error; about one in three should miss zero where there is no gap."
    )
    return caption + (
        " Full symbols: the fitted model; open ones: with the answer's effects, whose own errors are in their bars."
        if has_after(report)
        else ""
    )


def _which(found: Diagnosis, report: Report) -> list[Part]:
    parts: list[Part] = []
    if report["verdict"] == "none":
        parts.append(
            "Without a gap no effect is needed. All were tried; none of them gains what noise would not."
        )
    elif report["verdict"] == "unknown":
        parts.append(
            "None of them is the answer, nor are two together: what the best leaves still shows, or a form of a cause outside the library "
            "does clearly better."
        )
    elif found.judgement.discs_unexplained:
        parts.append(
            f"No effect is the answer: {discs_unexplained_words(found.judgement)}. Every occulter is where the images put it, so that no wrong place makes that gap."
        )
    elif report["verdict"] == "inconclusive":
        parts.append(
            "Which of them it is, or whether it is any, changes with what is taken for granted, here the share of a disc's light that "
            "nobody has thought of; or a form of unknown cause does as well; or there are too few images to say."
        )
    elif report["ties"]:
        parts.append(
            f"Tied: {tied_words(found.judgement)}. Their scores lie within {TIE:g} of one another, or within {100 * TIE_SHARE:g} % of what the best gains (more "
            "widely where a place was searched for), or change places with what is taken for granted."
        )
    if report["verdict"] != "none":
        parts.append(_effects_figure(report))
    parts.append(_effects_table(report))
    if found.corrected:
        parts += _slices(found)
    return parts


def _effects_figure(report: Report) -> Figure:
    return Figure(
        effects_png(report),
        f"Effects of the library, best first (at most {MOST_EFFECTS}), what fails in the model for real last: the share of the gap that each closes on images held out, with its "
        "90 % interval; bars and intervals that leave the chart are cut, with an arrow. Blue: the answer, or what is tied. A wrong effect may close much of a gap too, so that the score decides: by how much chi2 falls, "
        f"less what its parameters and a search for its place gain from noise; what lies within {TIE:g}, or {100 * TIE_SHARE:g} % of what the best gains, is tied with it.",
        "Bars of held-out closure by effect",
    )


def _effects_table(report: Report) -> Table:
    return Table(
        ["effect", "parameters", "score", "delta chi2, held out", "closure (%)", "90 % interval", "p-value"],
        [_effect_row(effect) for effect in fits_of(report)],
        "Every effect that was tried, fitted beside the PSF: those that act together first, then each alone. Errors are one standard deviation. Of the answer the parameters are those of "
        "the real refit. Delta chi2: by how much likelier it makes images held out (-2 ln), its parameters' errors counted.",
    )


def _effect_row(effect: Report) -> list[str]:
    numbers = "; ".join(
        f"{words(name)} {with_error(p['value'], p['sigma'])} {unit_words(p['unit'])}".rstrip()
        for name, p in effect["parameters"].items()
    )
    fall = effect["delta_chi2_held_out"]
    return [
        words(effect["name"]),
        in_short_if_many([p["value"] for p in effect["parameters"].values()]) or numbers,
        f"{effect['score']:.1f}",
        DASH if fall is None else f"{fall:.1f}",
        *_closure_cells(effect["closure"]),
        f"{effect['p_value']:.2g}",
    ]


def unit_words(unit: str) -> str:
    """A unit as a person writes it, "px²"."""
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
            f"The mean of {2 * SLICE_ROWS + 1} rows through the middle of the occulter of {taken.file} (pointing {taken.pointing}), whose disc departs most from the model for its "
            "noise: observed as points with their noise, simulated as a line. Grey: fully dark pixels, where all light is scattered; what is lit "
            "is reconstructed from this image, which the line follows there. Left: the fitted model; right: with the answer's effects.",
            "Observed and simulated light along x through an occulter, before and with the answer",
        )
    ]
