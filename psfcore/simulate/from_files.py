"""The inputs of a simulated transit: a diffraction PSF from an instrument or a file, and scenes from image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from psfcore.build import build_psf
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.images import read_plane
from psfcore.fits.observation import read_observation
from psfcore.fits.units import parse_unit
from psfcore.instruments.model import load_instrument
from psfcore.simulate.plan import WEST, Plan
from psfcore.simulate.pointings import scene_from_image

LARGEST_DIFFRACTION_PX = 2048

Plane = NDArray[np.float64]


def diffraction_kernel(
    instrument: str, file: Path | None, size: int, limits: FitsLimits, *, threads: int = 1
) -> Plane:
    """Weights [y, x] of the diffraction PSF. If ``file`` is given, they are read from it and not changed.

    Otherwise they are computed for ``instrument`` on (size, size) px and divided by their sum.
    """
    if file is not None:
        return read_plane(file, limits)
    kernel = build_psf(
        load_instrument(instrument), size=size, component="DIFFRACTION", threads=threads
    ).kernel
    return kernel / kernel.sum()


def scenes_from_files(files: Sequence[Path], plan: Plan, limits: FitsLimits) -> dict[int, Plane] | None:
    """A scene for each pointing; the keys are the pointings' numbers. None if ``files`` is empty.

    A single image serves for all pointings; for the west limb it is mirrored. Otherwise ``files`` contains one image for
    each pointing. Raises DataError "scene-count", "bad-scene".
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
    """Pixels [y, x] of an image. They are divided by the exposure time if they are counts and that time is known."""
    image = read_observation(file, limits)
    if parse_unit(image.unit).kind == "count" and image.exposure_s is not None:
        return image.pixels / image.exposure_s
    return image.pixels
