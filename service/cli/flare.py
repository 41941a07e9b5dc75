"""The command ``flare``: a PSF judged on the stray light of a flare.

Everything numerical is imported when it is called, so that other commands start fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from service.cli.options import FILE, NOISE, OUTPUT, PLOT, check_writable, limits, user_errors, write_json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from psfcore.flare.arm_profile import FlareComparison
    from psfcore.image import Image

ENOUGH_EXPLAINED = 0.5
WELL_MATCHED_PCT = 3.0


@click.command()
@click.argument("image", type=FILE)
@click.option("--background", required=True, type=FILE, help="An image of the same frame before the flare")
@click.option("--psf", "psf_file", required=True, type=FILE, help="The PSF to judge (FITS)")
@click.option("--centre", nargs=2, type=int, metavar="X Y", help="The flare, px [default: found]")
@click.option(
    "--arm",
    "arm_deg",
    type=float,
    metavar="DEG",
    help="Direction of the arm, degrees from +x to +y [default: the measured arm nearest to +x]",
)
@click.option("--range", "distances_px", nargs=2, type=float, default=(10, 80), show_default=True, help="px")
@NOISE
@click.option("--saturation", type=float, help="DN from which pixels are not trusted")
@click.option("--json", "json_file", type=OUTPUT, help="Write profiles and figures")
@PLOT
def flare(
    image: Path,
    background: Path,
    psf_file: Path,
    centre: tuple[int, int] | None,
    arm_deg: float | None,
    distances_px: tuple[float, float],
    noise: tuple[float, float] | None,
    saturation: float | None,
    json_file: Path | None,
    plot: Path | None,
) -> None:
    """Simulate the stray light of the flare in IMAGE with a PSF, and compare it along a diffraction arm."""
    from psfcore.fits.images import read_image
    from psfcore.fits.psfs import read_psf
    from psfcore.flare.arm_profile import compare_on_flare, flare_centre
    from psfcore.psf_sampling import check_compatible

    check_writable(json_file, plot)
    with user_errors():
        flaring, before = (read_image(f, limits(), saturation_dn=saturation) for f in (image, background))
        psf = read_psf(psf_file, limits())
        check_compatible(flaring, psf)
        light, quiet, unit = _same_unit(flaring, before)
        difference = light - quiet
        usable = flaring.valid & before.valid
        found_at = centre or flare_centre(difference, flaring.valid, before.valid)
        found = compare_on_flare(
            difference,
            usable,
            psf,
            found_at,
            _measured_arm(light, quiet, usable, found_at, distances_px[1]) if arm_deg is None else arm_deg,
            variance=None if noise is None else _variance(noise, flaring) + _variance(noise, before),
            distances_px=distances_px,
        )
        if plot is not None:
            from psfcore.flare.arm_profile_plot import flare_png

            flare_png(difference, usable, found, plot, unit=unit)
    click.echo("\n".join(_lines(found)))
    if json_file is not None:
        inputs = {"image": image.name, "background": background.name, "psf": f"{psf.name} {psf.version}"}
        write_json(json_file, inputs | found.as_json())


COMMANDS = (flare,)


def _same_unit(flaring: Image, before: Image) -> tuple[NDArray[np.float64], NDArray[np.float64], str]:
    """Pixels of both [y, x], 0 where there are none, as rates where the exposures are known; and their unit."""
    import numpy as np

    from psfcore.errors import DataError

    if flaring.pixels.shape != before.pixels.shape:
        shapes = f"{flaring.pixels.shape} and {before.pixels.shape}"
        raise DataError("flare-shapes", f"expected two images of the same frame; got {shapes}")
    rates = [_rate(image) for image in (flaring, before)]
    if flaring.exposure_s is None and before.exposure_s is None and flaring.unit == before.unit:
        rates, unit = [flaring.pixels, before.pixels], flaring.unit or "image unit"
    elif rates[0] is None or rates[1] is None:
        exposures = f"{flaring.exposure_s} and {before.exposure_s} s"
        raise DataError("flare-units", f"expected the exposures of both images or of none; got {exposures}")
    else:
        unit = "DN/s"
    light, quiet = (np.nan_to_num(rate, posinf=0.0, neginf=0.0) for rate in rates if rate is not None)
    return light, quiet, unit


def _rate(image: Image) -> NDArray[np.float64] | None:
    """Pixels in DN/s, where that can be told."""
    if (image.unit or "").replace(" ", "").lower() == "dn/s":
        return image.pixels
    return None if image.exposure_s is None else image.pixels / image.exposure_s


def _variance(noise: tuple[float, float], image: Image) -> NDArray[np.float64]:
    """Variance of each pixel in the unit that both images are compared in."""
    import numpy as np

    from psfcore.noise import Noise

    rate = _rate(image)
    exposure_s = 1.0 if image.exposure_s is None else image.exposure_s
    values = np.nan_to_num(image.pixels if rate is None else rate, posinf=0.0, neginf=0.0)
    return Noise(*noise).variance(values, exposure_s)


def _measured_arm(
    light: NDArray[np.float64],
    quiet: NDArray[np.float64],
    usable: NDArray[np.bool_],
    centre_xy: tuple[int, int],
    reach_px: float,
) -> float:
    """Direction of the arm nearest to +x, measured in the image as far out as it will be used."""
    from psfcore.errors import DataError
    from psfcore.flare.arm_profile import BOX_PX
    from psfcore.flare.arms import measure_arms

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
        raise DataError(error.code, f"{error.message}; --arm gives the direction") from error
    return min(found.angles_deg, key=abs)


def _lines(found: FlareComparison) -> list[str]:
    profile = found.profile
    lines = [
        f"flare at x, y = {profile.centre_xy[0]}, {profile.centre_xy[1]}, arm at {profile.arm_deg:.2f} degrees, "
        f"{profile.distance_px.size} distances of {profile.distance_px[0]:g} to {profile.distance_px[-1]:g} px"
    ]
    for name, fit in (("total PSF", found.total), ("diffraction alone", found.diffraction)):
        if fit is not None:
            chi2 = "" if fit.chi2_per_distance is None else f", chi2 {fit.chi2_per_distance:.2f} a distance"
            lines.append(
                f"{name:<18} {fit.rms_pct:7.1f} % rms{chi2}; flare of {fit.box.sum():.3g} in {fit.used_pixels} px"
            )
    if found.rms_factor is not None:
        chi2 = "" if found.chi2_factor is None else f", {found.chi2_factor:.0f} times the chi2"
        lines.append(f"diffraction alone: {found.rms_factor:.1f} times the error{chi2}")
    else:
        lines.append("note: the PSF's file does not tell DIFFRACTION from SCATTER: nothing to compare")
    if found.explained < ENOUGH_EXPLAINED:
        lines.append(
            f"note: off the arm the box explains {100 * max(found.explained, 0):.0f} % of what changed between the images: "
            "this is not the stray light of a compact flare alone, and says little of the PSF"
        )
    noise_pct = found.total.matched_noise_pct
    if noise_pct is not None and noise_pct > WELL_MATCHED_PCT:
        lines.append(
            f"note: the light at 60 to 70 px, which the fit is held to, is known to {noise_pct:.0f} % only"
        )
    return lines
