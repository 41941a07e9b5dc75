"""The separation of the mirrors that focuses a telescope on its detector.

Hofmeister et al., The point-spread function of HRI_EUV, section "The instrument", prints radii and distances that
are not consistent: with them the detector is far out of focus. This module solves for the separation of the mirrors.
The focus is most sensitive to this length, because the secondary magnifies an error of this length. All other lengths
keep their printed values, and the result states by how much the separation was shifted.

Rays near the axis meet on the detector where y(L) = 0 in Eq. (1) of light_path:

    s = f1 - L / (1 - L / f2)                                                                      Eq. (1)

The search for best focus starts at this separation. Best focus is the separation at which the wave through the open
aperture, without meshes, has the largest intensity on the axis. Light in the pixels of the detector would be a less
precise criterion, because the pixels are too coarse.

| symbol | name | unit |
|---|---|---|
| s | separation_mm, of the mirrors | mm |
| L | secondary_to_detector_mm | mm |
| f1, f2 | focal_mm of primary and secondary | mm |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from psfcore.diffraction.fresnel import MM_PER_UM, FresnelStep, Grid, Vector, Wave, binned_light
from psfcore.diffraction.light_path import REACH_PX, SAMPLES_PER_PIXEL, LightPath, focal_mm
from psfcore.errors import DataError

SEARCH_MM = 0.05
TOLERANCE_MM = 1e-5
HIGHEST_ORDER = 15


@dataclass(frozen=True)
class BestFocus:
    """The separation of best focus, and the quantities that follow from it.

    printed_blur_px: width of the geometric image of a point at the printed separation.
    beyond_central_pixel_*: share of the light outside the central pixel, at the printed separation and in focus. This
    share is computed in one dimension, for the open aperture without meshes.
    nominal_focal_length_mm: the focal length of the instrument file.
    order_spacing_px: spacing of the orders of the entrance mesh, measured in the focused image. The distance from order
    -`orders` to order +`orders` is divided by 2 x `orders`.
    """

    printed_separation_mm: float
    separation_mm: float
    shift_mm: float
    paraxial_separation_mm: float
    focal_length_mm: float
    nominal_focal_length_mm: float
    order_spacing_px: float
    orders: int
    focal_length_from_orders_mm: float
    printed_blur_px: float
    beyond_central_pixel_printed: float
    beyond_central_pixel_focused: float
    message: str


class _WithoutWheel:
    """Waves from the aperture to the detector without the mesh of the filter wheel."""

    def __init__(self, path: LightPath) -> None:
        self.path = path
        self.detector = path.detector_grid
        length_mm = path.secondary_to_detector_mm
        self._secondary = path.secondary_grid(self.detector.width_mm, length_mm)
        self._aperture, self._primary = path.entrance_grids()
        self._step = FresnelStep(self._secondary, self.detector, length_mm)
        # At x2 = 0, the integral in Eq. (1) of fresnel is the sum of E1 times this phase factor.
        self._to_axis = np.exp(1j * np.pi / path.wavelength_mm / length_mm * self._secondary.x_mm**2)

    def at_primary(self, openings_mm: Vector) -> Wave:
        return self.path.field_at_primary(openings_mm, self._aperture, self._primary)

    def on_axis(self, at_primary: Wave, separation_mm: float) -> float:
        """Intensity on the axis, in arbitrary units."""
        return float(np.abs(np.dot(self._at_secondary(at_primary, separation_mm), self._to_axis)) ** 2)

    def at_detector(self, at_primary: Wave, separation_mm: float) -> Wave:
        return self._step.apply(self._at_secondary(at_primary, separation_mm))

    def _at_secondary(self, at_primary: Wave, separation_mm: float) -> Wave:
        return self.path.field_at_secondary(at_primary, self._primary, self._secondary, separation_mm)


def paraxial_separation_mm(path: LightPath) -> float:
    """The separation at which rays near the axis meet on the detector, Eq. (1).

    Raises DataError "no-focus" if there is no such separation.
    """
    f1, f2, length = focal_mm(path.primary), focal_mm(path.secondary), path.secondary_to_detector_mm
    separation_mm = f1 - length * f2 / (f2 - length) if f2 != length else 0.0  # Eq. (1)
    if separation_mm <= 0:
        found = f"{separation_mm:g} mm" if f2 != length else "no finite separation"
        raise DataError(
            "no-focus",
            f"expected mirrors that can focus on the detector at a positive separation; got {found}: "
            "correct their radii or distances in the instrument file",
        )
    return separation_mm


def best_focus(path: LightPath, *, nominal_focal_length_mm: float) -> BestFocus:
    """Solve for the separation of best focus.

    nominal_focal_length_mm: the focal length of the instrument file, for comparison. Raises DataError "no-focus" if there
    is no maximum within SEARCH_MM of the paraxial separation.
    """
    waves = _WithoutWheel(path)
    at_primary = waves.at_primary(path.aperture_mm)
    paraxial_mm = paraxial_separation_mm(path)
    separation_mm = _sharpest(waves, at_primary, paraxial_mm)
    spacing_px, orders = _order_spacing_px(waves, separation_mm)
    printed_mm = path.printed_separation_mm
    pitch_mm = path.entrance_mesh.pitch_um * MM_PER_UM
    return BestFocus(
        printed_separation_mm=printed_mm,
        separation_mm=separation_mm,
        shift_mm=separation_mm - printed_mm,
        paraxial_separation_mm=paraxial_mm,
        focal_length_mm=path.focal_length_mm(separation_mm),
        nominal_focal_length_mm=nominal_focal_length_mm,
        order_spacing_px=spacing_px,
        orders=orders,
        focal_length_from_orders_mm=spacing_px * path.pixel_mm * pitch_mm / path.wavelength_mm,
        printed_blur_px=path.beam_mm(printed_mm, path.secondary_to_detector_mm) / path.pixel_mm,
        beyond_central_pixel_printed=_beyond_central_pixel(waves, at_primary, printed_mm),
        beyond_central_pixel_focused=_beyond_central_pixel(waves, at_primary, separation_mm),
        message=(
            f"mirror separation moved from the printed {printed_mm:.3f} mm by {separation_mm - printed_mm:+.3f} mm "
            f"to {separation_mm:.3f} mm. There the wave through the open aperture is most intense on the axis"
        ),
    )


def _sharpest(waves: _WithoutWheel, at_primary: Wave, paraxial_mm: float) -> float:
    found = minimize_scalar(
        lambda separation_mm: -waves.on_axis(at_primary, separation_mm),
        bounds=(paraxial_mm - SEARCH_MM, paraxial_mm + SEARCH_MM),
        method="bounded",
        options={"xatol": TOLERANCE_MM},
    )
    separation_mm = float(found.x)
    if abs(separation_mm - paraxial_mm) > 0.95 * SEARCH_MM:
        raise DataError(
            "no-focus",
            f"expected best focus within {SEARCH_MM} mm of the paraxial separation {paraxial_mm:.3f} mm; got no maximum "
            "there: correct the radii or distances of the mirrors in the instrument file",
        )
    return separation_mm


def _order_spacing_px(waves: _WithoutWheel, separation_mm: float) -> tuple[float, int]:
    """Mean spacing (px) of the orders of the entrance mesh, measured between the orders -n and +n; and n."""
    path = waves.path
    field = waves.at_detector(waves.at_primary(path.entrance_mm), separation_mm)
    pitch_mm = path.entrance_mesh.pitch_um * MM_PER_UM
    expected_px = path.wavelength_mm * path.focal_length_mm(separation_mm) / pitch_mm / path.pixel_mm
    orders = max(1, min(HIGHEST_ORDER, int(REACH_PX / expected_px - 1)))
    low, high = (
        _peak_px(np.abs(field) ** 2, waves.detector, path.pixel_mm, side * orders * expected_px)
        for side in (-1, 1)
    )
    return (high - low) / (2 * orders), orders


def _peak_px(intensity: Vector, grid: Grid, pixel_mm: float, near_px: float) -> float:
    """Position (px) of the highest sample at most 1 px from `near_px`, refined by a parabola."""
    x_px = grid.x_mm / pixel_mm
    window = np.flatnonzero(np.abs(x_px - near_px) <= 1.0)
    top = int(window[np.argmax(intensity[window])])
    before, peak, after = intensity[top - 1 : top + 2]
    shift = (before - after) / (2 * (before - 2 * peak + after))
    return float(x_px[top] + shift * grid.step_mm / pixel_mm)


def _beyond_central_pixel(waves: _WithoutWheel, at_primary: Wave, separation_mm: float) -> float:
    line = binned_light(waves.at_detector(at_primary, separation_mm), waves.detector, SAMPLES_PER_PIXEL)
    return 1 - float(line[REACH_PX] / line.sum())
