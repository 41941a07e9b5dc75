"""Print the evaluation in a report's JSON as a short table: errors by pointing, by pixel of the disc, and by shape."""

from __future__ import annotations

from typing import Any

TREND_PX = 100
NO_NUMBER = "n/a"
SHAPE_FIGURES = {"residual_rms_pct": "residual rms", "mpe_rms_pct": "MPE rms", "mape_mean_pct": "MAPE mean"}

Json = dict[str, Any]


def summary_lines(evaluation: Json, shapes: Json | None = None) -> list[str]:
    """The lines of the table that summarises an evaluation.

    Parameters
    ----------
    evaluation
        Result of ``psfcore.evaluation.report.report`` (schema "evaluation/1").
    shapes
        The comparison of shapes, a result of ``psfcore.evaluation.shapes.ShapesByErrors.to_json``.
    """
    maps = evaluation["superposed"]
    lines = ["simulated minus observed light in the occulter's disc, in percent of the observed light:"]
    lines += [_pointing(of) for of in (*evaluation["pointings"], evaluation["all"])]
    lines.append(
        f"errors per pixel of the disc: MPE {_number(maps['mpe_rms_pct'])} % rms, largest "
        f"{_number(maps['mpe_largest_pct'])} % "
        f"(noise alone {_number(maps['mpe_noise_rms_pct'])} % rms); MAPE {_number(maps['mape_mean_pct'])} % "
        f"(noise alone {_number(maps['mape_noise_mean_pct'])} %)"
    )
    lines += [_trend(trend) for trend in evaluation["trends"]]
    if "dark_offsets" in evaluation:
        lines.append(_dark_offsets(evaluation["dark_offsets"]))
    if evaluation["left_out"]:
        lines.append(f"left out: {len(evaluation['left_out'])} images")
        lines += [f"  {file}: {reason}" for file, reason in evaluation["left_out"].items()]
    return lines if shapes is None else [*lines, *shape_lines(shapes)]


def _pointing(of: Json) -> str:
    name = "all pointings" if of["fov"] is None else f"pointing {of['fov']}"
    centre = "" if of["centre_mean_pct"] is None else f"; centre {of['centre_mean_pct']:+.2f} %"
    return (
        f"{name}: {of['images']} images, mean {_number(of['mean_pct'], '+')} % (noise "
        f"{_number(of['mean_noise_pct'])}), rms {_number(of['rms_pct'])} % (noise {_number(of['noise_pct'])}), "
        f"largest {_number(of['largest_pct'])} %{centre}"
    )


def _trend(trend: Json) -> str:
    relative, absolute = trend["relative_pct"], trend["absolute_dn_s"]
    return (
        f"pointing {trend['fov']} along {trend['against']}: {relative['per_100_px']:+.2f} ± {relative['sigma']:.2f} %, "
        f"{absolute['per_100_px']:+.3g} ± {absolute['sigma']:.2g} DN/s per {TREND_PX} px"
    )


def _dark_offsets(study: Json) -> str:
    tried = ", ".join(f"{offset['offset_dn']:+g}" for offset in study["offsets"])
    return (
        f"dark offsets of {tried} DN change the diffuse weights by at most {study['largest_weight_change_pct']:.1f} %, "
        f"and the light beyond any radius by at most {study['largest_curve_change_points']:.2f} percentage points"
    )


def shape_lines(shapes: Json) -> list[str]:
    """The table of a comparison of shapes."""
    first, *others = shapes["shapes"]
    return [
        f"{'errors of shapes, held out (%)':<32}"
        + "".join(f"{title:>16}" for title in SHAPE_FIGURES.values()),
        *(f"  {shape['name']:<30}{_figures(shape)}" for shape in (first, *others)),
        f"differences from {first['name']}",
        *(f"  {shape['name']:<30}{_figures(shape['minus_softened_power_law'], '+')}" for shape in others),
    ]


def _figures(figures: Json, sign: str = "") -> str:
    texts = (f"{figures[name]['value']:{sign}.2f} ± {figures[name]['sigma']:.2f}" for name in SHAPE_FIGURES)
    return "".join(f"{text:>16}" for text in texts)


def _number(value: float | None, sign: str = "") -> str:
    """The value with two decimals. JSON has null in place of a value that is not finite; it is printed as "n/a"."""
    return NO_NUMBER if value is None else f"{value:{sign}.2f}"
