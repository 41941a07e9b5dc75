"""A gap diagnosis as one page that a person reads in a minute: the sentence, then numbers and figures by weight."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from psfcore.drawing.page import (
    DASH,
    Bullets,
    Details,
    Figure,
    Page,
    Part,
    Section,
    Table,
    Value,
    Values,
    provenance_values,
    with_error,
)
from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.evidence.linear_model import FLOOR
from psfcore.gap.report.plot import (
    MOST_EFFECTS,
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
    discs_unexplained_words,
    fits_of,
    in_short_if_many,
    tied_words,
    words,
)
from psfcore.gap.verdict.correction import ROUNDS
from psfcore.gap.verdict.judge import ALARM, ENOUGH, TIE, TIE_SHARE
from psfcore.gap.verdict.where import DRAWS
from psfcore.scatter.inversion import Inversion

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
        Section("The PSF, before and with the answer" if found.corrected else "The PSF", _psf(found)),
        Section("What weakens this", _doubts(report)),
        Section("Every image, and what it was made of", _made_of(found, report)),
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
            f"Below, “with the answer” is with the best of those that are tied: {_best_words(found)}. With another the PSF and what is left "
            "would be others."
        )
    if report["looks_like"]:
        parts += _looks_like(report)
    if found.residual is None:
        parts.append("No image could be held out, so that there are no residuals to show.")
    else:
        parts.append(_map_figure(report))
    return parts


def _best_words(found: Diagnosis) -> str:
    """The effects of the first real refit."""
    return " + ".join(words(effect.name) for effect in found.corrected[0].effects)


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
            f"{DRAWS} draws cannot tell less than {len(report['where']) / (DRAWS + 1):.2g} in the discs.",
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
    taken = found.evidence.taken[largest_residual(found)]
    return [
        Figure(
            slices_png(found),
            f"The mean of {2 * SLICE_ROWS + 1} rows through the middle of the occulter of {taken.file} (pointing {taken.fov}), whose disc departs most from the model for its "
            "noise: observed as points with their noise, simulated as a line. Grey: fully dark pixels, where all light is scattered; what is lit "
            "is reconstructed from this image, which the line follows there. Left: the fitted model; right: with the answer's effects.",
            "Observed and simulated light along x through an occulter, before and with the answer",
        )
    ]


# --- the PSF ----------------------------------------------------------------------------------------------


def _psf(found: Diagnosis) -> list[Part]:
    before = found.solution.inversion
    columns = [(before, found.model.base.covariance)]
    if found.corrected:
        columns.append((found.corrected[0].solution.inversion, found.corrected[0].covariance))
    header = ["", "fitted", *(["with the answer", "change (sigma)"] if found.corrected else [])]
    rows = [_parameter_row(k, columns) for k in range(len(before.shape.parameters))]
    rows += [_curve_row(k, radius, columns) for k, radius in enumerate(before.radii_px)]
    caption = (
        f"Parameters of the shape “{before.shape.name}”, and the light of the total PSF beyond R, in percent of all light. Errors of parameters: noise, with "
        f"a floor of {100 * FLOOR:g} % of a disc's light; with the answer, its parameters free beside them. Errors of the light: noise."
    )
    optical = [words(e.name) for c in found.corrected[:1] for e in c.effects if e.stage == "optics"]
    if optical:
        caption += f" What {' and '.join(optical)} itself adds to the PSF is not in these numbers; it is in the corrected PSF's file."
    parts: list[Part] = [Table(header, rows, caption)]
    if not found.corrected:
        parts.append("No effect was added to the model, so that there is no corrected PSF.")
    elif found.judgement.verdict == "tie":
        parts.append(f"With the best of the effects that are tied: {_best_words(found)}.")
    return parts


def _parameter_row(k: int, columns: list[tuple[Inversion, Any]]) -> list[str]:
    parameter = columns[0][0].shape.parameters[k]
    name = f"{parameter.name} ({parameter.unit})" if parameter.unit else f"{parameter.name}"
    values = [inversion.values[parameter.name] for inversion, _ in columns]
    sigma = [
        abs(parameter.slope(float(inversion.coordinates[k]))) * math.sqrt(max(float(covariance[k, k]), 0.0))
        for inversion, covariance in columns
    ]
    return [name, *_compared(values, sigma)]


def _curve_row(k: int, radius: float, columns: list[tuple[Inversion, Any]]) -> list[str]:
    values = [float(inversion.curve_pct[k]) for inversion, _ in columns]
    sigma = [float(inversion.curve_sigma[k]) for inversion, _ in columns]
    return [f"light beyond {radius:g} px (%)", *_compared(values, sigma)]


def _compared(values: list[float], sigma: list[float]) -> list[str]:
    """Values with errors; of two also the change over the first one's error."""
    cells = [with_error(value, s) for value, s in zip(values, sigma, strict=True)]
    if len(values) == 2:
        cells.append(f"{(values[1] - values[0]) / sigma[0]:+.1f}" if sigma[0] > 0 else DASH)
    return cells


