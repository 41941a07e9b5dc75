"""A gap diagnosis as one page that a person reads in a minute: the summary, then numbers and figures by importance."""

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
    "none": "no gap: the residuals agree with noise and the error of the fit",
    "attributed": "a gap whose cause is identified",
    "tie": "a gap that several effects explain about equally well",
    "unknown": "a gap that no effect of the library explains",
    "inconclusive": "these data do not decide whether there is a gap, or what causes it",
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

    The report's "provenance", if it has one, tells what made it: software, libraries, seed, and the PSF that it started from.
    """
    of = found.solution.transit.instrument or "a transit"
    sections = [
        Section("What was found", _found(found, report)),
        Section("Where the gap lies", _where(found, report)),
        Section("Which effect", _which(found, report)),
        Section("The PSF, before and with the answer" if found.corrected else "The PSF", psf_parts(found)),
        Section("What weakens this result", doubts(report)),
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
        Value("best so far" if unsure else "answer", answer, meaning=_answer_meaning(report)),
        Value(
            "p-value without a gap",
            f"{gap['p_value']:.2g}",
            meaning=f"probability of such residuals if there is no gap; below {ALARM:g} a gap is claimed",
        ),
    ]
    answered = report["verdict"] in ("attributed", "tie")
    if answered:
        values.append(
            _gap(
                "gap before the refit",
                gap["before_refit_pct"],
                "with the PSF fitted together with the answer, but without the answer's effects",
            )
        )
    values.append(
        _gap(
            "gap, PSF refitted",
            gap["rms_pct"],
            "rms residual of held-out images, noise subtracted in quadrature",
        )
    )
    if answered:
        values.append(
            _gap(
                "gap with the answer in the model",
                gap["after_pct"],
                "the same on the same images; 0 if only noise and the error of the fit remain",
            )
        )
    values.append(
        Value(
            "noise",
            f"{gap['noise_pct']:.2g}",
            unit="%",
            meaning="rms of a disc's mean: photon noise, read noise and the error of the fit",
        )
    )
    parts: list[Part] = [Values(values)]
    if report["would_separate"]:
        parts.append(f"To tell them apart, take {report['would_separate']}.")
    elif report["verdict"] == "attributed":
        settled = [e.settled_by for e in found.effects if e.settled_by]
        parts.append(f"To confirm the answer, take {'; '.join(dict.fromkeys(settled))}.")
    if report["verdict"] == "tie" and found.corrected:
        parts.append(
            f"Below, “with the answer” means with the best of the tied effects: {best_words(found)}. With another of them the PSF and the "
            "residuals would differ."
        )
    if report["looks_like"]:
        parts += _looks_like(report)
    if found.residual is None:
        parts.append("No image could be held out, so there are no held-out residuals to show.")
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
            ["pattern", "score", "p-value"],
            rows,
            "What the gap resembles: patterns typical of causes outside the library, best first. They do not identify a cause.",
        )
    ]


def _map_figure(report: Report) -> Figure:
    after = has_after(report)
    caption = (
        "Every disc at its place on the detector. The colour is the residual of its mean: simulated minus observed, over the "
        "observed mean, from a fit without this image and its neighbours. Symbols distinguish the pointings. The next figure shows the "
        "errors."
    )
    if after:
        caption += " Left: the fitted model. Right: with the answer's effects in it, on the same scale."
    return Figure(map_png(report), caption, "Map of the residuals of all discs on the detector")


# --- where, which -----------------------------------------------------------------------------------------


def _where(found: Diagnosis, report: Report) -> list[Part]:
    strongest = report["where"][0]
    parts: list[Part] = []
    if report["verdict"] == "none":
        parts.append("There is no gap to locate. The figures below show noise, and no axis should stand out.")
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
            "The share of each axis in what all axes explain together, averaged over all orders in which the axes can be added, "
            "because they vary together in a transit. The p-value is the probability that noise alone explains as much, times the number "
            f"of axes; with {SIGN_FLIPS} random sign flips it cannot be below {len(report['where']) / (SIGN_FLIPS + 1):.2g} for the discs.",
            "Bars of the share of the gap along each axis",
        )
    )
    after = " Right: with the answer's effects in the model and the PSF refitted." if found.corrected else ""
    parts.append(
        Figure(
            cells_png(found),
            "Where in the disc the gap lies: the mean residual (%) of each cell over all images, with its error from noise, for the fit "
            f"to all images.{after} The unit of radius is that of the outermost dark pixels.",
            "Map of mean residuals by radius and azimuth in the disc",
        )
    )
    return parts


def _range_words(axis: str, at: dict[str, Any]) -> str:
    """The range of an axis in the pointings where the gap is largest."""
    if "range" not in at:
        return ""
    low, high = at["range"]
    return f" (from {low:.4g} to {high:.4g} {AXIS_UNITS[axis]})"


def _residuals_caption(report: Report) -> str:
    caption = (
        "Residuals of the discs' means on held-out images, against place and time. Bars: one standard deviation of noise and the error "
        "of the fit. Without a gap about one bar in three misses zero."
    )
    return caption + (
        " Full symbols: the fitted model. Open symbols: with the answer's effects; their bars include the errors of these effects."
        if has_after(report)
        else ""
    )


def _which(found: Diagnosis, report: Report) -> list[Part]:
    parts: list[Part] = []
    if report["verdict"] == "none":
        parts.append(
            "There is no gap, so no effect is needed. All were tested, and none gains more than noise would."
        )
    elif report["verdict"] == "unknown":
        parts.append(
            "No effect is the answer, and no pair of effects is: the residuals after the best one are still significant, or a pattern "
            "typical of causes outside the library fits clearly better."
        )
    elif found.judgement.discs_unexplained:
        parts.append(
            f"No effect is the answer: {discs_unexplained_words(found.judgement)}. The positions of all occulters are reliable, so wrong positions do not cause this gap."
        )
    elif report["verdict"] == "inconclusive":
        parts.append(
            "These data do not decide which effect is the answer, if any. Either the answer changes with the assumed floor (the error, as a "
            "fraction of a disc's light, allowed for unknown causes), or it fails on held-out images, or a pattern of unknown cause fits as "
            "well, or there are too few images."
        )
    elif report["ties"]:
        parts.append(
            f"Tied: {tied_words(found.judgement)}. Their scores differ by less than {TIE:g}, or by less than {100 * TIE_SHARE:g} % of the best gain (more "
            "if a place was searched for), or their order changes with the assumed floor."
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
        f"Effects of the library, best first (at most {MOST_EFFECTS}); effects that fail in a full refit come last. Bars: the fraction of the gap that each closes on "
        "held-out images, with its 90 % interval; those that leave the chart are cut, with an arrow. Blue: the answer, or the tied effects. A wrong effect may also close much of a gap, so the score decides: "
        "the decrease of chi2, minus what the effect's parameters and the search for its place gain from noise. Effects whose score is within "
        f"{TIE:g}, or {100 * TIE_SHARE:g} % of the best gain, of the best effect are tied with it.",
        "Bars of held-out closure by effect",
    )


def _effects_table(report: Report) -> Table:
    return Table(
        ["effect", "parameters", "score", "delta chi2, held out", "closure (%)", "90 % interval", "p-value"],
        [_effect_row(effect) for effect in fits_of(report)],
        "Every effect that was tested, fitted together with the PSF: first those that act together, then each alone. Errors are one standard deviation. The parameters of the answer are those of "
        "the full refit. Delta chi2: the decrease of -2 ln likelihood of the held-out images, errors of the parameters included.",
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
            f"The mean of {2 * SLICE_ROWS + 1} rows through the centre of the occulter of {taken.file} (pointing {taken.pointing}), whose disc differs most from the model in units of its "
            "noise. Points: observed, with noise. Line: simulated. Grey: fully dark pixels, where all light is scattered. Outside them the scene is "
            "reconstructed from this image, so the line follows the points. Left: the fitted model. Right: with the answer's effects.",
            "Observed and simulated light along x through an occulter, before and with the answer",
        )
    ]
