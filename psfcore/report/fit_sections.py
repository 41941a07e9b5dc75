"""Sections of the report page about the PSF and its fit: parameters, encircled energy and uncertainties."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from psfcore.drawing.page import (
    DASH,
    Figure,
    Part,
    Table,
    Value,
    Values,
    with_error,
)
from psfcore.psf import REACH_GRID_PX
from psfcore.report.plot import beyond_of, curves_png, offsets_png, profile_png, totals_png, weights_png
from psfcore.report.report import CrossValidated, PsfReport
from psfcore.scatter.fit import RADII_PX, TransitFit
from psfcore.scatter.samples import SCATTER
from psfcore.scatter.validation.bands import Excess, ShellBands
from psfcore.scatter.validation.cross_validation import RUNS
from psfcore.scatter.validation.dark_offsets import DarkOffsetStudy
from psfcore.tables.make import TOTAL
from psfcore.transit.blocks import folds


def found_sections(report: PsfReport) -> list[Part]:
    parts: list[Part] = []
    if report.fit is not None:
        fit = report.fit
        values, sigma = fit.inversion.values, fit.value_sigma
        parts.append(
            f"Diffuse scatter of the shape “{fit.inversion.shape.name}”, a weight proportional to (b + r)^-c at r px "
            "from a point, convolved with the known diffraction. Errors are one standard deviation: noise of every "
            "pixel, carried through the whole fit"
            + (
                f", times {math.sqrt(fit.overdispersion):.2f} because the discs scatter by that much more than noise."
                if fit.overdispersion > 1
                else "."
            )
        )
        parts.append(
            Values(
                [
                    *(
                        Value(p.name, values[p.name], sigma[p.name], p.unit, p.meaning)
                        for p in fit.inversion.shape.parameters
                    ),
                    Value(
                        "chi2 a pixel",
                        fit.inversion.chi2_per_pixel,
                        _chi2_error(fit),
                        meaning="1 is expected where noise is all that is left; its error is that of chance",
                    ),
                    Value(
                        "overdispersion",
                        fit.overdispersion,
                        meaning="of the disc means' chi2, 1 where chance could do it; taken into all errors",
                    ),
                ]
            )
        )
    else:
        psf = report.psf
        parts.append("This PSF was given. It is shown and judged as it is; nothing about it was fitted here.")
        parts.append(
            Values(
                [
                    Value("name", psf.name),
                    Value("version", psf.version),
                    Value("status", psf.status),
                    Value(
                        "sum",
                        psf.total,
                        meaning=f"of all weights on {' x '.join(map(str, psf.kernel.shape))} px",
                    ),
                ]
            )
        )
    parts.append(_curve_table(report))
    return parts


def _chi2_error(fit: TransitFit) -> float:
    pixels = sum(frame.dark[0].size for frame in fit.inversion.frames)
    return math.sqrt(2 / pixels)


def _curve_table(report: PsfReport) -> Table:
    """Light beyond some radii, by component, and the folds' bands where they reach."""
    names = [name for name in (TOTAL, SCATTER) if name in report.tables["encircled"]]
    header = ["R (px)", *(f"{'total' if name == TOTAL else 'diffuse'} beyond R (%)" for name in names)]
    if report.cross is not None:
        header += ["folds: median (%)", "1 sigma (%)", "2 sigma (%)"]
    curves = {name: beyond_of(report.tables, name) for name in names}
    rows = []
    for radius in (r for r in RADII_PX if r < report.tables["reach_px"]):
        row = [f"{radius:g}"]
        for name in names:
            at, beyond, sigma = curves[name]
            row.append(with_error(float(np.interp(radius, at, beyond)), float(np.interp(radius, at, sigma))))
        if report.cross is not None:
            row += _bands_at(report.cross, radius)
        rows.append(row)
    if report.cross is not None:
        how = "Folds: total PSF, median and the range that holds 68.3 and 95.5 % of the fits."
    else:
        how = "" if report.fit or report.psf.fitted else "The PSF's file holds no errors."
    return Table(
        header, rows, f"Light that lands farther than R from its point, percent of all light. {how}".rstrip()
    )


def _bands_at(cross: CrossValidated, radius: float) -> list[str]:
    found = np.flatnonzero(cross.bands.radii_px == radius)
    if found.size == 0:
        return [DASH] * 3
    low_2, low_1, median, high_1, high_2 = cross.bands.curve_pct[:, found[0]]
    return [f"{median:.2f}", f"{low_1:.2f} to {high_1:.2f}", f"{low_2:.2f} to {high_2:.2f}"]


def light_sections(report: PsfReport) -> list[Part]:
    field = max(report.transit.shape)
    beyond = (
        f" Shaded: beyond the field of {field} px, where the shape alone speaks."
        if field < REACH_GRID_PX / 2
        else ""
    )
    parts: list[Part] = []
    if report.fit is not None:
        caption = (
            "Light beyond a distance R, in percent of all light: of the total PSF (left) and of its diffuse part "
            "(right); below, the same less the fit to all images, in percent points. Lines, and bars below: the fit "
            "to all images and its own error. Blue bands: the fits of the cross-validation, from the smallest radius "
            "at which they were looked at to the largest. Blue points: shells with a weight each, a fit that knows no "
            "formula; bars are their spread over the folds, which is less than their error, because no weight goes "
            f"below zero: the differences with their whole errors stand below Figure 3.{beyond}"
        )
        alt = "Two charts of cumulative light against distance with error bands, falling from about half to zero"
    else:
        caption = f"Light beyond a distance R, in percent of all light, of the PSF as given.{beyond}"
        alt = "A chart of cumulative light against distance"
    parts.append(Figure(curves_png(report), caption, alt))
    shown = [name for name in report.tables["profile"]["mean_weight"] if name != TOTAL]
    components = "its diffraction and its diffuse scatter" if shown else "no components are in its file"
    parts.append(
        Figure(
            profile_png(report),
            f"Mean weight of a pixel over rings one pixel wide, by distance, both axes logarithmic: the total PSF and {components}. "
            "The centre stands at half a pixel. Shaded about a line: its standard error, where it is known.",
            "Radial profile of the PSF and its components over many powers of ten",
        )
    )
    if report.cross is not None and report.cross.bands.shells is not None:
        parts += _free_shells(report, report.cross.bands.shells)
    return parts


