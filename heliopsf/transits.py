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
    """The fit of a scatter kernel to a transit.

    Attributes
    ----------
    transit : Transit
        The images, the occulter and the noise figures.
    solution : Solution
        The fit with its scenes and optics.
    overdispersion : float
        Factor of the variances: chi2 of the disc means per degree of freedom; 1 if chance explains the excess.
    curve : Curve
        1 - encircled energy of the total PSF, percent, with standard errors, at radii in px.
    diffuse_curve : Curve
        The same for the scatter kernel.
    kernel : ndarray of float64, shape (2048, 2048)
        The total PSF [y, x].
    scatter : ndarray of float64, shape (2048, 2048)
        The scatter kernel [y, x].
    first_guess : FirstGuess
        The light beyond the radius of the occulter's disc, as each image shows it without a fit.
    free : ShellWeightFits or None
        The fit of shells without a formula. None: the shape is not isotropic.
    shapes : tuple of ComparedShape
        The compared shapes. Empty: the fitted shape is not the softened power law.
    published : Published or None
        The fit by the published recipe. None: not asked for.
    published_alone : dict of str to Published
        The published recipe with one corrected bias each. Empty: not asked for.
    limits : tuple of str
        Sentences on what these data do not determine, and on signs that the fit is unreliable.
    """

    def psf(self, *, name: str | None = None, version: str = "0.1.0") -> Psf:
        """Make a PSF of the fit, to plot it, to write it, or to deconvolve images with it.

        Parameters
        ----------
        name : str, optional
            Default: the name of the instrument and "-fitted".
        version : str, optional
            Version of the PSF.

        Returns
        -------
        Psf
            A draft. Its ``provenance`` contains the SHA-256 of the files of the transit.
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
        """Draw the light beyond each radius with its standard error.

        Parameters
        ----------
        axes : Axes, optional
            Where to draw. Default: new axes.

        Returns
        -------
        Axes
            The axes with the curves.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
        return cast("Axes", module_of_extra("heliopsf.plots").draw_fit(self, axes))

    def quicklook(self) -> Figure:
        """Draw curves, residuals and convergence of the fit.

        Returns
        -------
        Figure
            Six panels.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
        return cast("Figure", module_of_extra("psfcore.scatter.plots").fit_figure(self))


class GapDiagnosis(diagnose.Diagnosis):
    """The diagnosis of a transit: which effect explains the residuals of the fit.

    Attributes
    ----------
    answer : Answer
        The causes with their alternatives and probabilities, and the verdict.
    calibration : Calibration
        The simulated cases from which the probability of a group of alternatives is derived.
    fits : mapping of str to EffectFit
        Linear fits of all single effects by name, the most probable first.
    told : EffectFit or None
        Linear fit of the told causes together. None: there are none.
    p_value : float
        P-value of the gap.
    limits : Limits
        Limits of all effects, and the effects that the data cannot tell apart.
    solution : Solution
        The fit of the PSF without any cause.
    model : LinearModel
        The linear model of residuals and effects.
    expected : ExpectedGap
        The residuals that remain if the model is right.
    noise : MeasuredNoise or None
        The noise that the images show. None: it could not be measured.
    where : tuple of Axis
        How much of the gap varies along each axis, and where it is largest.
    before_refit : Interval
        The gap with the PSF that was fitted together with the told causes, but without them: percent of the disc means,
        with its 90 % interval.
    rms : Interval
        The gap with the PSF refitted without any cause, likewise.
    after : Interval
        The gap with the told causes in the model, likewise.
    noise_pct : float
        Noise of the disc means, rms, percent.
    shrinking : mapping of str to Shrinking
        How far each single effect closes the gap, by name.
    shrinking_of_told : Shrinking or None
        How far the told causes close the gap together. None: there are none.
    corrected : Corrected or None
        The full refit with the told causes. None: the library has no effects to refit, or the refit failed.
    shapes : mapping of str to FieldShape
        The shape of each alternative that is another form of its family, by the name of the family.
    residual : HeldOut or None
        Residuals of held-out images without the told causes. None: no fold could be fitted.
    residual_after : HeldOut or None
        The same with the told causes.
    cautions : tuple of str
        Sentences on everything that weakens the result.
    """

    def report(self) -> dict[str, Any]:
        """Make the report of the diagnosis.

        Returns
        -------
        dict
            Verdict, probabilities, limits and cautions, as JSON values (docs/gap.md).
        """
        return dict(gap_report(self))

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the probabilities of the effects.

        Parameters
        ----------
        axes : Axes, optional
            Where to draw. Default: new axes.

        Returns
        -------
        Axes
            The axes with the probabilities.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
        axes = module_of_extra("matplotlib.pyplot").subplots()[1] if axes is None else axes
        module_of_extra("psfcore.gap.report.plot").draw_effects(axes, self.report())
        return axes

    def quicklook(self) -> Figure:
        """Draw residuals, maps and effects.

        Returns
        -------
        Figure
            The panels with their titles.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
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
    """Fit a scatter kernel to the stray light inside the occulter's disc of a transit.

    Parameters
    ----------
    transit : str or path
        A folder with a transit.json.
    shape : str, optional
        The formula of the scatter kernel, such as "stretched" or "two-power-laws".
    noise : (gain, read noise), optional
        DN per photon and DN rms. Default: the values in transit.json.
    saturation_dn : float or Quantity, optional
        Pixels at or above this level (DN) are ignored. Default: the level that the header or the instrument file gives.
    seed : int, optional
        Seed of the random numbers.
    threads : int, optional
        Number of threads. Default: all cores.
    progress : bool or function, optional
        True: show a line. A function: it is called with (stage, step, steps) after each step.

    Returns
    -------
    ScatterFit
        The total PSF (``kernel`` [y, x], 2048 px) and its scatter kernel; the curve of 1 - encircled energy, the
        parameters with their errors, and the limits of the fit.

    Raises
    ------
    DataError
        "unknown-shape", "bad-noise", "no-manifest", "too-few-frames" or another error of the transit.
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
    transit : str or path
        A folder with a transit.json.
    noise : (gain, read noise), optional
        DN per photon and DN rms. Default: the values in transit.json.
    saturation_dn : float or Quantity, optional
        Pixels at or above this level (DN) are ignored. Default: the level that the header or the instrument file gives.
    coverage : float, optional
        The probability of the alternatives of each cause together, above 0 and below 1. With a larger one more
        alternatives are told.
    seed : int, optional
        Seed of the random numbers.
    threads : int, optional
        Number of threads. Default: all cores.
    progress : bool or function, optional
        True: show a line. A function: it is called with (stage, step, steps) after each step.

    Returns
    -------
    GapDiagnosis
        Its ``report()`` is the report (JSON).

    Raises
    ------
    DataError
        "bad-coverage", and the errors of ``fit_scatter`` except "unknown-shape".
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
