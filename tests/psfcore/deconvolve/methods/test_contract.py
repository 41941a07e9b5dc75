"""What a method needs, beside its equation: each fault is told as a sentence that says what to add (CONTRIBUTING.md)."""

from __future__ import annotations

from importlib import import_module
from typing import Any, get_args

import numpy as np
import pytest

from psfcore.deconvolve import extent
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_names
from psfcore.simulate.scene import observe, solar_scene
from tests.psfcore.conftest import gaussian, make_image, make_psf
from workers.contract.requests import Method
from workers.intake.costs import COSTS

STEPS = 3
LEAST_GAIN = 0.95  # a few steps must bring the estimate nearer to the scene by 5 %


def faults(name: str, module: Any) -> list[str]:
    """A sentence for each thing that a method lacks."""
    told = []
    for figures in ("MARGIN_SHARE", "WORKING_BYTES"):
        if name not in getattr(extent, figures):
            told.append(f"{name}: add its entry to {figures} of psfcore/deconvolve/extent.py")
    if name not in COSTS.kinds.deconvolve.step_ns:
        told.append(f"{name}: measure its time: python -m benchmarks.estimates --write")
    if not any(
        name in get_args(one.model_fields["name"].annotation) for one in get_args(get_args(Method)[0])
    ):
        told.append(f"{name}: add a class with its parameters to Method in workers/contract/requests.py")
    if not told and not _approaches(module):
        told.append(
            f"{name}: {STEPS} steps do not bring the estimate nearer to the scene: divide a filter in the layout of "
            "engine.transfer by engine.transfer_scale (psfcore/deconvolve/methods/linear.py)"
        )
    return told


def _approaches(module: Any) -> bool:
    scene, psf = solar_scene((96, 96), 4), make_psf(gaussian(33, 1.2))
    image = make_image(observe(scene, psf, exposure_s=1.0, photon_gain_dn=0.0, read_noise_dn=0.0, seed=1))
    estimate = module.deconvolve(image, psf, Conditions(edges="zero"), steps=STEPS).pixels
    inside = np.s_[16:-16, 16:-16]
    before, after = (np.std((one - scene)[inside]) for one in (image.pixels, estimate))
    return bool(after < LEAST_GAIN * before)


@pytest.mark.parametrize("name", method_names())
def test_a_method_has_all_that_it_needs(name: str) -> None:
    module = import_module(f"psfcore.deconvolve.methods.{name.replace('-', '_')}")
    assert faults(name, module) == []
