"""The HTML page of a report on a PSF. Every number has an error, and every caption explains how to read the figure."""

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
from psfcore.evaluation.frame import CENTRE_PX, FrameEvaluation, Superposed
from psfcore.evaluation.report import TREND_PX, Summary, summaries, trends
from psfcore.psf import REACH_GRID_PX
from psfcore.report.fit_sections import found_sections, light_sections, uncertainty_sections
from psfcore.report.plot import (
    intensities_png,
    maps_png,
    residuals_png,
    slices_png,
)
from psfcore.report.report import PsfReport, inputs_of
from psfcore.scatter.inversion import CONVERGED_POINTS
from psfcore.scatter.reconstruction import DARK_MARGIN_PX, DARK_MARGIN_SIGMAS, LEAST_DARK_PIXELS


def page_of(report: PsfReport, provenance: dict[str, Any]) -> Page:
    """The page of a report. provenance: names and values, possibly nested, that describe software and request."""
    of = report.transit.instrument or "an unnamed instrument"
    title = f"PSF of {of}" if report.fit is not None else f"PSF {report.psf.name} on a transit of {of}"
    sections = [
        Section("Results", found_sections(report)),
        Section("Light by distance from the source", light_sections(report)),
    ]
    if report.fit is not None:
        sections.append(Section("Uncertainties", uncertainty_sections(report, report.fit)))
    sections += [
        Section("Comparison with the observations", _observed(report.evaluation, report.how_judged)),
        Section("Limits of these data", (Bullets(_limits(report)),)),
        Section("Images", _images(report)),
        Section("Inputs and software", _made_of(report, provenance)),
    ]
    footer = f"heliopsf {provenance.get('software_version', '')}. Method: Hofmeister et al., A Point-Spread Function for the Extreme Ultraviolet High-Resolution Imager on board Solar Orbiter."
    return Page(title, report.sentence, sections, footer)


# --- observed and simulated -------------------------------------------------------------------------------


def _observed(evaluation: Evaluation, how: str) -> list[Part]:
    parts: list[Part] = [
        f"{how}. The residual of an image compares two means over all fully dark pixels: the light that the PSF scatters "
        "into the occulter, and the observed light. The residual is the first mean minus the second, divided by the "
        f"second. The centre consists of the pixels within {CENTRE_PX:g} px of the occulter's centre. Noise is photon and "
        "read noise.",
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
            "Residuals by pointing; the last row is for all images. The error of the mean comes from image noise. The "
            "error of the rms is its sampling error for this number of images. Noise: the rms expected from noise alone. "
            "Largest: the residual of the image whose residual has the largest absolute value.",
        ),
        Figure(
            slices_png(evaluation),
            "Intensity along a row (circles, solid line) and a column (squares, dashed line) through the centre of an "
            "occulter, for one image of each pointing. Points: observed. Lines: simulated. Grey: fully dark pixels. "
            "Outside the grey area, sunlight reaches the pixels directly.",
            "Observed and simulated intensity along slices through occulters",
        ),
        Figure(
            residuals_png(evaluation),
            "Residuals of disc means (top) and of disc centres (bottom) by time, detector x and detector y, coloured by "
            "pointing. Bars show one standard deviation of the noise. If noise alone causes the residuals, about one third "
            "of the bars do not include zero.",
            "Six charts of residuals about zero, by time and detector position",
        ),
    ]
    parts += _trends(evaluation)
    parts.append(
        Figure(
            intensities_png(evaluation),
            "Left: observed intensity at the centre of the occulter, with its noise, and simulated intensity, by time. "
            "Right: simulated minus observed mean intensity in DN/s, by detector x. The vertical axis is linear near "
            "zero and logarithmic beyond.",
            "Intensities in the occulter by time, and absolute errors by detector position",
        )
    )
    maps = evaluation.superposed
    parts += [
        _map_values(maps),
        Figure(maps_png(maps), _MAPS_CAPTION, "Four maps of errors by position in the disc"),
    ]
    return parts


_MAPS_CAPTION = (
    "All discs superposed, aligned to the nearest pixel. MPE: the percentage error of a pixel, averaged over the images. "
    "MAPE: the absolute value of the percentage error, averaged over the images. Beside each map is the same map for "
    "noise alone, on the same scale. If both maps look similar, noise explains the errors."
)