def _free_shells(report: PsfReport, shells: ShellBands) -> list[Part]:
    def excess(name: str, of: Excess) -> Value:
        within = f"light of the shells less that of the formula within {of.within_px:.3g} px, of all light"
        return Value(name, of.points, of.sigma, "points", within)

    caption = (
        "Weight of diffuse scatter by distance. Orange: the fitted shape. Blue: shells that may take any weight not "
        "below zero, held to the formula but loosely, median and spread over the folds. Neighbours trade light with "
        "one another, so that single shells scatter by far more than the light beyond a distance does (Figure 1); a run of shells on one side of the line would say that the formula is wrong there."
    )
    return [
        Figure(
            weights_png(report, shells), caption, "Diffuse weights by distance, fitted line and free shells"
        ),
        Values(
            [
                excess("free shells less formula, near the centre", shells.near_centre),
                excess("free shells less formula, where they part most", shells.largest),
            ]
        ),
    ]


def uncertainty_sections(report: PsfReport, fit: TransitFit) -> list[Part]:
    parts: list[Part] = []
    if report.cross is not None:
        parts += _cross_validation(report.cross, fit, len(folds(len(fit.transit.frames))))
    if fit.shapes:
        parts += _shapes(fit)
    if report.study is not None:
        parts += _dark_offsets(report.study, fit)
    return parts


def _cross_validation(cross: CrossValidated, fit: TransitFit, blocks: int) -> list[Part]:
    values, sigma = fit.inversion.values, fit.value_sigma
    rows = []
    for p in fit.inversion.shape.parameters:
        low_2, low_1, median, high_1, high_2 = cross.bands.values[p.name]
        rows.append(
            [
                f"{p.name} ({p.unit})" if p.unit else p.name,
                with_error(values[p.name], sigma[p.name]),
                f"{median:.4g}",
                f"{low_1:.4g} to {high_1:.4g}",
                f"{low_2:.4g} to {high_2:.4g}",
            ]
        )
    return [
        f"Each of {blocks} sequential blocks of images was held out, with a guard on both sides, and the images of the "
        f"other blocks were drawn again with repetition, in {RUNS} runs: {len(cross.fits)} fits. They share the "
        "reconstructions of the fit to all images and differ from it to first order.",
        Table(
            ["parameter", "fit, with its error", "folds: median", "1 sigma", "2 sigma"],
            rows,
            "Parameters as fitted to all images, and over the folds. A band much wider than the error says that images differ by more than noise.",
        ),
        Figure(
            totals_png(cross, fit),
            "How much light is scattered diffusely, by fold: the wider, the less the images agree. Orange: the fit to all images with its error.",
            "Histogram of diffusely scattered light over the folds",
        ),
    ]


def _shapes(fit: TransitFit) -> list[Part]:
    rows = []
    for shape in fit.shapes:
        added = "; ".join(
            f"{name} {with_error(value, sigma)}" for name, (value, sigma) in shape.added.items()
        )
        held_out = DASH if shape.held_out_gain is None else f"{shape.held_out_gain:+.1f}"
        rows.append([shape.name, added, f"{shape.gain:.1f}", str(len(shape.added)), held_out])
    return [
        Table(
            ["shape", "what it adds", "delta chi2", "parameters", "delta chi2, held out"],
            rows,
            "Other shapes of scatter, each the fitted one with parameters more, to first order. Delta chi2: by how much it "
            "describes all images better; chance gives as much as it has parameters, give or take the square root of twice that. "
            "Held out: the same on images that were not fitted; below zero, what it adds is noise.",
        )
    ]


def _dark_offsets(study: DarkOffsetStudy, fit: TransitFit) -> list[Part]:
    names = fit.inversion.shape.names
    sigma = fit.value_sigma

    def points(curve: Any, radius: float) -> str:
        return f"{float(np.interp(radius, study.curve_radii_px, curve)):+.2f}"

    rows = []
    for offset in study.offsets:
        moved = [f"{offset.values[n] - study.nominal[n]:+.3g}" for n in names]
        row = [f"{offset.offset_dn:+g}", *moved, f"{np.abs(offset.weight_change_pct).max():.1f}"]
        row += [points(offset.total_curve_change_points, r) for r in (0.5, 10.0, 100.0)]
        rows.append([*row, str(offset.images)])
    errors = ", ".join(f"{n} {sigma[n]:.2g}" for n in names)
    return [
        Table(
            [
                "offset (DN)",
                *(f"change of {n}" for n in names),
                "largest change of a weight (%)",
                *(f"light beyond {r} px (points)" for r in ("0.5", "10", "100")),
                "images",
            ],
            rows,
            f"The fit repeated with an offset added to every readout. Errors of the fit itself, to compare with: {errors}. "
            "Light: of the total PSF; diffuse weights are compared within the field.",
        ),
        Figure(
            offsets_png(study),
            "What a wrong dark level does, by distance: relative change of the diffuse weights (left), change in percent points of the light "
            "beyond a distance, diffuse as lines and total as dots (right).",
            "Changes of weights and of cumulative light for four dark offsets",
        ),
    ]
