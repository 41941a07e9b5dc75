"""A report on a PSF as one page: every number with its error, every figure with how to read it."""

from __future__ import annotations

import math
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
from psfcore.evaluation.evaluation import INVERSION_STEPS, NOISE_REALISATIONS, Evaluation
from psfcore.evaluation.frame import CENTRE_PX, FrameEvaluation
from psfcore.evaluation.report import TREND_PX, Summary, summaries, trends
from psfcore.evaluation.superposed import Superposed
from psfcore.psf import REACH_GRID_PX
from psfcore.report.plot import (
    beyond_of,
    curves_png,
    intensities_png,
    maps_png,
    offsets_png,
    profile_png,
    residuals_png,
    slices_png,
    totals_png,
    weights_png,
)
from psfcore.report.report import CrossValidated, PsfReport, inputs_of
from psfcore.scatter.fit import RADII_PX, TransitFit
from psfcore.scatter.inversion import CONVERGED_POINTS, DARK_MARGIN_PX, DARK_MARGIN_SIGMAS, LEAST_DARK_PIXELS
from psfcore.scatter.samples import SCATTER
from psfcore.scatter.validation.cross_validation import RUNS, Excess, ShellBands
from psfcore.scatter.validation.dark_offsets import DarkOffsetStudy
from psfcore.tables.make import TOTAL
from psfcore.transit.blocks import folds


def page_of(report: PsfReport, provenance: dict[str, Any]) -> Page:
    """The page. provenance: what made the report, as names and texts, numbers or further such."""
    of = report.transit.instrument or "a transit"
    title = f"PSF of {of}" if report.fit is not None else f"PSF {report.psf.name} on {of}"
    sections = [
        Section("What was found", _found(report)),
        Section("Light by distance", _light(report)),
    ]
    if report.fit is not None:
        sections.append(Section("How sure it is", _sure(report, report.fit)))
    sections += [
        Section("Against what was observed", _observed(report.evaluation, report.how_judged)),
        Section("What these data cannot say", (Bullets(_limits(report)),)),
        Section("Every image", _images(report)),
        Section("What it was made of", _made_of(report, provenance)),
    ]
    footer = f"heliopsf {provenance.get('software_version', '')}. After Hofmeister et al., A Point-Spread Function for the Extreme Ultraviolet High-Resolution Imager on board Solar Orbiter."
    return Page(title, report.sentence, sections, footer)


# --- the PSF ----------------------------------------------------------------------------------------------


def _found(report: PsfReport) -> list[Part]:
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


def _light(report: PsfReport) -> list[Part]:
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


# --- how sure ---------------------------------------------------------------------------------------------


def _sure(report: PsfReport, fit: TransitFit) -> list[Part]:
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


# --- observed and simulated -------------------------------------------------------------------------------


def _observed(evaluation: Evaluation, how: str) -> list[Part]:
    parts: list[Part] = [
        f"{how}. Light in every occulter as the PSF puts it there, less what was observed, over the observed mean of "
        f"the disc. Centre: pixels within {CENTRE_PX:g} px of the occulter's. Noise is that of photons and readout.",
        Table(
            [
                "pointing",
                "images",
                "mean (%)",
                "rms (%)",
                "noise (%)",
                "largest (%)",
                "centre, mean (%)",
                "mean (DN/s)",
            ],
            [_summary_row(s, evaluation) for s in summaries(evaluation)],
            "Residuals by pointing, and last of all images. Mean: with the error that noise gives it; rms: with that of so many images. "
            "Noise: the rms that noise alone would give. Largest: of one image.",
        ),
        Figure(
            slices_png(evaluation),
            "A row (circles, full line) and a column (squares, dashed) through the middle of an occulter: observed as points, simulated as lines, "
            "one image a pointing. Grey: pixels that are fully dark. Outside them the Sun is seen.",
            "Observed and simulated light along slices through occulters",
        ),
        Figure(
            residuals_png(evaluation),
            "Residuals of disc means (top) and centres (bottom), against time, detector x and detector y, coloured by pointing; bars are noise, one standard deviation. "
            "About one bar in three should miss zero.",
            "Six charts of residuals scattered about zero",
        ),
    ]
    parts += _trends(evaluation)
    parts.append(
        Figure(
            intensities_png(evaluation),
            "The light itself. Left: at the centre of the occulter by time, observed with its noise and simulated. Right: simulated less observed in DN/s by detector x; "
            "linear about zero and logarithmic beyond.",
            "Intensities in the occulter by time and absolute errors by place",
        )
    )
    maps = evaluation.superposed
    parts += [
        _map_values(maps),
        Figure(maps_png(maps), _MAPS_CAPTION, "Four maps of errors by place in the disc"),
    ]
    return parts


_MAPS_CAPTION = (
    "All discs laid on one another, to the nearest pixel. MPE: mean error of a pixel over the images; MAPE: mean of its absolute value. "
    "Beside each what noise alone gives, on the same scale: where a map on the left looks as the one on the right, nothing but noise is seen."
)


def _summary_row(of: Summary, evaluation: Evaluation) -> list[str]:
    frames = [f for f in evaluation.frames if of.fov in (None, f.fov)]
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


def _trends(evaluation: Evaluation) -> list[Part]:
    found = trends(evaluation)
    if not found:
        return []
    rows = [
        [
            str(t.fov),
            t.against,
            str(t.images),
            with_error(t.relative_pct.per_100_px, t.relative_pct.sigma),
            with_error(t.absolute_dn_s.per_100_px, t.absolute_dn_s.sigma),
        ]
        for t in found
    ]
    caption = (
        f"Slopes of residuals along the detector, over {TREND_PX:g} px. The occulter's x and y move together along its track: slopes "
        "against each are of the same images."
    )
    return [
        Table(
            [
                "pointing",
                "along",
                "images",
                f"slope (% in {TREND_PX:g} px)",
                f"slope (DN/s in {TREND_PX:g} px)",
            ],
            rows,
            caption,
        )
    ]


