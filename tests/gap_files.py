"""A small transit with a gap, written as files, and the patches with which a job diagnoses it in seconds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.library import registry
from psfcore.gap.report import plot as gap_plot
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate, write
from tests.psfcore.gap.small_gaps import FEW, REACH_PX, changed, few_sign_flips, small_reach
from tests.transit_files import TRUTH, diffraction
from workers.tasks import gap as gap_task

__all__ = ["REACH_PX", "small_reach"]  # for the tests that use the files too
SIZE_PX = 96
GLOW_DN_S = 25.0
TWO = tuple(effect for effect in FEW if effect.name in ("dark_offset", "saturation_fill"))


def glow() -> NDArray[np.float64]:
    """Light at the right edge [y, x], 1 there: no effect of the library, only the added EDGE_GLOW."""
    x = (np.arange(SIZE_PX) + 0.5) / SIZE_PX - 0.5
    return np.asarray(np.exp(-(((x - 0.5) / 0.15) ** 2)) * np.ones((SIZE_PX, 1)))


EDGE_GLOW = """
import numpy as np
from psfcore.gap.effect import Change, Effect, EffectParameter

def glow(view):
    x, _ = view.places
    plane = np.exp(-(((x - 0.5) / 0.15) ** 2)).astype(np.float32)
    return [Change(lambda n, images: plane, unocculted=False)]

EFFECTS = (Effect("edge_glow", "detector", (EffectParameter("height", "DN/s", 5.0),),
    "A lamp beside the detector lights its right edge.", "a dark exposure", ("detector_x",), glow),)
"""


def write_gap(folder: Path, *, offset_dn: float = 0.0, light_dn_s: float = 0.0) -> Path:
    """Twelve images of SIZE_PX px with a wrong dark level, or with light at their right edge."""
    plan = default_plan(12, SIZE_PX, oversampling=1, brightness=8.0)
    made = simulate(plan, TRUTH, diffraction(), seed=8)
    light = light_dn_s * glow()
    transit = changed(made.transit, lambda n, frame: frame.pixels + offset_dn / frame.exposure_s + light)
    write(replace(made, transit=transit), folder)
    return folder


@contextmanager
def quick_diagnosis() -> Iterator[None]:
    """Diagnose with a library of two effects and fewer sign flips."""
    with patch.object(registry, "LIBRARY", TWO), few_sign_flips():
        yield


def answer_at_once(monkeypatch: pytest.MonkeyPatch, found: Diagnosis) -> list[dict[str, Any]]:
    """Let jobs return a diagnosis made before, with small pictures; the returned list records the jobs' arguments."""
    asked: list[dict[str, Any]] = []

    def diagnose(transit: object, **how: Any) -> Diagnosis:
        asked.append(how)
        return found

    monkeypatch.setattr(gap_task, "diagnose", diagnose)
    monkeypatch.setattr(gap_plot, "PLOT_DPI", 40)
    return asked
