"""Makes the tables of a PSF, from which `lookup` answers questions without reading the pixels.

`psfcore.tables.lookup` describes the tables, E(R) and 1 - E(R). The radii are the same for every PSF, up to its reach:

- up to EXACT_TO_PX: every distance that a pixel can have, so that the staircase E is exact;
- up to WHOLE_TO_PX: every whole number of pixels;
- farther out: steps of 2 %, and the reach itself.

Beyond EXACT_TO_PX, E is interpolated linearly between the radii. The tables state the largest error found at test
radii.

If the PSF was fitted, the tables also hold the changes of E for a step of 1 sigma along each axis of the covariance of
the fit. These changes are computed to first order, as in the report of the fit.

| symbol | name | unit |
|---|---|---|
| R | radii_px | px |
| E | encircled | fraction of all light |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.deconvolve.assess.error_planes import sigma_points
from psfcore.psf import Psf, encircled_energy, radial_profile, squared_radii
from psfcore.scatter.shapes import DIFFERENCE, shape_named
from psfcore.scatter.total_psf import DIFFRACTION, SCATTER
from psfcore.tables.lookup import (
    EXACT_TO_PX,
    SCHEMA,
    STEP,
    TOTAL,
    WHOLE_TO_PX,
    Numbers,
    Profile,
    Tables,
)

DIGITS = 10  # significant digits of a number in the tables

Kernel = NDArray[np.float64]
Vector = NDArray[np.float64]


def tables_of(psf: Psf, *, threads: int = 1) -> Tables:
    """The tables of a PSF."""
    kernels = {TOTAL: psf.kernel, **psf.components}
    radii = table_radii(psf.reach_px)
    test_radii = _test_radii(radii)
    encircled: dict[str, Numbers] = {}
    interpolation_error: dict[str, float] = {}
    for name, kernel in kernels.items():
        both = encircled_energy(kernel, np.concatenate((radii, test_radii)))
        within, between = both[: radii.size], both[radii.size :]
        encircled[name] = _numbers(within)
        off = np.abs(np.interp(test_radii, radii, within) - between)
        interpolation_error[name] = float(off.max(initial=0.0))
    changes = _changes(psf, radii, threads)
    return {
        "schema": SCHEMA,
        "name": psf.name,
        "version": psf.version,
        "shape": list(psf.kernel.shape),
        "sum": psf.total,
        "central_weight": float(psf.kernel[psf.kernel.shape[0] // 2, psf.kernel.shape[1] // 2]),
        "reach_px": psf.reach_px,
        "plate_scale_arcsec": psf.plate_scale_arcsec,
        "radii_px": _numbers(radii),
        "exact_to_px": EXACT_TO_PX,
        "interpolation_error": interpolation_error,
        "encircled": encircled,
        "encircled_changes": {name: [_numbers(one) for one in rows[0]] for name, rows in changes.items()},
        "profile": _profile(
            kernels, {name: np.linalg.norm(rows[1], axis=0) for name, rows in changes.items()}
        ),
    }


def table_radii(reach_px: float) -> Vector:
    """The radii of the tables of a PSF with this reach, ascending, px."""
    squares = np.unique(squared_radii((2 * EXACT_TO_PX + 1, 2 * EXACT_TO_PX + 1)))
    near = np.sqrt(squares[squares <= EXACT_TO_PX**2])
    steps = int(np.ceil(np.log(max(reach_px, WHOLE_TO_PX) / WHOLE_TO_PX) / np.log(STEP)))
    far = np.rint(WHOLE_TO_PX * STEP ** np.arange(1, steps + 1))
    radii = np.concatenate((near, np.arange(EXACT_TO_PX + 1.0, WHOLE_TO_PX + 1), far))
    return np.append(radii[radii < reach_px], reach_px)


def _test_radii(radii: Vector) -> Vector:
    """Five radii within each interval beyond the staircase."""
    low, high = radii[:-1], radii[1:]
    wide = low >= EXACT_TO_PX
    shares = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    return np.asarray((low[wide, None] + (high - low)[wide, None] * shares).ravel())


def _changes(psf: Psf, radii: Vector, threads: int) -> dict[str, tuple[list[Vector], list[Vector]]]:
    """The changes of E at the radii, and of the mean weight of each ring, for 1 sigma along each axis of the
    covariance.

    The keys are the total PSF and its scatter; the dictionary is empty if the PSF was not fitted.
    """
    if psf.fitted is None or DIFFRACTION not in psf.components:
        return {}
    shape, size = shape_named(psf.fitted.shape), psf.kernel.shape[0]
    at = np.array(psf.fitted.coordinates)
    axes = sigma_points(np.zeros(at.size), np.array(psf.fitted.covariance))[: at.size] / np.sqrt(at.size)
    # Single precision suffices for derivatives, and takes half the time.
    diffract = Convolver(psf.components[DIFFRACTION], psf.kernel.shape, dtype=np.float32, threads=threads)
    of_total, of_scatter = [], []
    for axis in axes:
        step = DIFFERENCE * axis / max(float(np.abs(axis).max()), 1e-300)
        ahead, behind = shape.kernel(at + step, size), shape.kernel(at - step, size)
        change = (ahead - behind) * (float(np.abs(axis).max()) / (2 * DIFFERENCE))
        of_scatter.append(change)
        of_total.append(np.asarray(diffract.apply(change), dtype=np.float64))
    return {TOTAL: _read_off(of_total, radii), SCATTER: _read_off(of_scatter, radii)}


def _read_off(changes: list[Kernel], radii: Vector) -> tuple[list[Vector], list[Vector]]:
    """Two lists with one entry for each change of the kernel: the change of E at the radii; the change of the mean
    weight of each ring.
    """
    within = [encircled_energy(change, radii) for change in changes]
    return within, [radial_profile(change)[1] for change in changes]


def _profile(kernels: dict[str, Kernel], sigma: dict[str, Vector]) -> Profile:
    radius, mean = radial_profile(kernels[TOTAL])
    rings = radius.astype(np.int64)
    ring = np.rint(np.sqrt(squared_radii(kernels[TOTAL].shape))).astype(np.int64).ravel()
    pixels = np.bincount(ring)[rings]
    square = np.bincount(ring, weights=kernels[TOTAL].ravel() ** 2)[rings] / pixels
    rms = np.sqrt(np.maximum(square - mean**2, 0.0))
    varies = np.divide(rms, mean, out=np.zeros_like(rms), where=mean > 0)
    return {
        "radius_px": _numbers(radius),
        "pixels": pixels.tolist(),
        "mean_weight": {name: _numbers(radial_profile(kernel)[1]) for name, kernel in kernels.items()},
        "sigma": {name: _numbers(values) for name, values in sigma.items()},
        "azimuthal_rms_over_mean": _numbers(varies),
    }


def _numbers(values: Vector) -> Numbers:
    return [float(f"{value:.{DIGITS}g}") for value in values]
