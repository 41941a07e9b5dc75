"""Small files of fitted PSFs, as a fit to a transit would write them, of one telescope at several times."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from psfcore.fits.psfs import write_psf
from psfcore.psf import FittedShape, Psf, crop_centred, crop_or_pad
from psfcore.scatter import interpolation
from psfcore.scatter.shapes import SHAPES
from psfcore.scatter.total_psf import TotalPsf
from tests.psfcore.small_transits import DIFFRACTION

SIZE = 128
GRID_PX = 512  # DIFFRACTION reaches 15 px, so a larger grid gives the same kernel
EARLY = {"b_px": 6.15, "c": 2.53, "total": 0.411}
LATE = {"b_px": 5.2, "c": 2.62, "total": 0.455}


def fitted_psf(
    values: dict[str, float],
    *,
    shape: str = "softened-power-law",
    sigma: float = 0.01,
    size: int = SIZE,
    **changes: Any,
) -> Psf:
    """The PSF of these parameters, with the same error for each coordinate."""
    form = SHAPES[shape]
    at = form.coordinates(values)
    grid = max(size, GRID_PX)
    whole = TotalPsf(DIFFRACTION, form, (grid, grid)).kernel(at)
    known: dict[str, Any] = {
        "kernel": np.maximum(crop_centred(whole, (size, size)), 0.0),
        "name": "fitted",
        "version": f"0.1.0+{values['total']:g}",
        "instrument": "hri_euv",
        "status": "draft",
        "plate_scale_arcsec": 0.492,
        "components": {"DIFFRACTION": crop_or_pad(DIFFRACTION, size)},
        "fitted": FittedShape(
            shape, form.names, tuple(at.tolist()), tuple(map(tuple, (sigma**2 * np.eye(at.size)).tolist()))
        ),
    }
    return Psf(**(known | changes))


@contextmanager
def interpolated_on_a_small_grid() -> Iterator[None]:
    """Compute PSFs between two fits on 512 px instead of 2048 px: those of `fitted_psf` are the same, their curves end
    earlier."""
    with patch.object(interpolation, "REACH_GRID_PX", GRID_PX):
        yield


def write_fitted(path: Path, values: dict[str, float], **changes: Any) -> Path:
    """Write such a PSF; returns the path."""
    write_psf(path, fitted_psf(values, **changes))
    return path
