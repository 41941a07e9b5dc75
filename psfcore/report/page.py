"""A report on a PSF as one page: every number with its error, every figure with how to read it."""

from __future__ import annotations

import math
from typing import Any

from psfcore.drawing.page import (
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
from psfcore.report.fit_sections import found_sections, light_sections, uncertainty_sections
from psfcore.report.plot import (
    intensities_png,
    maps_png,
    residuals_png,
    slices_png,
)
from psfcore.report.report import PsfReport, inputs_of
from psfcore.scatter.inversion import CONVERGED_POINTS, DARK_MARGIN_PX, DARK_MARGIN_SIGMAS, LEAST_DARK_PIXELS


def page_of(report: PsfReport, provenance: dict[str, Any]) -> Page:
    """The page. provenance: what made the report, as names and texts, numbers or further such."""
    of = report.transit.instrument or "a transit"
    title = f"PSF of {of}" if report.fit is not None else f"PSF {report.psf.name} on {of}"
    sections = [
        Section("What was found", found_sections(report)),
        Section("Light by distance", light_sections(report)),
    ]
    if report.fit is not None:
        sections.append(Section("How sure it is", uncertainty_sections(report, report.fit)))
    sections += [
        Section("Against what was observed", _observed(report.evaluation, report.how_judged)),
        Section("What these data cannot say", (Bullets(_limits(report)),)),
        Section("Every image", _images(report)),
        Section("What it was made of", _made_of(report, provenance)),
    ]
    footer = f"heliopsf {provenance.get('software_version', '')}. After Hofmeister et al., A Point-Spread Function for the Extreme Ultraviolet High-Resolution Imager on board Solar Orbiter."
    return Page(title, report.sentence, sections, footer)


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
