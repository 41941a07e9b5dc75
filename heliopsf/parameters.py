"""Parameters as users give them: numbers in the documented unit, quantities of astropy in any unit that fits, and
progress.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from astropy import units

from psfcore.deconvolve.box import LARGEST_ERROR
from psfcore.deconvolve.declaration import Edges
from psfcore.errors import DataError
from psfcore.fits.cards import Cards
from psfcore.fits.header import optional_exposure_s
from psfcore.noise import Noise

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from numpy.typing import ArrayLike, NDArray

Number: TypeAlias = "float | units.Quantity"
NoiseFigures: TypeAlias = "tuple[Number, Number] | Noise"
# A text, two slices [y, x], or two corners.
Region: TypeAlias = "str | tuple[slice, slice] | Sequence[SkyCoord | units.Quantity]"
Steps = Callable[[int, int], None]
# True: show a line on standard error; a function: call it with (step, steps); None, False: show nothing.
Progress = Steps | bool | None
Stages = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Keywords of ``deconvolve`` that all methods have.

    A number may be a quantity of astropy in a unit that fits.

    Parameters
    ----------
    hdu : int, optional
        Number of the HDU with the image. Default: the first image.
    saturation_dn : float or Quantity, optional
        Pixels at or above this level (DN) are ignored. Default: the level that the header or the instrument file gives,
        or that the pixels show.
    plate_scale_arcsec : float or Quantity, optional
        Plate scale of a PSF that gives none, arcsec/px.
    noise : (gain, read noise), optional
        DN per photon and DN rms. Default: the uncertainty of an NDData, else published figures, else figures that are
        measured in the image.
    other_channel : bool
        Whether the PSF may be of another telescope, channel or filter than the image.
    again : bool
        Deconvolve the image even if its header says that it is a product or a PSF.
    region : str, slices or corners, optional
        Deconvolve only a box of the image, which takes less time and memory: "x0:x1,y0:y1" in pixels,
        ``np.s_[y0:y1, x0:x1]``, or for a Map its two corners as ``Map.submap`` takes them. Not with ``error_draws`` and
        ``stop="discrepancy"``.
    region_error : float
        Bound of the difference from the whole image, as a share of the mean light of the region; it determines the rim
        that is also deconvolved. The card DCNVBERR has the bound.
    error_draws : int
        Number of noise realisations (2 to 64) for the standard deviation of each pixel, the ``uncertainty`` of the
        result; 8 is a good number. Each takes as long as a deconvolution. 0: no uncertainty.
    edges : {"zero", "symmetric", "extended", "periodic"}, optional
        The scene beyond the field of view. Default: the assumption that suits the method best.
    margin_px : int, optional
        Width of the margin around the field of view in which the scene is also estimated.
    threads : int, optional
        Default: all cores. The number does not change the result.
    progress : bool or function, optional
        True, or a function that is called with (step, steps) after each step.
    """

    hdu: int | None = None
    saturation_dn: Number | None = None
    plate_scale_arcsec: Number | None = None
    noise: NoiseFigures | None = None
    other_channel: bool = False
    again: bool = False
    region: Region | None = None
    region_error: Number = LARGEST_ERROR
    error_draws: int = 0
    edges: Edges | None = None
    margin_px: int | None = None
    threads: int | None = None
    progress: Progress = None


# Three names of the number of the A/D converter.
COUNTS = (units.DN, units.adu, units.ct)


def plain(name: str, value: object, *allowed: units.UnitBase) -> NDArray[np.float64]:
    """The values of a parameter in the first of these units that fits. Raises DataError "bad-quantity"."""
    expected = f"{name}: expected a number" + (f" of {allowed[0]}, or a quantity in it" if allowed else "")
    if isinstance(value, units.Quantity):
        for unit in allowed or (units.dimensionless_unscaled,):
            if value.unit.is_equivalent(unit):
                return np.asarray(value.to_value(unit), dtype=np.float64)
        raise DataError("bad-quantity", f"{expected}; got the unit {value.unit}")
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError("bad-quantity", f"{expected}; got {value!r:.80}") from error


