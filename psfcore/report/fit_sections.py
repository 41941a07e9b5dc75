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
from psfcore.psf import REACH_GRID_PX, Psf
from psfcore.report.plot import beyond_of, curves_png, offsets_png, profile_png, totals_png, weights_png
from psfcore.report.report import CrossValidated, PsfReport
from psfcore.scatter.fit import RADII_PX, TransitFit
from psfcore.scatter.total_psf import SCATTER
from psfcore.scatter.validation.cross_validation import RUNS, Excess, ShellBands
from psfcore.scatter.validation.dark_offsets import DarkOffsetStudy
from psfcore.tables.make import TOTAL
from psfcore.transit.transit import folds


def found_sections(report: PsfReport) -> list[Part]:
    """A description of the fit or of the given PSF, and a table of 1 - encircled energy."""
    parts = _given(report.psf) if report.fit is None else _fitted(report.fit)
    return [*parts, _curve_table(report)]


def _fitted(fit: TransitFit) -> list[Part]:
    values, sigma = fit.inversion.values, fit.value_sigma
    enlarged = (
        f" and multiplied by {math.sqrt(fit.overdispersion):.2f}, because the disc means vary by that factor more "
        "than noise explains"
        if fit.overdispersion > 1
        else ""
    )
    parameters = [
        Value(p.name, values[p.name], sigma[p.name], p.unit, p.meaning)
        for p in fit.inversion.shape.parameters
    ]
    return [
        f"The diffuse scatter was fitted with the shape “{fit.inversion.shape.name}”: its weight at a distance of r px "
        "from the source is proportional to (b + r)^-c. The total PSF is this scatter convolved with the known "
        "diffraction PSF. Errors are standard deviations. They follow from the noise of every pixel, propagated through "
        f"the whole fit{enlarged}.",
        Values(
            [
                *parameters,
                Value(
                    "chi2 per pixel",
                    fit.inversion.chi2_per_pixel,
                    _chi2_error(fit),
                    meaning="1 is expected if only noise remains; the error is the expected statistical variation",
                ),
                Value(
                    "overdispersion",
                    fit.overdispersion,
                    meaning="chi2 of the disc means divided by its expected value, or 1 if chance explains the excess; "
                    "all errors are multiplied by the square root of the overdispersion",
                ),
            ]
        ),
    ]


def _given(psf: Psf) -> list[Part]:
    size = " x ".join(map(str, psf.kernel.shape))
    return [
        "This PSF was given. It was evaluated without changes, and no fit was made.",
        Values(
            [
                Value("name", psf.name),
                Value("version", psf.version),
                Value("status", psf.status),
                Value("sum", psf.total, meaning=f"sum of all weights on {size} px"),
            ]
        ),
    ]


def _chi2_error(fit: TransitFit) -> float:
    pixels = sum(frame.dark[0].size for frame in fit.inversion.frames)
    return math.sqrt(2 / pixels)


def _curve_table(report: PsfReport) -> Table:
    """A table of 1 - encircled energy of each component at some radii, and of the bands of the folds."""
    names = [name for name in (TOTAL, SCATTER) if name in report.tables["encircled"]]
    header = ["R (px)", *(f"{'total PSF' if name == TOTAL else 'diffuse scatter'} (%)" for name in names)]
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
        how = "Folds: median of the total PSF, and the ranges that contain 68.3 and 95.5 % of the fits."
    else:
        how = "" if report.fit or report.psf.fitted else "The PSF file contains no errors."
    return Table(
        header,
        rows,
        "1 - encircled energy within R: the light that lands farther than R from its source, in percent of all light. "
        f"{how}".rstrip(),
    )


def _bands_at(cross: CrossValidated, radius: float) -> list[str]:
    found = np.flatnonzero(cross.bands.radii_px == radius)
    if found.size == 0:
        return [DASH] * 3
    low_2, low_1, median, high_1, high_2 = cross.bands.curve_pct[:, found[0]]
    return [f"{median:.2f}", f"{low_1:.2f} to {high_1:.2f}", f"{low_2:.2f} to {high_2:.2f}"]