def _map_values(maps: Superposed) -> Values:
    noise = "what noise alone gives"
    return Values(
        [
            Value(
                "MPE, rms over the disc",
                f"{maps.mpe_rms_pct:.2f}",
                unit="%",
                meaning=f"{noise}: {maps.mpe_noise_rms_pct:.2f} %",
            ),
            Value(
                "MPE, largest of a pixel",
                f"{maps.mpe_largest_pct:.2f}",
                unit="%",
                meaning=f"noise of a pixel: {maps.mpe_noise_rms_pct:.2f} % rms",
            ),
            Value(
                "MAPE, mean over the disc",
                f"{maps.mape_mean_pct:.2f}",
                unit="%",
                meaning=f"{noise}: {maps.mape_noise_mean_pct:.2f} %",
            ),
        ]
    )


# --- limits, images, inputs -------------------------------------------------------------------------------


def _limits(report: PsfReport) -> list[str]:
    said = list(report.fit.limits) if report.fit is not None else []
    said += [f"Not shown: {missing.what}; {missing.why}" for missing in report.missing]
    if report.given and report.fitted_to_these:
        said.append("the PSF was fitted to these very images: how well it fits them is no test of it")
    if report.evaluation.left_out:
        said.append(f"{len(report.evaluation.left_out)} images could not be judged; they are listed below")
    return [one[:1].upper() + one[1:] + "." for one in said] or ["Nothing beyond the errors that are stated."]


def _images(report: PsfReport) -> list[Part]:
    frames = report.evaluation.frames
    header = [
        *("file", "pointing", "time (min)", "exposure (s)", "x (px)", "y (px)", "dark pixels"),
        *("observed (DN/s)", "simulated (DN/s)", "residual (%)", "centre (%)"),
    ]
    exposure_s = {frame.file: frame.exposure_s for frame in report.transit.frames}
    table = Table(
        header,
        [_image_row(frame, exposure_s[frame.file]) for frame in frames],
        "Every image that was judged: when, where its occulter was found, how dark it was and how dark it should be. Errors are those of noise.",
    )
    parts: list[Part] = [Details(f"All {len(frames)} images", (table,))]
    left_out = report.evaluation.left_out
    if left_out:
        why = Table(
            ["file", "why"], [[file, reason] for file, reason in left_out.items()], "Images left out."
        )
        parts.append(Details(f"{len(left_out)} images left out", (why,)))
    return parts


def _image_row(frame: FrameEvaluation, exposure_s: float) -> list[str]:
    return [
        frame.file,
        str(frame.fov),
        f"{frame.time_s / 60:.1f}",
        f"{exposure_s:g}",
        with_error(frame.found.place.x_px, frame.found.sigma_x_px),
        with_error(frame.found.place.y_px, frame.found.sigma_y_px),
        str(frame.dark[0].size),
        with_error(frame.observed_dn_s, frame.noise_dn_s),
        f"{frame.simulated_dn_s:.4g}",
        with_error(frame.residual_pct, frame.noise_pct),
        with_error(frame.centre_pct, frame.centre_noise_pct),
    ]


def _made_of(report: PsfReport, provenance: dict[str, Any]) -> list[Part]:
    inputs = inputs_of(report)
    noise = report.transit.noise
    exposures = ", ".join(f"{s:g}" for s in inputs["exposures_s"])
    prepared = inputs["prepared"]
    data = Values(
        [
            Value("images", f"{inputs['images']} of {' x '.join(map(str, inputs['shape']))} px"),
            Value("exposures", exposures, unit="s"),
            Value("photon gain", noise.photon_gain_dn, unit="DN", meaning="DN a detected photon, as given"),
            Value("readout noise", noise.read_noise_dn, unit="DN", meaning="rms, as given"),
            Value(
                "images with pixels filled in",
                f"{len(prepared['frames'])}",
                meaning="saturated, or without a value",
            ),
            Value("seed", f"{report.seed}", meaning="of all draws"),
        ]
    )
    files = Table(
        ["file", "SHA-256"], list(report.transit.sha256.items()), "Input files, by the hash of their bytes."
    )
    return [
        data,
        Values(_algorithm(report)),
        provenance_values(provenance),
        Details(f"{len(report.transit.sha256)} input files with their SHA-256", (files,)),
    ]


def _algorithm(report: PsfReport) -> list[Value]:
    values = [
        Value("steps of a reconstruction", f"{INVERSION_STEPS}", meaning="linear, for the evaluation"),
        Value("draws of noise", f"{NOISE_REALISATIONS}", meaning="for what noise alone does to the maps"),
        Value(
            "fully dark pixels",
            f"{DARK_MARGIN_PX:g} px and {DARK_MARGIN_SIGMAS:g} sigma of the place",
            meaning=f"margin inside the occulter's edge; at least {LEAST_DARK_PIXELS} pixels an image",
        ),
    ]
    if report.fit is not None:
        rounds = report.fit.inversion.rounds
        values += [
            Value(
                "rounds of the fit",
                f"{len(rounds)}",
                meaning="converged" if report.fit.inversion.converged else "not converged",
            ),
            Value(
                "taken as converged",
                f"{CONVERGED_POINTS:g}",
                unit="points",
                meaning="largest move of the cumulative curve in a round",
            ),
            Value(
                "reach that light is counted to", f"{REACH_GRID_PX}", unit="px", meaning="edge of the square"
            ),
        ]
    return values