def _summary_row(of: Summary, evaluation: Evaluation) -> list[str]:
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
        f"Slopes of the residuals along the detector axes, per {TREND_PX:g} px. The occulter's x and y change together "
        "along its track. Therefore the slopes along x and along y are not independent."
    )
    return [
        Table(
            [
                "pointing",
                "along",
                "images",
                f"slope (% per {TREND_PX:g} px)",
                f"slope (DN/s per {TREND_PX:g} px)",
            ],
            rows,
            caption,
        )
    ]


def _map_values(maps: Superposed) -> Values:
    noise = "noise alone"
    return Values(
        [
            Value(
                "MPE, rms over the disc",
                f"{maps.mpe_rms_pct:.2f}",
                unit="%",
                meaning=f"{noise}: {maps.mpe_noise_rms_pct:.2f} %",
            ),
            Value(
                "MPE, largest of any pixel",
                f"{maps.mpe_largest_pct:.2f}",
                unit="%",
                meaning=f"noise alone, rms over the pixels: {maps.mpe_noise_rms_pct:.2f} %",
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
    said += [f"Not shown: {missing.what}, because {missing.why}" for missing in report.missing]
    if report.given and report.fitted_to_these:
        said.append(
            "the PSF was fitted to these images, so its agreement with them is not an independent test"
        )
    if report.evaluation.left_out:
        said.append(f"images that could not be evaluated, listed below: {len(report.evaluation.left_out)}")
    return [one[:1].upper() + one[1:] + "." for one in said] or [
        "There are no limits beyond the stated errors."
    ]


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
        "Every evaluated image: its time and exposure, the fitted position of its occulter, the number of fully dark "
        "pixels, and the mean observed and simulated intensity of these pixels. The errors come from noise.",
    )
    parts: list[Part] = [Details(f"All {len(frames)} images", (table,))]
    left_out = report.evaluation.left_out
    if left_out:
        why = Table(
            ["file", "reason"],
            [[file, reason] for file, reason in left_out.items()],
            "Images that could not be evaluated.",
        )
        parts.append(Details(f"Images that could not be evaluated: {len(left_out)}", (why,)))
    return parts


def _image_row(frame: FrameEvaluation, exposure_s: float) -> list[str]:
    return [
        frame.file,
        str(frame.pointing),
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
            Value("photon gain", noise.photon_gain_dn, unit="DN", meaning="DN per detected photon, as given"),
            Value("read noise", noise.read_noise_dn, unit="DN", meaning="rms, as given"),
            Value(
                "images with filled pixels",
                f"{len(prepared['frames'])}",
                meaning="the pixels were saturated or had no value",
            ),
            Value("seed", f"{report.seed}", meaning="random seed of all random samples"),
        ]
    )
    files = Table(
        ["file", "SHA-256"], list(report.transit.sha256.items()), "Input files, with the hash of their bytes."
    )
    return [
        data,
        Values(_algorithm(report)),
        provenance_values(provenance),
        Details(f"{len(report.transit.sha256)} input files with their SHA-256", (files,)),
    ]


def _algorithm(report: PsfReport) -> list[Value]:
    values = [
        Value(
            "steps of a reconstruction", f"{INVERSION_STEPS}", meaning="linear iterations, for the evaluation"
        ),
        Value(
            "noise realisations", f"{NOISE_REALISATIONS}", meaning="per image, for the maps of noise alone"
        ),
        Value(
            "fully dark pixels",
            f"{DARK_MARGIN_PX:g} px and {DARK_MARGIN_SIGMAS:g} sigma of the position",
            meaning=f"margin inside the edge of the occulter; at least {LEAST_DARK_PIXELS} pixels per image",
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
                "convergence limit",
                f"{CONVERGED_POINTS:g}",
                unit="percentage points",
                meaning="largest change of 1 - encircled energy in a round",
            ),
            Value(
                "grid on which light is counted",
                f"{REACH_GRID_PX}",
                unit="px",
                meaning="side of the square about the source",
            ),
        ]
    return values
