"""Simulate a transit from files: its diffraction PSF from an instrument or a file, its scenes from images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from psfcore.build import build_psf
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.images import read_image, read_plane
from psfcore.instruments.model import load_instrument
from psfcore.simulate.plan import WEST, Plan
from psfcore.simulate.pointings import scene_from_image

LARGEST_DIFFRACTION_PX = 2048

Plane = NDArray[np.float64]


def diffraction_kernel(
    instrument: str, file: Path | None, size: int, limits: FitsLimits, *, threads: int = 1
) -> Plane:
    """Weights of the diffraction PSF [y, x], sum 1: read from ``file``, else built for ``instrument`` on (size, size) px."""
    if file is not None:
        return read_plane(file, limits)
    kernel = build_psf(
        load_instrument(instrument), size=size, component="DIFFRACTION", threads=threads
    ).kernel
    return kernel / kernel.sum()


def scenes_from_files(files: Sequence[Path], plan: Plan, limits: FitsLimits) -> dict[int, Plane] | None:
    """A scene for each pointing, by its number; None if ``files`` is empty.

    One image serves all pointings, mirrored for the west limb; else there is one image for each pointing. Raises DataError
    "scene-count", "bad-scene".
    """
    if not files:
        return None
    if len(files) not in (1, len(plan.views)):
        message = f"expected one scene image, or {len(plan.views)} (one for each pointing); got {len(files)}"
        raise DataError("scene-count", message)
    scenes = {}
    for pointing in plan.pointings:
        rate = image_rate(files[(pointing - 1) % len(files)], limits)
        mirrored = len(files) == 1 and plan.views[pointing - 1] == WEST
        scenes[pointing] = scene_from_image(rate[:, ::-1] if mirrored else rate, plan)
    return scenes


def image_rate(file: str | Path, limits: FitsLimits) -> Plane:
    """Pixels [y, x] of an image, in DN/s if its unit is DN and its exposure time is known; else as they are."""
    image = read_image(file, limits)
    if (image.unit or "").replace(" ", "").lower() == "dn" and image.exposure_s is not None:
        return image.pixels / image.exposure_s
    return image.pixels
