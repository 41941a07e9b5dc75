"""The page of a gap diagnosis: first the summary sentence, then numbers and figures, the most important ones first.

The template `page.html` holds the texts. The functions of this module make the rows of its tables. The named effects
are those that the verdict names as the cause of the gap ("answer" in the report).
"""

from __future__ import annotations

import sys

from psfcore.drawing.numbers import DASH, with_error
from psfcore.drawing.page import Page, render
from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.evidence.linear_model import FLOOR
from psfcore.gap.evidence.tree import FAMILIES
from psfcore.gap.report import limits, plot
from psfcore.gap.report import report as texts
from psfcore.gap.report.report import (
    fits_of,
    in_short_if_many,
    label_words,
    p_words,
    percent_words,
    unit_words,
    words,
)
from psfcore.gap.schema import GapReport, IntervalJson
from psfcore.gap.verdict.answer import UNKNOWN
from psfcore.gap.verdict.axes import SIGN_FLIPS, SIGNIFICANT
from psfcore.gap.verdict.correction import ROUNDS

Row = list[str]

VERDICTS = {
    "none": "no gap is detected: nothing is much more probable than noise and the error of the fit",
    "attributed": "there is a gap, and each of its causes has one alternative",
    "tie": "there is a gap, and these data cannot separate several effects that can cause it",
    "unknown": "there is a gap, and its most probable cause has a form that the library does not have",
    "inconclusive": "too few images, or alternatives of different kinds: effects of the library, and other forms",
}
MOST_HYPOTHESES = 8


def gap_page(found: Diagnosis, report: GapReport) -> Page:
    """The page of a diagnosis.

    The optional entry "provenance" of the report states the software, the libraries, the seed and the PSF at which the
    fit started.

    Parameters
    ----------
    report
        The report of this diagnosis (schema gap/3).
    """
    version = report.get("provenance", {}).get("software_version", "")
    optical = [
        words(e.name) for e in (found.corrected.effects if found.corrected else ()) if e.stage == "optics"
    ]
    return render(
        "gap/report/page.html",
        title=f"Gap between model and images of {found.solution.transit.instrument or 'a transit'}",
        lead=report["lines"][0],
        footer=f"heliopsf {version}".strip(),
        found=found,
        report=report,
        plot=plot,
        page=sys.modules[__name__],
        tables=limits,
        texts=texts,
        optical=" and ".join(optical),
        floor_pct=f"{100 * FLOOR:g}",
        rounds=ROUNDS,
        sign_flips=SIGN_FLIPS,
    )


def interval_words(interval: IntervalJson) -> str:
    """A value with its 90 % interval, "5.1 (4.4 to 5.9)"."""
    value, low, high = (round(one, 1) + 0.0 for one in (interval["value"], *interval["ci90"]))
    return f"{value:.1f} ({low:.1f} to {high:.1f})"


def names_of_answer(report: GapReport) -> tuple[str, str, str]:
    """What the named effects are (sure, tied, or the most probable ones), their names, and what each of them does."""
    kind = {"tie": "tied effects", "inconclusive": "most probable effects"}.get(
        report["verdict"], "named effects"
    )
    named = [one for one in report["answer"] if one != UNKNOWN]
    causes = {one["name"]: one["cause"] for one in report["effects"]}
    does = [
        f"{words(name)}: {causes[name]}" if len(named) > 1 else causes[name]
        for name in named
        if name in causes
    ]
    return (
        kind if report["answer"] else "named effects",
        ", ".join(map(words, report["answer"])) or "none",
        " ".join(does),
    )


def order_of_axes(report: GapReport) -> str:
    """Why the first axis comes first, if another one has a larger share; else empty."""
    first, *others = report["where"]
    if not any(one["share"] > first["share"] for one in others):
        return ""
    why = (
        "the told cause varies along it"
        if first["of_best"]
        else f"axes with a p-value of at most {SIGNIFICANT:g} come before the others"
    )
    return f"The first axis does not have the largest share: it is first because {why}."


