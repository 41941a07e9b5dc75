"""Test a PSF on the stray light of a flare, with one image during the flare and one image before the flare."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfcore.arrays import Flags, Plane
from psfcore.errors import DataError
from psfcore.fits.units import parse_unit, rate_label, unit_label
from psfcore.flare.arm_profile import BOX_PX, FlareComparison, compare_on_flare, flare_centre
from psfcore.flare.arms import measure_arms
from psfcore.image import Image
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.psf_sampling import check_compatible

ENOUGH_EXPLAINED = 0.5
WELL_MATCHED_PCT = 3.0


@dataclass(frozen=True, eq=False)
class FlareTest:
    """The comparison of a PSF with a flare, and the planes [y, x] that were used.

    Attributes
    ----------
    difference
        The light of the flare, in ``unit``.
    usable
        True for pixels that are valid in both images.
    """

    comparison: FlareComparison
    difference: Plane
    usable: Flags
    unit: str


def judge_on_flare(
    flaring: Image,
    before: Image,
    psf: Psf,
    *,
    centre_xy: tuple[float, float] | None = None,
    arm_deg: float | None = None,
    distances_px: tuple[float, float] = (10.0, 80.0),
    noise: Noise | None = None,
) -> FlareTest:
    """Simulate the stray light of a flare with ``psf``, and compare it with the observed light along a diffraction arm.

    Raises DataError "plate-scale-mismatch", "flare-shapes", "flare-units", and the errors of ``compare_on_flare`` and
    ``measure_arms``.

    Parameters
    ----------
    centre_xy
        Position of the flare, rounded to whole px; default: the position found in the images.
    arm_deg
        Direction of the arm, from +x towards +y; default: the measured direction of the arm nearest to +x.
    noise
        The noise of the camera; chi2 is computed only if it is given.
    """
    check_compatible(flaring, psf)
    light, quiet, unit = _same_unit(flaring, before)
    difference, usable = light - quiet, flaring.valid & before.valid
    x, y = centre_xy or flare_centre(difference, flaring.valid, before.valid)
    found_at = round(x), round(y)
    if arm_deg is None:
        arm_deg = _measured_arm(light, quiet, usable, found_at, distances_px[1])
    found = compare_on_flare(
        difference,
        usable,
        psf,
        found_at,
        arm_deg,
        variance=None if noise is None else _variance(noise, flaring) + _variance(noise, before),
        distances_px=distances_px,
    )
    return FlareTest(found, difference, usable, unit)


def _same_unit(flaring: Image, before: Image) -> tuple[Plane, Plane, str]:
    """Both images [y, x] in the same unit, and this unit: per second if the exposure times are known.

    Pixels without a value become 0.
    """
    if flaring.pixels.shape != before.pixels.shape:
        raise DataError(
            "flare-shapes",
            f"expected two images of the same shape; got {flaring.pixels.shape} and {before.pixels.shape}: cut both "
            "to the same field",
        )
    rates = [_rate(image) for image in (flaring, before)]
    if flaring.exposure_s is None and before.exposure_s is None and flaring.unit == before.unit:
        rates, unit = [flaring.pixels, before.pixels], unit_label(flaring)
    elif rates[0] is None or rates[1] is None:
        raise DataError(
            "flare-units",
            f"expected the exposure time of both images or of neither; got {flaring.exposure_s} and "
            f"{before.exposure_s} s: add XPOSURE to the header without it",
        )
    else:
        unit = rate_label(flaring)
    light, quiet = (np.nan_to_num(rate, posinf=0.0, neginf=0.0) for rate in rates if rate is not None)
    return light, quiet, unit


def _rate(image: Image) -> Plane | None:
    """Pixels in DN/s; None if the exposure time is unknown."""
    unit = parse_unit(image.unit)
    if unit.kind == "rate":
        return image.pixels * unit.scale
    return None if image.exposure_s is None else image.pixels / image.exposure_s


def _variance(noise: Noise, image: Image) -> Plane:
    """The variance of each pixel, in the square of the unit of the comparison."""
    rate = _rate(image)
    exposure_s = 1.0 if image.exposure_s is None else image.exposure_s
    values = np.nan_to_num(image.pixels if rate is None else rate, posinf=0.0, neginf=0.0)
    return noise.variance(values, exposure_s)


def _measured_arm(
    light: Plane, quiet: Plane, usable: Flags, centre_xy: tuple[int, int], reach_px: float
) -> float:
    """The direction (degrees) of the arm nearest to +x, measured out to reach_px."""
    try:
        found = measure_arms(
            light,
            centre_xy,
            reference=quiet,
            saturated=~usable,
            source_radius_px=BOX_PX / 2,
            reach_px=reach_px,
        )
    except DataError as error:
        raise DataError(error.code, f"{error.message}; or give the direction with --arm") from error
    return float(min(found.angles_deg, key=abs))


def summary_lines(found: FlareComparison) -> list[str]:
    """The result of the comparison, as lines to print."""
    profile = found.profile
    lines = [
        f"flare at x, y = {profile.centre_xy[0]}, {profile.centre_xy[1]}; arm at {profile.arm_deg:.2f} degrees; "
        f"{profile.distance_px.size} distances from {profile.distance_px[0]:g} to {profile.distance_px[-1]:g} px"
    ]
    for name, fit in (("total PSF", found.total), ("diffraction alone", found.diffraction)):
        if fit is not None:
            chi2 = "" if fit.chi2_per_distance is None else f", chi2 {fit.chi2_per_distance:.2f} per distance"
            lines.append(
                f"{name:<18} {fit.rms_pct:7.1f} % rms error{chi2}; fitted flare: {fit.box.sum():.3g} in "
                f"{fit.used_pixels} px"
            )
    if found.rms_factor is not None:
        chi2 = "" if found.chi2_factor is None else f" and {found.chi2_factor:.0f} times the chi2"
        lines.append(f"diffraction alone: {found.rms_factor:.1f} times the rms error{chi2} of the total PSF")
    else:
        lines.append(
            "note: the PSF file does not separate DIFFRACTION from SCATTER, so diffraction alone is not compared"
        )
    return lines + _cautions(found)


def _cautions(found: FlareComparison) -> list[str]:
    lines = []
    if found.explained < ENOUGH_EXPLAINED:
        lines.append(
            "note: outside the arm, the stray light of the fitted flare explains only "
            f"{100 * max(found.explained, 0):.0f} % "
            "of the change between the images. Something else changed too, so this comparison says little about the PSF"
        )
    noise_pct = found.total.matched_noise_pct
    if noise_pct is not None and noise_pct > WELL_MATCHED_PCT:
        lines.append(
            "note: the fit is matched to the light at 60 to 70 px, but noise makes this light uncertain by "
            f"{noise_pct:.0f} %"
        )
    return lines