def number(name: str, value: object, *allowed: units.UnitBase) -> float:
    """As `plain`, for one number."""
    values = plain(name, value, *allowed)
    if values.ndim or isinstance(value, str | bool):
        raise DataError("bad-quantity", f"{name}: expected one number; got {value!r:.80}")
    return float(values)


def whole(name: str, value: object, code: str, *allowed: units.UnitBase) -> int:
    """A whole number. Raises DataError with this code."""
    count = value.to_value(allowed[0]) if isinstance(value, units.Quantity) and allowed else value
    if not isinstance(count, int | float | np.integer) or isinstance(count, bool) or int(count) != count:
        raise DataError(code, f"{name}: expected a whole number; got {value!r:.80}")
    return int(count)


def noise_of(noise: object) -> Noise | None:
    """The noise figures of the user. Raises DataError "bad-noise" and "bad-quantity"."""
    if noise is None or isinstance(noise, Noise):
        return noise
    if not isinstance(noise, tuple | list | np.ndarray) or len(noise) != 2:
        raise DataError(
            "bad-noise",
            "noise: expected two numbers, photon gain (DN per photon) and read noise (DN rms), such as noise=(1.12, "
            f"1.15); got {noise!r:.80}",
        )
    gain = number("photon gain", noise[0], *COUNTS, *(one / units.ph for one in COUNTS))
    return Noise(gain, number("read noise", noise[1], *COUNTS))


def level_dn(level: object, header: Cards) -> float | None:
    """The saturation level in DN of one exposure. A level per second is multiplied by the exposure time in the header.

    Raises DataError "bad-quantity", and "no-exposure" for a level per second of an image without an exposure time.
    """
    if level is None:
        return None
    rates = tuple(one / units.s for one in COUNTS)
    if isinstance(level, units.Quantity) and any(level.unit.is_equivalent(one) for one in rates):
        exposure_s = optional_exposure_s(header)
        if exposure_s is None:
            message = (
                f"expected XPOSURE or EXPTIME in the header, because saturation_dn is in {level.unit}; got neither: "
                "give the level in DN"
            )
            raise DataError("no-exposure", message)
        return number("saturation_dn", level, *rates) * exposure_s
    return number("saturation_dn", level, *COUNTS)


def radii_px(radii: ArrayLike | units.Quantity, plate_scale_arcsec: float | None) -> NDArray[np.float64]:
    """Radii in px. Angles need the plate scale. Raises DataError "bad-quantity", and "bad-radius" if a radius is
    negative or not finite.
    """
    if isinstance(radii, units.Quantity) and radii.unit.is_equivalent(units.arcsec) and plate_scale_arcsec:
        lengths = plain("radii", radii, units.arcsec) / plate_scale_arcsec
    else:
        lengths = plain("radii", radii, units.pix)
    wrong = lengths[~((lengths >= 0) & np.isfinite(lengths))]
    if wrong.size:
        raise DataError("bad-radius", f"radii: expected finite radii of 0 px or more; got {wrong[0]:g} px")
    return lengths


def reporter(progress: Progress, stage: str) -> Steps | None:
    """The function that a computation calls with (step, steps); it shows the stage if ``progress`` is True."""
    if progress is None or progress is False:
        return None
    return _line(stage) if progress is True else progress


def stage_reporter(progress: Stages | bool | None) -> Stages:
    """The function that a computation of several stages calls with (stage, step, steps)."""
    if progress is True:
        return lambda stage, step, steps: _line(stage)(step, steps)
    return progress or (lambda stage, step, steps: None)


def _line(stage: str) -> Steps:
    def show(step: int, steps: int) -> None:
        end: Literal["\n", ""] = "\n" if step >= steps else ""
        print(f"\r{stage}: step {step} of {steps}", end=end, file=sys.stderr, flush=True)

    return show
