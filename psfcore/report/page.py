"""The HTML page of a report on a PSF. Every number has an error, and every caption explains how to read the figure.

The template `page.html` holds the texts. The functions of this module make the rows of its tables.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from psfcore.arrays import Vector
from psfcore.drawing.numbers import DASH, with_error
from psfcore.drawing.page import Page, render
from psfcore.evaluation.evaluation import (
    CENTRE_PX,
    INVERSION_STEPS,
    NOISE_REALISATIONS,
    Evaluation,
)
from psfcore.evaluation.report import TREND_PX, Summary, summaries, trends
from psfcore.psf import REACH_GRID_PX
from psfcore.report import plots
from psfcore.report.plots import beyond_of
from psfcore.report.report import CrossValidated, PsfReport, inputs_of
from psfcore.scatter.fit import RADII_PX, TransitFit
from psfcore.scatter.inversion import CONVERGED_POINTS
from psfcore.scatter.reconstruction import DARK_MARGIN_PX, DARK_MARGIN_SIGMAS, LEAST_DARK_PIXELS
from psfcore.scatter.total_psf import SCATTER
from psfcore.scatter.validation.cross_validation import RUNS
from psfcore.scatter.validation.robustness import DarkOffsetStudy
from psfcore.tables.lookup import TOTAL
from psfcore.transit.transit import folds

Row = list[str]
Cells = tuple[Row, list[Row]]  # the header of a table, and its rows
_CONSTANTS = {
    "CENTRE_PX": CENTRE_PX,
    "CONVERGED_POINTS": CONVERGED_POINTS,
    "DARK_MARGIN_PX": DARK_MARGIN_PX,
    "DARK_MARGIN_SIGMAS": DARK_MARGIN_SIGMAS,
    "INVERSION_STEPS": INVERSION_STEPS,
    "LEAST_DARK_PIXELS": LEAST_DARK_PIXELS,
    "NOISE_REALISATIONS": NOISE_REALISATIONS,
    "REACH_GRID_PX": REACH_GRID_PX,
    "RUNS": RUNS,
    "TREND_PX": TREND_PX,
}


def report_page(report: PsfReport, provenance: dict[str, object]) -> Page:
    """The page of a report.

    Parameters
    ----------
    provenance
        Names and values, possibly nested, that describe software and request.
    """
    of = report.transit.instrument or "an unnamed instrument"
    inputs = inputs_of(report)
    return render(
        "report/page.html",
        title=f"PSF of {of}" if report.fit is not None else f"PSF {report.psf.name} on a transit of {of}",
        lead=report.sentence,
        footer=f"heliopsf {provenance.get('software_version', '')}. Method: Hofmeister et al., A Point-Spread Function "
        "for the Extreme Ultraviolet High-Resolution Imager on board Solar Orbiter.",
        report=report,
        provenance=provenance,
        plots=plots,
        constants=_CONSTANTS,
        blocks=len(folds(len(report.transit.frames))),
        inputs=inputs,
        exposures=", ".join(f"{s:g}" for s in inputs["exposures_s"]),
        **_FUNCTIONS,
    )


def chi2_error(fit: TransitFit) -> float:
    """The expected statistical variation of chi2 per pixel."""
    return math.sqrt(2 / sum(frame.dark[0].size for frame in fit.inversion.frames))


def curve_table(report: PsfReport) -> Cells:
    """1 - encircled energy of each component at some radii, and the bands of the folds."""
    names = [name for name in (TOTAL, SCATTER) if name in report.tables["encircled"]]
    header = ["R (px)", *(f"{'total PSF' if name == TOTAL else 'diffuse scatter'} (%)" for name in names)]
    if report.cross is not None:
        header += ["folds: median (%)", "1 sigma (%)", "2 sigma (%)"]
    curves = [beyond_of(report.tables, name) for name in names]
    rows = []
    for radius in (r for r in RADII_PX if r < report.tables["reach_px"]):
        row = [f"{radius:g}"]
        for at, beyond, sigma in curves:
            row.append(with_error(float(np.interp(radius, at, beyond)), float(np.interp(radius, at, sigma))))
        if report.cross is not None:
            row += _bands_at(report.cross, radius)
        rows.append(row)
    return header, rows


def _bands_at(cross: CrossValidated, radius: float) -> Row:
    at = np.flatnonzero(cross.bands.radii_px == radius)
    return [DASH] * 3 if at.size == 0 else _band(cross.bands.curve_pct[:, at[0]], ".2f")


def _band(limits: Vector, digits: str) -> Row:
    """The median, and the ranges of one and of two standard deviations."""
    low_2, low_1, median, high_1, high_2 = (f"{limit:{digits}}" for limit in limits)
    return [median, f"{low_1} to {high_1}", f"{low_2} to {high_2}"]


def fold_rows(cross: CrossValidated, fit: TransitFit) -> list[Row]:
    """Each parameter of the fit, and its distribution over the folds."""
    values, sigma = fit.inversion.values, fit.value_sigma
    return [
        [
            f"{p.name} ({p.unit})" if p.unit else p.name,
            with_error(values[p.name], sigma[p.name]),
            *_band(cross.bands.values[p.name], ".4g"),
        ]
        for p in fit.inversion.shape.parameters
    ]


def shape_rows(fit: TransitFit) -> list[Row]:
    """Other shapes of scatter: their additional parameters, and how much they improve the fit."""
    rows = []
    for shape in fit.shapes:
        added = "; ".join(
            f"{name} {with_error(value, sigma)}" for name, (value, sigma) in shape.added.items()
        )
        held_out = DASH if shape.held_out_gain is None else f"{shape.held_out_gain:+.1f}"
        rows.append([shape.name, added, f"{shape.gain:.1f}", str(len(shape.added)), held_out])
    return rows


def offset_table(study: DarkOffsetStudy, fit: TransitFit) -> Cells:
    """The changes of the fit by each dark offset."""
    names, radii = fit.inversion.shape.names, (0.5, 10.0, 100.0)
    header = ["offset (DN)", *(f"change of {n}" for n in names), "largest change of a weight (%)"]
    header += [*(f"change of light beyond {r:g} px (points)" for r in radii), "images"]
    rows = []
    for offset in study.offsets:
        moved = [f"{offset.values[n] - study.nominal[n]:+.3g}" for n in names]
        row = [f"{offset.offset_dn:+g}", *moved, f"{np.abs(offset.weight_change_pct).max():.1f}"]
        curve = np.interp(radii, study.curve_radii_px, offset.total_curve_change_points)
        rows.append([*row, *(f"{points:+.2f}" for points in curve), str(offset.images)])
    return header, rows


def summary_rows(evaluation: Evaluation) -> list[Row]:
    """The residuals of each pointing, then of all images."""
    return [_summary_row(one, evaluation) for one in summaries(evaluation)]


def _summary_row(of: Summary, evaluation: Evaluation) -> Row:
    frames = [f for f in evaluation.frames if of.fov in (None, f.pointing)]
    largest = max(frames, key=lambda f: abs(f.residual_pct))
    mean_noise_dn_s = math.sqrt(sum(f.noise_dn_s**2 for f in frames)) / len(frames)
    return [
        "all" if of.fov is None else str(of.fov),
        str(of.images),
        with_error(of.mean_pct, of.mean_noise_pct),
        with_error(of.rms_pct, of.rms_pct / math.sqrt(2 * of.images)),
        f"{of.noise_pct:.2f}",
        with_error(largest.residual_pct, largest.noise_pct),
        with_error(of.centre_mean_pct, of.centre_noise_pct / math.sqrt(of.images)),
        with_error(of.mean_dn_s, mean_noise_dn_s),
    ]


def slope_rows(evaluation: Evaluation) -> list[Row]:
    """The slopes of the residuals along the detector axes."""
    return [
        [
            str(trend.fov),
            trend.against,
            str(trend.images),
            with_error(trend.relative_pct.per_100_px, trend.relative_pct.sigma),
            with_error(trend.absolute_dn_s.per_100_px, trend.absolute_dn_s.sigma),
        ]
        for trend in trends(evaluation)
    ]


def limits_of(report: PsfReport) -> list[str]:
    """The limits of the data as sentences, and what the report does not show."""
    limits = list(report.fit.limits) if report.fit is not None else []
    limits += [f"Not shown: {missing.what}, because {missing.why}" for missing in report.missing]
    if report.given and report.fitted_to_these:
        limits.append(
            "the PSF was fitted to these images, so its agreement with them is not an independent test"
        )
    if report.evaluation.left_out:
        limits.append(f"images that could not be evaluated, listed below: {len(report.evaluation.left_out)}")
    return [one[:1].upper() + one[1:] + "." for one in limits] or [
        "There are no limits beyond the stated errors."
    ]


def image_rows(report: PsfReport) -> list[Row]:
    """Every evaluated image."""
    exposure_s = {frame.file: frame.exposure_s for frame in report.transit.frames}
    return [
        [
            frame.file,
            str(frame.pointing),
            f"{frame.time_s / 60:.1f}",
            f"{exposure_s[frame.file]:g}",
            with_error(frame.found.place.x_px, frame.found.sigma_x_px),
            with_error(frame.found.place.y_px, frame.found.sigma_y_px),
            str(frame.dark[0].size),
            with_error(frame.observed_dn_s, frame.noise_dn_s),
            f"{frame.simulated_dn_s:.4g}",
            with_error(frame.residual_pct, frame.noise_pct),
            with_error(frame.centre_pct, frame.centre_noise_pct),
        ]
        for frame in report.evaluation.frames
    ]


_FUNCTIONS: dict[str, Callable[..., object]] = {
    one.__name__: one
    for one in (
        *(chi2_error, curve_table, fold_rows, image_rows, limits_of),
        *(offset_table, shape_rows, slope_rows, summary_rows),
    )
}
