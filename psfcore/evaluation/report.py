"""Summarise an evaluation: errors of each pointing with the expected noise, and trends across the detector.

Hofmeister et al., The point-spread function of HRI_EUV, section "Evaluation".

    slope = sum w (u - <u>) e / sum w (u - <u>)^2,   <u> = sum w u / sum w,   w = 1 / noise^2    Eq. (1)
    error of the slope = (sum w (u - <u>)^2)^(-1/2) max(1, chi2 / (N - 2))^(1/2)                 Eq. (2)

The sums run over the N images of a pointing. If e varies about the fitted line by more than noise explains, Eq. (2)
increases the error of the slope accordingly. The occulter's x and y change together along its track. Therefore the
slopes along x and along y, which come from the same images, are not independent.

| symbol | name | unit |
|---|---|---|
| u | detector x or y of the occulter | px |
| e | residual, or simulated - observed | %, DN/s |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from psfcore.arrays import Vector, json_attributes, json_values
from psfcore.evaluation.evaluation import Evaluation, FrameEvaluation, Superposed, rms
from psfcore.scatter.validation.robustness import DarkOffsetStudy

SCHEMA = "evaluation/1"
TREND_PX = 100.0  # slopes are given as the change over this number of pixels
LEAST_TREND_FRAMES = 3


@dataclass(frozen=True)
class Summary:
    """Errors of the images of one pointing. The unit is percent of the observed mean, or the unit in the name of a
    field. A field whose name begins with ``centre_`` is the same quantity for the mean PE at the centre of the disc.

    Attributes
    ----------
    fov
        The pointing; None: all pointings.
    mean_noise_pct
        Standard error of the mean from image noise.
    noise_pct
        The rms that image noise alone would cause.
    gap_pct
        The rms with the noise subtracted in quadrature.
    """

    fov: int | None
    images: int
    mean_pct: float
    mean_noise_pct: float
    rms_pct: float
    noise_pct: float
    gap_pct: float
    largest_pct: float
    mean_dn_s: float
    rms_dn_s: float
    centre_mean_pct: float
    centre_rms_pct: float
    centre_noise_pct: float


@dataclass(frozen=True)
class Slope:
    """A change over TREND_PX pixels, and the standard error of this change."""

    per_100_px: float
    sigma: float


@dataclass(frozen=True)
class Trend:
    """The change of the errors of one pointing with the position of the occulter on the detector."""

    fov: int
    against: Literal["x", "y"]
    images: int
    relative_pct: Slope
    absolute_dn_s: Slope


def sentence(evaluation: Evaluation) -> str:
    """A summary of the evaluation in two sentences."""
    whole, maps = summaries(evaluation)[-1], evaluation.superposed
    return (
        f"Residuals of {whole.images} images (simulated minus observed light in the occulter): mean "
        f"{whole.mean_pct:+.2f} %, rms {whole.rms_pct:.2f} % (noise alone {whole.noise_pct:.2f} %), largest "
        f"{whole.largest_pct:.2f} %. Errors per pixel of the disc: MPE {maps.mpe_rms_pct:.2f} % rms (noise alone "
        f"{maps.mpe_noise_rms_pct:.2f} %), MAPE {maps.mape_mean_pct:.2f} % (noise alone "
        f"{maps.mape_noise_mean_pct:.2f} %)."
    )


def summaries(evaluation: Evaluation) -> tuple[Summary, ...]:
    """One summary for each pointing, in the order of the pointings; the last summary is for all images."""
    fovs = sorted({frame.pointing for frame in evaluation.frames})
    parts = [summary_of([f for f in evaluation.frames if f.pointing == fov], fov) for fov in fovs]
    return (*parts, summary_of(evaluation.frames, None))


def summary_of(frames: Sequence[FrameEvaluation], fov: int | None) -> Summary:
    """Summary of the errors of these images."""
    residual, noise = each(frames, "residual_pct"), each(frames, "noise_pct")
    error = each(frames, "error_dn_s")
    centre, centre_noise = each(frames, "centre_pct"), each(frames, "centre_noise_pct")
    there = np.isfinite(centre)
    return Summary(
        fov=fov,
        images=len(frames),
        mean_pct=float(residual.mean()),
        mean_noise_pct=rms(noise) / math.sqrt(len(frames)),
        rms_pct=rms(residual),
        noise_pct=rms(noise),
        gap_pct=math.sqrt(max(rms(residual) ** 2 - rms(noise) ** 2, 0.0)),
        largest_pct=float(np.abs(residual).max()),
        mean_dn_s=float(error.mean()),
        rms_dn_s=rms(error),
        centre_mean_pct=float(centre[there].mean()) if there.any() else math.nan,
        centre_rms_pct=rms(centre[there]),
        centre_noise_pct=rms(centre_noise[there]),
    )


def trends(evaluation: Evaluation) -> tuple[Trend, ...]:
    """Slopes along x and y, for pointings with at least LEAST_TREND_FRAMES images at different positions."""
    found = []
    for fov in sorted({frame.pointing for frame in evaluation.frames}):
        frames = [f for f in evaluation.frames if f.pointing == fov]
        for against in ("x", "y"):
            where = np.array([getattr(f.found.place, f"{against}_px") for f in frames])
            if len(frames) < LEAST_TREND_FRAMES or np.ptp(where) < 1.0:
                continue
            relative, absolute = (
                slope_of(where, each(frames, value), each(frames, noise))
                for value, noise in (("residual_pct", "noise_pct"), ("error_dn_s", "noise_dn_s"))
            )
            found.append(Trend(fov, against, len(frames), relative, absolute))
    return tuple(found)


def slope_of(where_px: Vector, error: Vector, noise: Vector) -> Slope:
    """The slope of Eq. (1) and its error from Eq. (2), both multiplied by TREND_PX."""
    weight = noise**-2.0
    u = where_px - np.sum(weight * where_px) / weight.sum()
    spread = float(np.sum(weight * u**2))
    slope = float(np.sum(weight * u * error)) / spread  # Eq. (1)
    left = error - np.sum(weight * error) / weight.sum() - slope * u
    excess = max(1.0, float(np.sum(weight * left**2)) / max(error.size - 2, 1))
    return Slope(TREND_PX * slope, TREND_PX * math.sqrt(excess / spread))  # Eq. (2)


def each(frames: Sequence[FrameEvaluation], name: str) -> Vector:
    """An attribute of every image."""
    return np.array([getattr(frame, name) for frame in frames], dtype=np.float64)


# --- as JSON ----------------------------------------------------------------------------------------------


def report(evaluation: Evaluation, study: DarkOffsetStudy | None = None) -> dict[str, object]:
    """The evaluation as JSON: summaries, trends, every image, maps, slices and the dark offsets of `study`."""
    *pointings, whole = summaries(evaluation)
    out: dict[str, object] = {
        "schema": SCHEMA,
        "all": json_values(whole),
        "pointings": json_values(pointings),
        "trends": json_values(trends(evaluation)),
        "superposed": _superposed_json(evaluation.superposed),
        "frames": [_frame_json(frame) for frame in evaluation.frames],
        "left_out": evaluation.left_out,
        "slices": [
            {
                "file": frame.file,
                "fov": frame.pointing,
                "along_x": json_values(frame.along_x),
                "along_y": json_values(frame.along_y),
            }
            for frame in evaluation.frames
            if frame.along_x is not None and frame.along_y is not None
        ],
        "inputs_sha256": evaluation.transit.sha256,
    }
    if study is not None:
        out["dark_offsets"] = _study_json(study)
    return out


def _frame_json(frame: FrameEvaluation) -> dict[str, object]:
    centre_observed, centre_simulated = frame.centre_dn_s
    return {
        "file": frame.file,
        "fov": frame.pointing,
        "time_s": frame.time_s,
        "x": frame.found.place.x_px,
        "y": frame.found.place.y_px,
        "dark_pixels": int(frame.dark[0].size),
        **json_attributes(frame, "observed_dn_s", "simulated_dn_s", "error_dn_s", "noise_dn_s"),
        **json_attributes(frame, "residual_pct", "noise_pct"),
        "centre_observed_dn_s": json_values(centre_observed),
        "centre_simulated_dn_s": json_values(centre_simulated),
        "centre_residual_pct": json_values(frame.centre_pct),
        "centre_noise_pct": json_values(frame.centre_noise_pct),
    }


def _superposed_json(maps: Superposed) -> dict[str, object]:
    return {
        "images": maps.images,
        "registered": "to the nearest pixel",
        "centre_index": maps.half_px,
        **json_attributes(maps, "mpe_rms_pct", "mpe_noise_rms_pct", "mpe_largest_pct"),
        **json_attributes(maps, "mape_mean_pct", "mape_noise_mean_pct", "mape_largest_pct"),
        **json_attributes(maps, "count", "mpe_pct", "mape_pct", "noise_mpe_pct", "noise_mape_pct"),
    }


def _study_json(study: DarkOffsetStudy) -> dict[str, object]:
    changes = ("weight_change_pct", "curve_change_points", "total_curve_change_points")
    return {
        **json_attributes(study, "radii_px", "curve_radii_px", "nominal"),
        **{f"largest_{name}": study.largest(name) for name in changes},
        "offsets": [
            {
                "offset_dn": offset.offset_dn,
                "parameters": offset.values,
                **json_attributes(offset, "images", "converged", *changes),
            }
            for offset in study.offsets
        ],
    }
