"""Fit a scatter kernel to a transit, and diagnose the gap between the fit and the images, all in this process."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from heliopsf.parameters import NoiseFigures, Number, Stages, level_dn, noise_of, stage_reporter
from heliopsf.psfs import Psf, build_psf
from psfcore.build import check_known
from psfcore.errors import module_of_extra
from psfcore.fits.blocks import LIMITS
from psfcore.gap import diagnose
from psfcore.gap.report.report import gap_report
from psfcore.gap.verdict.calibration import COVERAGE
from psfcore.psf import Kernel
from psfcore.scatter.fit import TransitFit, fit_transit, fitted_psf
from psfcore.transit.folder import read_transit
from psfcore.transit.transit import Transit
from workers.machine import cores

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class ScatterFit(TransitFit):
    """The fit of a transit: total PSF (``kernel``), ``scatter`` kernel, curves with errors, and limits of the fit."""

    def psf(self, *, name: str | None = None, version: str = "0.1.0") -> Psf:
        """The fitted PSF, a draft: to plot it, to write it, or to deconvolve images with it.

        name: default: the name of the instrument and "-fitted". Its provenance contains the SHA-256 of the files of
        the transit.
        """
        return Psf.of(
            fitted_psf(
                self,
                name=name or f"{self.transit.instrument or 'transit'}-fitted",
                version=version,
                provenance={"inputs_sha256": dict(self.transit.sha256)},
            )
        )

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the light beyond each radius with its error. Needs the extra "plot". axes None: new axes."""
        return cast("Axes", module_of_extra("heliopsf.plots").draw_fit(self, axes))

    def quicklook(self) -> Figure:
        """A figure with curves, residuals and convergence. Needs the extra "plot"."""
        return cast("Figure", module_of_extra("psfcore.scatter.plots").fit_figure(self))


class GapDiagnosis(diagnose.Diagnosis):
    """The diagnosis of a transit: which effect explains the residuals of the fit."""

    def report(self) -> dict[str, Any]:
        """The report (JSON): verdict, probabilities, limits, cautions (docs/gap.md)."""
        return gap_report(self)

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the probabilities of the effects. Needs the extra "plot". axes None: new axes."""
        axes = module_of_extra("matplotlib.pyplot").subplots()[1] if axes is None else axes
        module_of_extra("psfcore.gap.report.plot").draw_effects(axes, self.report())
        return axes

    def quicklook(self) -> Figure:
        """A figure with residuals, maps and effects. Needs the extra "plot"."""
        return cast("Figure", module_of_extra("psfcore.gap.report.plot").gap_figure(self, self.report()))


def fit_scatter(
    transit: str | Path,
    *,
    shape: str = "softened-power-law",
    noise: NoiseFigures | None = None,
    saturation_dn: Number | None = None,
    seed: int = 1,
    threads: int | None = None,
    progress: Stages | bool | None = None,
) -> ScatterFit:
    """Fit the scatter kernel to the stray light that a transit's images show inside the occulter's disc.

    Parameters
    ----------
    transit : path
        A folder with a transit.json.
    shape : str
        The formula of the scatter kernel.
    noise : (gain, read noise), optional
        DN per photon and DN rms. Default: the values in transit.json.
    saturation_dn : float or Quantity, optional
        Pixels at or above this level (DN) are ignored. Default: the level that the header or the instrument file gives.
    seed : int
        Seed of the random numbers.
    threads : int, optional
        Default: all cores.
    progress : bool or function, optional
        True, or a function that is called with (stage, step, steps) after each step.

    Returns
    -------
    ScatterFit
        The total PSF (``kernel`` [y, x], 2048 px) and its scatter kernel; the curve of 1 - encircled energy, the parameters with
        their errors, and the limits of the fit.

    Raises
    ------
    DataError
        For example "no-manifest" or "too-few-frames".
    """
    threads = threads or cores()
    fit = fit_transit(
        _read(transit, noise, saturation_dn, threads),
        shape=shape,
        seed=seed,
        threads=threads,
        progress=stage_reporter(progress),
    )
    return ScatterFit(**{one.name: getattr(fit, one.name) for one in fields(TransitFit)})


def diagnose_gap(
    transit: str | Path,
    *,
    noise: NoiseFigures | None = None,
    saturation_dn: Number | None = None,
    coverage: float = COVERAGE,
    seed: int = 1,
    threads: int | None = None,
    progress: Stages | bool | None = None,
) -> GapDiagnosis:
    """Fit a transit and find out which effect explains the residuals of the fit.

    Parameters
    ----------
    transit, noise, saturation_dn, seed, threads, progress
        As in ``fit_scatter``, which raises the same errors.
    coverage : float
        The probability of the alternatives of each cause together: with a larger one more alternatives are told.

    Returns
    -------
    GapDiagnosis
        Its ``report()`` is the report (JSON).
    """
    threads = threads or cores()
    diagnosis = diagnose.diagnose(
        _read(transit, noise, saturation_dn, threads),
        coverage=coverage,
        seed=seed,
        threads=threads,
        progress=stage_reporter(progress),
    )
    return GapDiagnosis(**{one.name: getattr(diagnosis, one.name) for one in fields(diagnose.Diagnosis)})


def _read(transit: str | Path, noise: NoiseFigures | None, level: Number | None, threads: int) -> Transit:
    def diffraction(instrument: str | None, _shape: tuple[int, int]) -> Kernel:
        return build_psf(check_known(instrument), component="DIFFRACTION", threads=threads).kernel

    return read_transit(
        transit,
        LIMITS,
        diffraction=diffraction,
        noise=noise_of(noise),
        saturation_dn=level_dn(level, {}),
    )