def light_sections(report: PsfReport) -> list[Part]:
    """Figures of 1 - encircled energy and of the radial profile, and the comparison of the fit with free shells."""
    field = max(report.transit.shape)
    beyond = (
        f" Shaded: distances beyond the field of {field} px, where the PSF is an extrapolation of its shape."
        if field < REACH_GRID_PX / 2
        else ""
    )
    parts: list[Part] = []
    if report.fit is not None:
        caption = (
            "Top: 1 - encircled energy, the percentage of all light that lands farther than R from its source, for "
            "the total PSF (left) and for its diffuse scatter alone (right). Bottom: difference from the fit to all "
            "images, in percentage points. Lines at the top and bars at the bottom show the fit to all images with its "
            "error. Blue bands show the fits of the cross-validation at the radii where they were computed. Blue points "
            "show free shells: a fit of one weight for each shell, without a formula. The bars of the blue points show "
            "the spread over the folds. This spread is smaller than the error, because a weight cannot be negative. The "
            f"values below Figure 3 have the full errors.{beyond}"
        )
        alt = (
            "Two charts of 1 - encircled energy by distance with error bands, falling from about half to zero"
        )
    else:
        caption = (
            "1 - encircled energy of the given PSF: the percentage of all light that lands farther than R from its "
            f"source.{beyond}"
        )
        alt = "A chart of 1 - encircled energy by distance"
    parts.append(Figure(curves_png(report), caption, alt))
    shown = [name for name in report.tables["profile"]["mean_weight"] if name != TOTAL]
    components = (
        "The total PSF, and its components diffraction and diffuse scatter."
        if shown
        else "The total PSF. The PSF file contains no components."
    )
    parts.append(
        Figure(
            profile_png(report),
            "Radial profile: mean weight per pixel in rings one pixel wide, by distance, on logarithmic axes. "
            f"{components} The value at half a pixel belongs to the central pixel. Shading shows the standard error of a "
            "line, if it is known.",
            "Radial profile of the PSF and its components over many powers of ten",
        )
    )
    if report.cross is not None and report.cross.bands.shells is not None:
        parts += _free_shells(report, report.cross.bands.shells)
    return parts


def _free_shells(report: PsfReport, shells: ShellBands) -> list[Part]:
    def excess(name: str, of: Excess) -> Value:
        within = f"within {of.within_px:.3g} px, in percentage points of all light"
        return Value(name, of.points, of.sigma, "points", within)

    caption = (
        "Weight of the diffuse scatter per pixel, by distance. Orange: the fitted shape. Blue: free shells, median and "
        "spread over the folds. The weight of a free shell is fitted without a formula, with a weak prior at the fitted "
        "shape; it cannot be negative. The weights of adjacent shells are anticorrelated, so they vary much more than "
        "1 - encircled energy in Figure 1. If several adjacent shells lie on the same side of the line, the formula is "
        "probably wrong there."
    )
    return [
        Figure(
            weights_png(report, shells), caption, "Diffuse weights by distance, fitted line and free shells"
        ),
        Values(
            [
                excess("light of the free shells minus the formula, near the centre", shells.near_centre),
                excess("light of the free shells minus the formula, largest difference", shells.largest),
            ]
        ),
    ]


def uncertainty_sections(report: PsfReport, fit: TransitFit) -> list[Part]:
    """The cross-validation, the comparison with other shapes, and the effect of dark offsets, if available."""
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
        f"Cross-validation: each of {blocks} sequential blocks of images was held out, with a guard on both sides, and "
        f"the images of the other blocks were resampled with replacement (bootstrap). {RUNS} such runs give "
        f"{len(cross.fits)} fits. These fits use the reconstructed scenes of the fit to all images. Their differences "
        "from the fit to all images are computed to first order.",
        Table(
            ["parameter", "fit, with its error", "folds: median", "1 sigma", "2 sigma"],
            rows,
            "Parameters of the fit to all images, and their distribution over the folds. A band much wider than the "
            "error indicates that images differ by more than noise.",
        ),
        Figure(
            totals_png(cross, fit),
            "Distribution of the total diffuse scatter over the folds. The wider it is, the less the images agree with "
            "each other. Orange: the fit to all images, with its error.",
            "Histogram of the total diffuse scatter over the folds",
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
            ["shape", "additional parameters", "delta chi2", "number added", "delta chi2, held out"],
            rows,
            "Other shapes of scatter, to first order. Each one is the fitted shape with additional parameters. Delta chi2: "
            "the decrease of chi2 for all images. If n additional parameters fit only noise, delta chi2 has the expected "
            "value n and the standard deviation sqrt(2 n). Held out: the decrease of chi2 for held-out images. A "
            "negative value indicates that the additional parameters fit noise.",
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
                *(f"change of light beyond {r} px (points)" for r in ("0.5", "10", "100")),
                "images",
            ],
            rows,
            "Effect of a wrong dark level: the fit was repeated with an offset added to every readout. For comparison, "
            f"the errors of the fit are {errors}. The changes of weights are those of the diffuse weights within the "
            "field. The light beyond a distance is 1 - encircled energy of the total PSF; the table gives its change in "
            "percentage points.",
        ),
        Figure(
            offsets_png(study),
            "Effect of a wrong dark level by distance. Left: relative change of the diffuse weights. Right: change of 1 - "
            "encircled energy in percentage points, for the diffuse scatter (solid lines) and the total PSF (dotted "
            "lines).",
            "Changes of diffuse weights and of 1 - encircled energy for four dark offsets",
        ),
    ]
