"""Compare the times of calls for which a person waits with their goals; part of `make bench`.

Times and goals are ratios to 1 F (see benchmarks/timing.py), so that they hold on another machine too. Each goal
is about twice the ratio measured when it was set.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.figures import tell
from benchmarks.timing import reference, seconds
from psfcore.diffraction.design_study import design_study
from psfcore.diffraction.mesh_series import rotated_mesh_kernel
from psfcore.drawing.plots import preview_png
from psfcore.instruments.model import load_instrument

REPEATS = 3
ORDER_SPACING_PX = 5.7365  # of the entrance mesh of HRI_EUV


def calls(folder: Path) -> dict[str, Callable[[], object]]:
    """The timed calls by name."""
    hri = load_instrument("hri_euv")
    plane = np.random.default_rng(0).random((2048, 2048)) * 1000
    pitches_um = [300.0 + 300 * step for step in range(8)]
    return {
        "preview, 2048 px": lambda: preview_png(
            plane, plane * 1.1, folder / "preview.png", title="timed", unit="DN/s"
        ),
        "orders of a rotated mesh, 2048 px": lambda: rotated_mesh_kernel(
            ORDER_SPACING_PX, pitch_um=1270.0, wire_um=40.0, windows=37, angle_deg=45.0, size=2048
        ),
        "design study of 32 meshes": lambda: design_study(hri, pitches_um, [20, 30, 40, 50]),
    }


def main() -> None:
    f_s = reference()
    print(f"1 F = {f_s:.3f} s; shortest of {REPEATS} runs, after one that compiles")
    with TemporaryDirectory(prefix="heliopsf-quick-") as folder:
        for what, call in calls(Path(folder)).items():
            call()
            tell(what, seconds(call, REPEATS) / f_s)


if __name__ == "__main__":
    main()
