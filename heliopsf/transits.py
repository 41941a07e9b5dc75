"""Fit a scatter kernel to a transit, and diagnose the gap that the fit leaves. All of it runs in this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from heliopsf.psfs import LIMITS
from psfcore.gap import diagnose
from psfcore.known_diffraction import known_diffraction
from psfcore.noise import Noise
from psfcore.scatter.fit import TransitFit, fit_transit
from psfcore.transit.folder import read_transit
from psfcore.transit.transit import Transit

Progress = Callable[[str, int, int], None]


def fit_scatter(
    transit: str | Path,
    *,
    shape: str = "softened-power-law",
    noise: tuple[float, float] | None = None,
    saturation_dn: float | None = None,
    seed: int = 1,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> TransitFit:
    """Fit the scatter kernel to the stray light that a transit's images show inside the occulter's disc.

    transit: a folder with a transit.json.
    shape: the formula of the scatter kernel.
    noise: photon gain (DN per photon) and read noise (DN rms); default: the values in transit.json.
    saturation_dn: pixels at or above this level (DN) are ignored; default: the level that the instrument description
    gives for the image's gain mode.
    seed: seed of the random numbers.
    progress(stage, step, steps) is called after each step.

    The result holds the total PSF (``kernel`` [y, x], 2048 px) and its scatter kernel. It also holds the curve of
    1 - encircled energy (radius in px, light in percent), the parameters with their errors, and the limits of the fit.
    Raises ``DataError``, for example "no-manifest" or "too-few-frames".
    """
    fitted = _read(transit, noise, saturation_dn, threads)
    return fit_transit(fitted, shape=shape, seed=seed, threads=threads, progress=progress)


def diagnose_gap(
    transit: str | Path,
    *,
    noise: tuple[float, float] | None = None,
    saturation_dn: float | None = None,
    seed: int = 1,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> diagnose.Diagnosis:
    """Fit a transit and find out which effect explains the residuals of the fit.

    The parameters are those of ``fit_scatter``. ``psfcore.gap.report.report.gap_report`` turns the result into the report
    (JSON). Raises the same errors as ``fit_scatter``.
    """
    return diagnose.diagnose(
        _read(transit, noise, saturation_dn, threads), seed=seed, threads=threads, progress=progress
    )


def _read(
    transit: str | Path, noise: tuple[float, float] | None, saturation_dn: float | None, threads: int
) -> Transit:
    return read_transit(
        transit,
        LIMITS,
        diffraction=lambda instrument, _shape: known_diffraction(instrument, threads=threads),
        noise=None if noise is None else Noise(*noise),
        saturation_dn=saturation_dn,
    )
