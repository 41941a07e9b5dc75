"""The table that `heliopsf report` prints, from the JSON of an evaluation."""

from __future__ import annotations

import json
from typing import Any

from psfcore.evaluation.shapes import FIGURES, ShapeErrors, ShapesByErrors
from psfcore.evaluation.summary_lines import summary_lines


def summary(fov: int | None, **changes: Any) -> dict[str, Any]:
    names = (
        "mean_pct", "mean_noise_pct", "rms_pct", "noise_pct", "gap_pct", "largest_pct", "centre_mean_pct",
    )  # fmt: skip
    return {"fov": fov, "images": 4, **{name: 0.5 + n for n, name in enumerate(names)}, **changes}


def evaluation(**changes: Any) -> dict[str, Any]:
    maps = [
        f"{kind}_pct" for kind in ("mpe_rms", "mpe_noise_rms", "mpe_largest", "mape_mean", "mape_noise_mean")
    ]
    return {
        "all": summary(None, images=8),
        "pointings": [summary(1), summary(2, centre_mean_pct=None, mean_pct=-1.25)],
        "trends": [
            {
                "fov": 1,
                "against": "x",
                "images": 4,
                "relative_pct": {"per_100_px": 0.25, "sigma": 0.125},
                "absolute_dn_s": {"per_100_px": -0.5, "sigma": 0.25},
            }
        ],
        "superposed": {name: 1.0 + n for n, name in enumerate(maps)},
        "left_out": {},
        **changes,
    }


def test_every_pointing_has_a_line_and_all_together() -> None:
    lines = summary_lines(evaluation())
    assert lines[1] == (
        "pointing 1: 4 images, mean +0.50 % (noise 1.50), rms 2.50 % (noise 3.50), largest 5.50 %; centre +6.50 %"
    )
    assert lines[2].startswith("pointing 2: 4 images, mean -1.25 %") and "centre" not in lines[2]
    assert lines[3].startswith("all pointings: 8 images")
    assert lines[5] == "pointing 1 along x: +0.25 ± 0.12 %, -0.5 ± 0.25 DN/s per 100 px"
    assert len(lines) == 6


def test_dark_offsets_and_images_that_were_left_out_are_told() -> None:
    study = {
        "offsets": [{"offset_dn": -5.0}, {"offset_dn": 3.0}],
        "largest_weight_change_pct": 4.0,
        "largest_curve_change_points": 0.25,
    }
    lines = summary_lines(evaluation(dark_offsets=study, left_out={"003.fits": "no occulter"}))
    assert "dark offsets of -5, +3 DN change the diffuse weights by at most 4.0 %" in lines[-3]
    assert lines[-2:] == ["left out: 1 images", "  003.fits: no occulter"]


def test_values_that_json_cannot_hold_are_told() -> None:
    assert "rms n/a %" in summary_lines(evaluation(all=summary(None, rms_pct=None)))[3]


def test_shapes_are_a_table_with_differences_from_the_first() -> None:
    figures = {name: (1.0 + n, 0.5) for n, name in enumerate(FIGURES)}
    less = dict.fromkeys(FIGURES, (-0.25, 0.125))
    shapes = ShapesByErrors(
        12,
        4,
        (
            ShapeErrors("softened-power-law", {}, figures, dict.fromkeys(FIGURES, (0.0, 0.0))),
            ShapeErrors("stretched", {}, figures, less),
        ),
    )
    told = json.loads(json.dumps(shapes.to_json()))
    lines = summary_lines(evaluation(), told)[6:]
    assert "errors of shapes, held out (%)" in lines[0] and "MAPE mean" in lines[0]
    assert lines[1].split()[:4] == ["softened-power-law", "2.00", "±", "0.50"]
    assert lines[3] == "differences from softened-power-law"
    assert lines[4].split()[:4] == ["stretched", "-0.25", "±", f"{0.125:.2f}"]
    assert len(lines) == 5
