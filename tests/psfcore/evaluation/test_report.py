"""Summaries, trends, the JSON report, the plot and the printed table of an evaluation."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from psfcore.convolution.convolver import Convolver
from psfcore.evaluation.evaluation import FrameEvaluation, evaluate
from psfcore.evaluation.plots import evaluation_png
from psfcore.evaluation.report import report, slope_of, summary_of, trends
from psfcore.evaluation.shapes import FIGURES, ShapeErrors, ShapesByErrors
from psfcore.evaluation.summary_lines import shape_lines, summary_lines
from psfcore.transit.occulter import FoundPlace
from psfcore.transit.transit import Place
from tests.psfcore.evaluation.small_evaluations import exact_scene, judged, kernel_with, noisy, offsets
from tests.psfcore.small_transits import IMAGES, SIZE_PX, noise_free, sky, with_pixels


def test_a_gradient_over_the_detector_is_found() -> None:
    """Uniform light in proportion to the occulter's x leaves D H D G e: the light that scatters within the disc."""
    clean = noise_free(sky())
    added = np.array([0.02 * f.place.x_px for f in clean.frames])  # DN/s
    transit = with_pixels(clean, [f.pixels + a for f, a in zip(clean.frames, added, strict=True)])
    found = evaluate(transit, lambda _: kernel_with())
    through = Convolver(kernel_with(), (SIZE_PX, SIZE_PX), dtype=np.float64)
    behind = exact_scene(through, np.ones((SIZE_PX, SIZE_PX)))
    left = []
    for frame, light in zip(found.frames, added, strict=True):
        disc = np.zeros((SIZE_PX, SIZE_PX))
        disc[frame.dark] = light * behind[frame.dark]
        left.append(-through.apply(disc)[frame.dark].mean())
    share = -np.array(left) / added
    assert share.min() > 0.6 and share.max() < 1
    for trend in (t for t in trends(found) if t.against == "x"):
        here = [n for n, f in enumerate(found.frames) if f.pointing == trend.fov]
        frames = [found.frames[n] for n in here]
        where = np.array([f.found.place.x_px for f in frames])
        noise = np.array([f.noise_dn_s for f in frames])
        expected = np.polyfit(where, np.array(left)[here], 1, w=1 / noise)[0]
        assert trend.absolute_dn_s.per_100_px == pytest.approx(100 * expected, rel=0.03)
        assert expected < -0.012
    for trend in trends(judged()):
        assert abs(trend.absolute_dn_s.per_100_px) < 0.02 and abs(trend.relative_pct.per_100_px) < 0.02
    assert {(t.fov, t.against, t.images) for t in trends(found)} == {
        (f, a, 4) for f in (1, 2, 3) for a in "xy"
    }


def test_a_slope_and_its_error_are_those_of_weighted_least_squares() -> None:
    rng = np.random.default_rng(5)
    where, noise = rng.uniform(0, 500, 30), rng.uniform(0.5, 3, 30)
    pulls = []
    for _ in range(300):
        error = 2.0 + 0.013 * where + noise * rng.normal(size=30)
        slope = slope_of(where, error, noise)
        pulls.append((slope.per_100_px - 1.3) / slope.sigma)
    (by_numpy, _), covariance = np.polyfit(where, error, 1, w=1 / noise, cov="unscaled")
    assert slope.per_100_px == pytest.approx(100 * by_numpy)
    assert slope.sigma >= 100 * math.sqrt(covariance[0, 0]) * (1 - 1e-9)
    assert 0.8 < np.std(pulls) < 1.05 and abs(np.mean(pulls)) < 0.2
    # If the errors scatter more than noise, the error of the slope increases accordingly.
    wild = slope_of(where, error + 8 * noise * rng.normal(size=30), noise)
    assert 5 < wild.sigma / slope.sigma < 11


def test_two_images_have_no_trend_and_a_filled_centre_has_no_error() -> None:
    transit = noise_free(sky())
    place, filled = transit.frames[5].place, np.zeros((SIZE_PX, SIZE_PX), bool)
    y, x = round(place.y_px), round(place.x_px)
    filled[y - 5 : y + 6, x - 5 : x + 6] = True
    frames = [*transit.frames[:2], *transit.frames[4:8]]
    frames[3] = dataclasses.replace(frames[3], filled=filled)
    found = evaluate(dataclasses.replace(transit, frames=tuple(frames)), lambda _: kernel_with())
    assert {t.fov for t in trends(found)} == {2}
    assert math.isnan(found.frames[3].centre_pct) and math.isnan(found.frames[3].centre_noise_pct)
    said = report(found)
    assert said["frames"][3]["centre_residual_pct"] is None
    assert math.isfinite(said["pointings"][1]["centre_mean_pct"])


def made_up(error_dn_s: float, noise_dn_s: float, observed_dn_s: float = 50.0) -> FrameEvaluation:
    rows, columns = (a.ravel() for a in np.mgrid[18:23, 28:33])
    found = FoundPlace(Place(30.0, 20.0, 10.75), 0.1, 0.1, 1.0, 4, 3, True)
    level = np.full(25, observed_dn_s)
    return FrameEvaluation(
        0, "a", 1, 0.0, found, (rows, columns), level, level + error_dn_s, noise_dn_s, 2 * noise_dn_s
    )