# --- doubts, images, inputs -------------------------------------------------------------------------------


def _doubts(report: Report) -> list[Part]:
    said = list(report["cautions"]) or ["Nothing in these data themselves."]
    parts: list[Part] = [Bullets([one if one.endswith(".") else f"{one}." for one in said])]
    if report["untestable"]:
        rows = [[words(one["name"]), one["why"]] for one in report["untestable"]]
        parts.append(
            Table(["effect", "why it could not be tried"], rows, "Effects that these data cannot show.")
        )
    return parts


def _made_of(found: Diagnosis, report: Report) -> list[Part]:
    expected, noise = report["expected"], found.solution.transit.noise
    how = Values(
        [
            Value(
                "images that took part", f"{len(report['images'])} of {len(found.solution.transit.frames)}"
            ),
            Value("photon gain", noise.photon_gain_dn, unit="DN", meaning="DN a detected photon, as used"),
            Value("readout noise", noise.read_noise_dn, unit="DN", meaning="rms, as used"),
            Value(
                "residual of the fit on its own simulation",
                f"{expected['residual_pct']:.2f}",
                unit="%",
                meaning="rms of the discs' means: no gap, but noise and the estimator's own error",
            ),
            Value("chi2 a cell there", f"{expected['disc_chi2_a_cell']:.3f}", meaning="1 where noise is all"),
            Value(
                "floor",
                f"{100 * FLOOR:g}",
                unit="%",
                meaning="of a disc's light, common to its cells; the verdict is repeated at half and twice",
            ),
            Value("an effect is enough where what it leaves is as likely as", f"{ENOUGH:g}"),
            *(
                Value("rounds of the real refit", str(one.rounds), meaning=f"at most {ROUNDS}")
                for one in found.corrected[:1]
            ),
        ]
    )
    files = Table(
        ["file", "SHA-256"], list(report["inputs_sha256"].items()), "Input files, by the hash of their bytes."
    )
    return [
        how,
        Details(f"All {len(report['images'])} images", (_images(report),)),
        Details(
            "Versions, seed and parameters",
            (provenance_values(report.get("provenance", {})),),
        ),
        Details(f"{len(report['inputs_sha256'])} input files with their SHA-256", (files,)),
    ]


def _images(report: Report) -> Table:
    header = [
        "file",
        "pointing",
        "time (min)",
        "exposure (s)",
        "x (px)",
        "y (px)",
        "observed (DN/s)",
        "residual (%)",
    ]
    return Table(
        [*header, "with the answer (%)"],
        [
            [
                row["file"],
                str(row["fov"]),
                f"{row['time_s'] / 60:.1f}",
                f"{row['exposure_s']:g}",
                f"{row['x_px']:.1f}",
                f"{row['y_px']:.1f}",
                f"{row['observed_dn_s']:.4g}",
                with_error(_number(row["residual_pct"]), _number(row["noise_pct"])),
                with_error(_number(row["residual_after_pct"]), _number(row["noise_after_pct"])),
            ]
            for row in report["images"]
        ],
        "Every image that took part: where its occulter was found, how bright its disc was, and what was left there, held out.",
    )


def _number(value: float | None) -> float:
    return float(np.nan) if value is None else value
