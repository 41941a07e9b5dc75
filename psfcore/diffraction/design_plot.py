"""A plot of a design study of meshes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from psfcore.diffraction.design_study import DesignStudy, MeshDesign
from psfcore.drawing.plots import write_png

_COLOURS = ("#1b4f8a", "#7b3fa0", "#c2402f", "#e0a100", "#2b8a6e", "#1b1b1b")
_Number = Callable[[MeshDesign], float | None]


def design_png(study: DesignStudy, path: str | Path) -> None:
    """Draw each quantity against the pitch, one curve per wire width; a star marks the flown mesh."""
    panels: list[tuple[str, str, _Number]] = [
        ("All diffracted light", "% of all light", lambda row: row.diffracted_pct),
        ("Light beyond 10 px", "1 - encircled energy (%)", lambda row: row.beyond_10_px_pct),
        ("Light beyond 100 px", "1 - encircled energy (%)", lambda row: row.beyond_100_px_pct),
        (
            f"Contrast of the orders, flare of {study.flare_px} px",
            "contrast",
            lambda row: row.peak_visibility,
        ),
    ]
    if all(row.peak_over_scatter is not None for row in study.rows):
        panels.append(("Order divided by scatter, 50 to 150 px", "ratio", lambda row: row.peak_over_scatter))
    layout = ConstrainedLayoutEngine(w_pad=0.08, wspace=0.04)
    figure = Figure(figsize=(4.1 * len(panels), 4.6), dpi=100, facecolor="white", layout=layout)
    figure.suptitle(
        f"Entrance mesh of {study.instrument}: effect of pitch and wire width",
        x=0.01,
        ha="left",
        weight="bold",
    )
    for axes, (title, label, value) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        _panel(axes, study, value)
        axes.set_title(title, fontsize=11, loc="left")
        axes.set(xlabel="Pitch (um)", ylabel=label)
    figure.axes[0].legend(frameon=False, fontsize=9)
    write_png(figure, path)


def _panel(axes: Any, study: DesignStudy, value: _Number) -> None:
    wires = sorted({row.wire_um for row in study.rows})
    for index, wire in enumerate(wires):
        rows = [row for row in study.rows if row.wire_um == wire]
        axes.plot(
            [row.pitch_um for row in rows],
            [value(row) for row in rows],
            color=_COLOURS[index % len(_COLOURS)],
            marker="o",
            markersize=3,
            linewidth=1.5,
            label=f"wire {wire:g} um",
        )
    if study.flown is not None:
        axes.plot(
            [study.flown.pitch_um], [value(study.flown)], marker="*", markersize=13, color="#1b1b1b",
            linestyle="none", label=f"flown: pitch {study.flown.pitch_um:g}, wire {study.flown.wire_um:g} um",
        )  # fmt: skip
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_ylim(bottom=0)
    axes.grid(which="major", color="#dddddd", linewidth=0.7)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