def test_residuals_and_summaries_are_computed_from_intensities_and_noise() -> None:
    said = summary_of([made_up(1.0, 0.5), made_up(-2.0, 0.5), made_up(4.0, 2.0, observed_dn_s=100.0)], 7)
    assert (said.fov, said.images) == (7, 3)
    assert (said.mean_pct, said.largest_pct) == pytest.approx((2 / 3, 4.0))
    assert said.rms_pct == pytest.approx(math.sqrt((4 + 16 + 16) / 3))
    assert said.noise_pct == pytest.approx(math.sqrt((1 + 1 + 4) / 3))
    assert said.mean_noise_pct == pytest.approx(math.sqrt(6) / 3)
    assert said.gap_pct == pytest.approx(math.sqrt(10))
    assert (said.mean_dn_s, said.rms_dn_s) == pytest.approx((1.0, math.sqrt(7)))
    assert said.centre_noise_pct == pytest.approx(2 * said.noise_pct)
    assert summary_of([made_up(0.1, 1.0)], 1).gap_pct == 0
    # A residual is relative to the mean observed intensity.
    uneven = {"observed": np.array([10.0, 20, 30]), "simulated": np.array([12.0, 18, 33])}
    frame = dataclasses.replace(made_up(0.0, 1.0), **uneven)
    assert (frame.residual_pct, frame.noise_pct) == pytest.approx((5.0, 5.0))
    assert frame.pe_pct.tolist() == pytest.approx([10, -10, 15])


def test_the_report_is_json_with_the_values_of_the_summary_lines() -> None:
    found = noisy(11)
    said = json.loads(json.dumps(report(found, offsets()), allow_nan=False))
    assert said["schema"] == "evaluation/1"
    assert [p["fov"] for p in said["pointings"]] == [1, 2, 3] and said["all"]["images"] == IMAGES
    assert len(said["frames"]) == IMAGES and len(said["slices"]) == 9 and len(said["trends"]) == 6
    assert said["all"]["mean_pct"] == pytest.approx(np.mean([f["residual_pct"] for f in said["frames"]]))
    maps = said["superposed"]
    middle = maps["centre_index"]
    assert maps["mape_pct"][middle][middle] > 0 and maps["mape_pct"][0][0] is None
    said["pointings"][1]["centre_mean_pct"] = said["all"]["rms_pct"] = None
    lines = summary_lines(said | {"left_out": {"003.fits": "no occulter"}})
    names = ("mean_pct", "mean_noise_pct", "rms_pct", "noise_pct", "largest_pct", "centre_mean_pct")
    assert numbers_in(lines[1]) == [round(said["pointings"][0][name], 2) for name in names]
    assert lines[2].startswith("pointing 2: 4 images") and "centre" not in lines[2]
    assert lines[4].startswith("all pointings: 12 images") and "rms n/a %" in lines[4]
    names = ("mpe_rms_pct", "mpe_largest_pct", "mpe_noise_rms_pct", "mape_mean_pct", "mape_noise_mean_pct")
    assert numbers_in(lines[5]) == [round(maps[name], 2) for name in names]
    relative = said["trends"][0]["relative_pct"]
    assert numbers_in(lines[6])[:2] == [round(relative["per_100_px"], 2), round(relative["sigma"], 2)]
    study = said["dark_offsets"]
    largest = study["largest_weight_change_pct"], study["largest_curve_change_points"]
    assert numbers_in(lines[-3]) == [round(largest[0], 1), round(largest[1], 2)] and "-5, +5 DN" in lines[-3]
    assert lines[-2:] == ["left out: 1 images", "  003.fits: no occulter"]


def numbers_in(line: str) -> list[float]:
    """The numbers of a line that have decimals."""
    return [float(number) for number in re.findall(r"[+-]?\d+\.\d+", line)]


def test_shapes_are_printed_as_a_table_with_differences_from_the_first() -> None:
    figures = {name: (1.0 + n, 0.5) for n, name in enumerate(FIGURES)}
    less = dict.fromkeys(FIGURES, (-0.25, 0.125))
    compared = (ShapeErrors("law", {}, figures, less), ShapeErrors("stretched", {}, figures, less))
    lines = shape_lines(ShapesByErrors(12, 4, compared).to_json())
    assert numbers_in(lines[1]) == [2.0, 0.5, 3.0, 0.5, 4.0, 0.5]
    assert lines[3] == "differences from law"
    assert lines[4].split()[:3] == ["stretched", "-0.25", "±"]


def test_an_evaluation_and_one_of_a_single_pointing_are_drawn(tmp_path: Path) -> None:
    path = tmp_path / "e.png"
    evaluation_png(noisy(11), path, title="a PSF", study=offsets())
    picture = imread(path)
    assert picture.shape[:2] == (1570, 1600)
    for band in np.array_split(picture[:, :, :3], 4):
        assert band.std() > 0.1
    transit = noise_free(sky())
    alone = dataclasses.replace(transit, frames=transit.frames[4:6])
    evaluation_png(evaluate(alone, lambda _: kernel_with()), tmp_path / "e.png", title="two images")
    assert imread(tmp_path / "e.png").shape[:2] == (1200, 1600)