def cause_rows(report: GapReport) -> list[Row]:
    """Every alternative of every cause of the answer."""
    return [
        [
            str(number),
            one["words"],
            one["stage"],
            FAMILIES[one["family"]].words,
            percent_words(one["probability"]),
        ]
        for number, cause in enumerate(report["causes"], 1)
        for one in cause["alternatives"]
    ]


def hypothesis_rows(report: GapReport) -> list[Row]:
    """The most probable hypotheses."""
    return [
        [
            " together with ".join(label_words(one["family"], one["effect"]) for one in row["causes"])
            or "no cause",
            percent_words(row["probability"]),
        ]
        for row in report["hypotheses"][:MOST_HYPOTHESES]
    ]


def effect_rows(report: GapReport) -> list[Row]:
    """Every effect that was tested, with its parameters and its closure."""
    rows = []
    for effect in fits_of(report):
        parameters, fall, closure = effect["parameters"], effect["delta_chi2_held_out"], effect["closure"]
        numbers = (
            f"{words(name)} {with_error(p['value'], p['sigma'])} {unit_words(p['unit'])}".rstrip()
            for name, p in parameters.items()
        )
        in_short = in_short_if_many([p["value"] for p in parameters.values()])
        cells = [DASH, DASH]
        if closure is not None:
            value, low, high = (f"{round(100 * one) + 0}" for one in (closure["value"], *closure["ci90"]))
            cells = [value, f"{low} to {high}"]
        row = [effect["words"], percent_words(effect["probability"]), in_short or "; ".join(numbers)]
        rows.append([*row, DASH if fall is None else f"{fall:.1f}", *cells, p_words(effect["p_value"])])
    return rows


def psf_table(found: Diagnosis, report: GapReport) -> tuple[Row, list[Row]]:
    """The parameters and 1 - encircled energy of the PSF, without and with the named effects."""
    fits = [one for one in (report["psf"]["refitted"], report["psf"]["with_answer"]) if one is not None]
    rows = []
    for name, first in fits[0].items():
        values = [(fit[name]["value"], fit[name]["sigma"]) for fit in fits]
        rows.append([f"{name} ({first['unit']})" if first["unit"] else name, *_compared(values)])
    curves = [found.solution.inversion, *([found.corrected.solution.inversion] if found.corrected else [])]
    for k, radius in enumerate(curves[0].radii_px):
        values = [(float(one.curve_pct[k]), float(one.curve_sigma[k])) for one in curves]
        rows.append([f"1 - encircled energy at {radius:g} px (%)", *_compared(values)])
    return ["", "fitted", *["with the named effects", "change (sigma)"][: len(rows[0]) - 2]], rows


def _compared(values: list[tuple[float, float]]) -> Row:
    """The values with their errors. For two values, also the second minus the first, in units of the error of the
    first.
    """
    cells = [with_error(*one) for one in values]
    if len(values) == 2:
        (first, sigma), (second, _) = values
        cells.append(f"{(second - first) / sigma:+.1f}" if sigma > 0 else DASH)
    return cells


def untestable_rows(report: GapReport) -> list[Row]:
    """The effects that these data cannot show, with the reasons."""
    return [[words(one["name"]), one["why"]] for one in report["untestable"]]


def image_rows(report: GapReport) -> list[Row]:
    """All images that the fit used."""
    return [
        [
            row["file"],
            str(row["fov"]),
            f"{row['time_s'] / 60:.1f}",
            f"{row['exposure_s']:g}",
            f"{row['x_px']:.1f}",
            f"{row['y_px']:.1f}",
            f"{row['observed_dn_s']:.4g}",
            with_error(row["residual_pct"], row["noise_pct"]),
            with_error(row["residual_after_pct"], row["noise_after_pct"]),
        ]
        for row in report["images"]
    ]
