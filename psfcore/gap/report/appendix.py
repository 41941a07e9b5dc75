"""The last sections of the gap page: the PSF, reasons for caution, all images and all input files.

The named effects are those that the verdict names as the cause of the gap ("answer" in the report).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from psfcore.drawing.page import (
    DASH,
    Bullets,
    Details,
    Part,
    Table,
    Value,
    Values,
    provenance_values,
    with_error,
)
from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.evidence.linear_model import FLOOR
from psfcore.gap.report.report import best_words, words
from psfcore.gap.verdict.correction import ROUNDS
from psfcore.scatter.reconstruction import Inversion

Report = dict[str, Any]


# --- the PSF ----------------------------------------------------------------------------------------------


def psf_parts(found: Diagnosis) -> list[Part]:
    before = found.solution.inversion
    columns = [(before, found.model.base.covariance)]
    if found.corrected:
        columns.append((found.corrected[0].solution.inversion, found.corrected[0].covariance))
    header = ["", "fitted", *(["with the named effects", "change (sigma)"] if found.corrected else [])]
    rows = [_parameter_row(k, columns) for k in range(len(before.shape.parameters))]
    rows += [_curve_row(k, radius, columns) for k, radius in enumerate(before.radii_px)]
    caption = (
        f"Parameters of the shape “{before.shape.name}”, and 1 - encircled energy of the total PSF (the percentage of the light beyond the radius). The errors of the parameters "
        f"contain noise and an error of {100 * FLOOR:g} % of the light of a disc for unknown causes. In the column “with the named effects”, the parameters of these effects were fitted as well. "
        "The errors of the encircled energy contain only noise."
    )
    optical = [words(e.name) for c in found.corrected[:1] for e in c.effects if e.stage == "optics"]
    if optical:
        caption += f" These numbers do not include the change of the PSF by {' and '.join(optical)} itself; the file of the corrected PSF includes it."
    parts: list[Part] = [Table(header, rows, caption)]
    if not found.corrected:
        parts.append("No effect was added to the model, so this diagnosis has no corrected PSF.")
    elif found.judgement.verdict == "tie":
        parts.append(
            f"“With the named effects” means with the best of the tied effects: {best_words(found)}."
        )
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
    return [f"1 - encircled energy at {radius:g} px (%)", *_compared(values, sigma)]


def _compared(values: list[float], sigma: list[float]) -> list[str]:
    """The values with their errors. For two values, also the second minus the first, in units of the error of the
    first."""
    cells = [with_error(value, s) for value, s in zip(values, sigma, strict=True)]
    if len(values) == 2:
        cells.append(f"{(values[1] - values[0]) / sigma[0]:+.1f}" if sigma[0] > 0 else DASH)
    return cells


# --- doubts, images, inputs -------------------------------------------------------------------------------


def doubts(report: Report) -> list[Part]:
    said = list(report["cautions"]) or ["These data give no reason for caution."]
    parts: list[Part] = [Bullets([one if one.endswith(".") else f"{one}." for one in said])]
    if report["untestable"]:
        rows = [[words(one["name"]), one["why"]] for one in report["untestable"]]
        parts.append(Table(["effect", "why it was not tested"], rows, "Effects that these data cannot show."))
    return parts


def made_of(found: Diagnosis, report: Report) -> list[Part]:
    expected, noise = report["expected"], found.solution.transit.noise
    how = Values(
        [
            Value("images used", f"{len(report['images'])} of {len(found.solution.transit.frames)}"),
            Value(
                "photon gain",
                noise.photon_gain_dn,
                unit="DN",
                meaning="DN per detected photon; the value that the fit used",
            ),
            Value("read noise", noise.read_noise_dn, unit="DN", meaning="rms; the value that the fit used"),
            Value(
                "residual of a fit to simulated images",
                f"{expected['residual_pct']:.2f}",
                unit="%",
                meaning="rms over the means of the discs; the fit leaves this residual if the model is right",
            ),
            Value(
                "chi2 per cell of the simulated images",
                f"{expected['disc_chi2_a_cell']:.3f}",
                meaning="1 would mean that noise is the only error",
            ),
            Value(
                "floor",
                f"{100 * FLOOR:g}",
                unit="%",
                meaning="relative error common to all cells of a disc; it accounts for causes that are in no model",
            ),
            Value(
                "calibration",
                f"{report['calibration']['cases']} simulated transits",
                meaning="made by " + report["calibration"]["command"],
            ),
            *(
                Value("rounds of the full refit", str(one.rounds), meaning=f"at most {ROUNDS}")
                for one in found.corrected[:1]
            ),
        ]
    )
    files = Table(
        ["file", "SHA-256"],
        list(report["inputs_sha256"].items()),
        "The input files, with the SHA-256 of their bytes.",
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
        [*header, "residual with the named effects (%)"],
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
        "All images that the fit used: the position of the occulter, the mean brightness of its disc, and the residual from a fit without this image.",
    )


def _number(value: float | None) -> float:
    return float(np.nan) if value is None else value
