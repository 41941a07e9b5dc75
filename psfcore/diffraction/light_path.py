"""The optical path of a two-mirror telescope: the planes that a wave crosses, the paths of rays, and its best focus.

Hofmeister et al., The point-spread function of HRI_EUV, section "Fresnel propagation": the wave goes from
the entrance aperture to primary, secondary, filter wheel and detector, in this order. Eq. (1) describes a ray that
enters parallel to the axis at height 1. The mirrors are thin: f = R / 2 for a concave mirror, -R / 2 for a convex one.

    y2 = 1 - s / f1,   u2 = -1 / f1 - y2 / f2,   y(z) = y2 + z u2,   focal length = -1 / u2        Eq. (1)

The paper's section "The instrument" prints radii and distances that are not consistent: with them the detector is far
out of focus. `best_focus` solves for the separation of the mirrors. The focus is most sensitive to this length, because
the secondary magnifies an error of this length. All other lengths keep their printed values, and the result states by
how much the separation was shifted. Rays near the axis meet on the detector where y(L) = 0:

    s = f1 - L / (1 - L / f2)                                                                      Eq. (2)

The search starts at this separation. Best focus is the separation at which the wave through the open aperture, without
meshes, has the largest intensity on the axis. Light in the pixels of the detector would be a less precise criterion,
because the pixels are too coarse.

| symbol | name | unit |
|---|---|---|
| s | separation_mm, of the mirrors | mm |
| f1, f2 | focal_mm of primary and secondary | mm |
| z | distance behind the secondary | mm |
| L | secondary_to_detector_mm | mm |
| y, u | height and slope of a ray that enters at height 1 | -, 1/mm |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from psfcore.arrays import Vector
from psfcore.diffraction.fresnel import (
    FresnelStep,
    Grid,
    Wave,
    binned_light,
    common_openings_mm,
    grid_for,
    mesh_openings_mm,
    mirror_transmission,
    open_share,
)
from psfcore.errors import DataError
from psfcore.instruments.model import MM_PER_ANGSTROM, MM_PER_UM, Aperture, Instrument, Mesh, Mirror

REACH_PX = 1023
SAMPLES_PER_PIXEL = 16
SEARCH_MM = 0.05
TOLERANCE_MM = 1e-5
HIGHEST_ORDER = 15
_PLACES = ("entrance", "filter_wheel")


@dataclass(frozen=True)
class LightPath:
    """The quantities of a telescope that are needed to propagate a wave. Lengths are in mm."""

    wavelength_mm: float
    aperture: Aperture
    entrance_mesh: Mesh
    primary: Mirror
    secondary: Mirror
    wheel_mesh: Mesh
    aperture_to_primary_mm: float
    printed_separation_mm: float
    secondary_to_detector_mm: float
    printed_distance_mm: float  # from filter wheel to detector
    pixel_mm: float

    @property
    def detector_grid(self) -> Grid:
        """The grid of the detector: SAMPLES_PER_PIXEL samples for each pixel within REACH_PX of the axis."""
        samples = (2 * REACH_PX + 1) * SAMPLES_PER_PIXEL
        return Grid("detector", samples, self.pixel_mm / SAMPLES_PER_PIXEL, self.wavelength_mm)

    @property
    def aperture_mm(self) -> Vector:
        """The openings of the entrance without its mesh on a line through its middle, rows of (begin, end)."""
        rim, hub = self.aperture.diameter_mm / 2, self.aperture.obscuration_diameter_mm / 2
        return np.array([[-rim, -hub], [hub, rim]]) if hub else np.array([[-rim, rim]])

    @property
    def entrance_mm(self) -> Vector:
        """The openings of the entrance with its mesh, rows of (begin, end)."""
        # If the number of windows is odd, a window lies on the axis; if it is even, a wire lies on the axis.
        phase = 0.0 if self.entrance_mesh.windows % 2 else 0.5
        windows_mm = mesh_openings_mm(self.entrance_mesh, phase, self.aperture.diameter_mm)
        return common_openings_mm(self.aperture_mm, windows_mm)

    def slope_per_mm(self, separation_mm: float) -> float:
        """The slope u2 of a ray behind the secondary, Eq. (1)."""
        f1, f2 = focal_mm(self.primary), focal_mm(self.secondary)
        return -1 / f1 - (1 - separation_mm / f1) / f2

    def focal_length_mm(self, separation_mm: float) -> float:
        """Focal length of both mirrors together, Eq. (1)."""
        return -1 / self.slope_per_mm(separation_mm)

    def beam_mm(self, separation_mm: float, behind_secondary_mm: float) -> float:
        """The width of the beam of one field point at a distance behind the secondary, Eq. (1)."""
        height = 1 - separation_mm / focal_mm(self.primary)
        height += behind_secondary_mm * self.slope_per_mm(separation_mm)
        return abs(height) * self.aperture.diameter_mm

    def entrance_grids(self) -> tuple[Grid, Grid]:
        """The grids of aperture and primary.

        Their steps are so small that light reaches the full width of the next mirror.
        """
        first, second = self.primary.diameter_mm, self.secondary.diameter_mm
        return (
            self._grid("aperture", self.aperture.diameter_mm, first, self.aperture_to_primary_mm),
            self._grid("primary", first, second, self.printed_separation_mm),
        )

    def secondary_grid(self, next_width_mm: float, distance_mm: float) -> Grid:
        """The grid of the secondary.

        Parameters
        ----------
        next_width_mm, distance_mm
            Width of the next plane, and the distance to it.
        """
        return self._grid("secondary", self.secondary.diameter_mm, next_width_mm, distance_mm)

    def wheel_grid(self, distance_mm: float) -> Grid:
        """The grid of a filter wheel at a distance from the detector.

        The grid is so wide that all straight lines from the secondary to the detector cross it.
        """
        share = distance_mm / self.secondary_to_detector_mm
        detector_mm = self.detector_grid.width_mm
        width_mm = share * self.secondary.diameter_mm + (1 - share) * detector_mm
        return self._grid("filter wheel", width_mm, detector_mm, distance_mm)

    def _grid(self, plane: str, width_mm: float, next_width_mm: float, distance_mm: float) -> Grid:
        return grid_for(plane, self.wavelength_mm, width_mm, next_width_mm, distance_mm)


class Waves:
    """Waves from the aperture over both mirrors to a plane behind them, each computed from the wave before.

    Parameters
    ----------
    plane
        The grid of the plane.
    distance_mm
        The distance of the plane from the secondary.
    """

    def __init__(self, path: LightPath, plane: Grid, distance_mm: float) -> None:
        self.path, self.plane = path, plane
        self.aperture, self.primary = path.entrance_grids()
        self.secondary = path.secondary_grid(plane.width_mm, distance_mm)
        self._behind = FresnelStep(self.secondary, plane, distance_mm)

    def at_primary(self, openings_mm: Vector) -> Wave:
        """The field behind the primary, for a plane wave along the axis. The light that enters through the openings is
        1.
        """
        field = open_share(self.aperture, openings_mm).astype(np.complex128)
        field /= np.sqrt(self.aperture.light(field))
        field = FresnelStep(self.aperture, self.primary, self.path.aperture_to_primary_mm).apply(field)
        return np.asarray(field * mirror_transmission(self.path.primary, self.primary))

    def at_secondary(self, at_primary: Wave, separation_mm: float) -> Wave:
        """The field behind the secondary, at this separation of the mirrors."""
        field = FresnelStep(self.primary, self.secondary, separation_mm).apply(at_primary)
        return np.asarray(field * mirror_transmission(self.path.secondary, self.secondary))

    def at_plane(self, at_secondary: Wave) -> Wave:
        """The field that arrives at the plane."""
        return self._behind.apply(at_secondary)


def waves_to_detector(path: LightPath) -> Waves:
    """Waves from the aperture to the detector without the mesh of the filter wheel."""
    return Waves(path, path.detector_grid, path.secondary_to_detector_mm)


def focal_mm(mirror: Mirror) -> float:
    """The focal length of a thin mirror: half its radius of curvature, negative if the mirror is convex."""
    return mirror.radius_mm / 2 if mirror.figure == "concave" else -mirror.radius_mm / 2


def light_path(instrument: Instrument) -> LightPath:
    """The optical path of an instrument.

    Raises DataError "bad-instrument-file"; the message names the missing or unsuitable key.
    """
    distances = instrument.distances
    meshes = {place: [m for m in instrument.meshes if m.place == place] for place in _PLACES}
    if len(instrument.mirrors) != 2:
        raise _lacking(
            instrument, "mirrors", "a primary and a secondary", f"{len(instrument.mirrors)} mirrors"
        )
    if distances is None:
        raise _lacking(instrument, "distances", "the distances along the optical path", "none")
    for place, there in meshes.items():
        if len(there) != 1:
            raise _lacking(instrument, "meshes", f"one mesh at place {place!r}", str(len(there)))
    if not instrument.aperture.round:
        raise _lacking(instrument, "aperture", "a whole disc or ring", "a sector or a polygon")
    (entrance,), (wheel,) = meshes.values()
    if "hexagonal" in (entrance.openings, wheel.openings):
        raise _lacking(
            instrument, "meshes.openings", "square meshes, for propagation in one dimension", "hexagonal"
        )
    if (entrance.angle_deg - wheel.angle_deg) % 90:
        raise _lacking(
            instrument,
            "meshes.angle_deg",
            "meshes with the same axes, for propagation in one dimension",
            f"{entrance.angle_deg:g} and {wheel.angle_deg:g} degrees",
        )
    return LightPath(
        wavelength_mm=instrument.wavelength_angstrom * MM_PER_ANGSTROM,
        aperture=instrument.aperture,
        entrance_mesh=entrance,
        primary=instrument.mirrors[0],
        secondary=instrument.mirrors[1],
        wheel_mesh=wheel,
        aperture_to_primary_mm=distances.aperture_to_primary_mm,
        printed_separation_mm=distances.primary_to_secondary_mm,
        secondary_to_detector_mm=(
            distances.secondary_to_filter_wheel_mm + distances.filter_wheel_to_detector_mm
        ),
        printed_distance_mm=distances.filter_wheel_to_detector_mm,
        pixel_mm=instrument.detector.pixel_pitch_um * MM_PER_UM,
    )


def _lacking(instrument: Instrument, key: str, expected: str, got: str) -> DataError:
    return DataError(
        "bad-instrument-file",
        f"{instrument.name}: {key}: expected {expected}; got {got}: correct the file, or choose another instrument",
    )


@dataclass(frozen=True)
class BestFocus:
    """The separation of best focus, and the quantities that follow from it.

    Attributes
    ----------
    printed_blur_px
        Width of the geometric image of a point at the printed separation.
    nominal_focal_length_mm
        The focal length of the instrument file.
    order_spacing_px
        Spacing of the orders of the entrance mesh, measured in the focused image. The distance from order -`orders` to
        order +`orders` is divided by 2 x `orders`.
    beyond_central_pixel_printed, beyond_central_pixel_focused
        Share of the light outside the central pixel, at the printed separation and in focus. This share is computed in
        one dimension, for the open aperture without meshes.
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


def paraxial_separation_mm(path: LightPath) -> float:
    """The separation at which rays near the axis meet on the detector, Eq. (2).

    Raises DataError "no-focus" if there is no such separation.
    """
    f1, f2, length = focal_mm(path.primary), focal_mm(path.secondary), path.secondary_to_detector_mm
    separation_mm = f1 - length * f2 / (f2 - length) if f2 != length else 0.0  # Eq. (2)
    if separation_mm <= 0:
        got = f"{separation_mm:g} mm" if f2 != length else "no finite separation"
        raise DataError(
            "no-focus",
            f"expected mirrors that can focus on the detector at a positive separation; got {got}: "
            "correct their radii or distances in the instrument file",
        )
    return separation_mm


def best_focus(waves: Waves, *, nominal_focal_length_mm: float) -> BestFocus:
    """Solve for the separation of best focus.

    Raises DataError "no-focus" if there is no maximum within SEARCH_MM of the paraxial separation.

    Parameters
    ----------
    waves
        The waves that `waves_to_detector` gives.
    nominal_focal_length_mm
        The focal length of the instrument file, for comparison.
    """
    path = waves.path
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


def _sharpest(waves: Waves, at_primary: Wave, paraxial_mm: float) -> float:
    path = waves.path
    # At x2 = 0, the integral in Eq. (1) of fresnel is the sum of E1 times this phase factor.
    to_axis = np.exp(
        1j * np.pi / path.wavelength_mm / path.secondary_to_detector_mm * waves.secondary.x_mm**2
    )

    def on_axis(separation_mm: float) -> float:
        """Intensity on the axis, in arbitrary units."""
        return float(np.abs(np.dot(waves.at_secondary(at_primary, separation_mm), to_axis)) ** 2)

    search = minimize_scalar(
        lambda separation_mm: -on_axis(separation_mm),
        bounds=(paraxial_mm - SEARCH_MM, paraxial_mm + SEARCH_MM),
        method="bounded",
        options={"xatol": TOLERANCE_MM},
    )
    separation_mm = float(search.x)
    if abs(separation_mm - paraxial_mm) > 0.95 * SEARCH_MM:
        raise DataError(
            "no-focus",
            f"expected best focus within {SEARCH_MM} mm of the paraxial separation {paraxial_mm:.3f} mm; got no "
            "maximum there: correct the radii or distances of the mirrors in the instrument file",
        )
    return separation_mm


def _order_spacing_px(waves: Waves, separation_mm: float) -> tuple[float, int]:
    """Mean spacing (px) of the orders of the entrance mesh, measured between the orders -n and +n; and n."""
    path = waves.path
    field = waves.at_plane(waves.at_secondary(waves.at_primary(path.entrance_mm), separation_mm))
    pitch_mm = path.entrance_mesh.pitch_um * MM_PER_UM
    expected_px = path.wavelength_mm * path.focal_length_mm(separation_mm) / pitch_mm / path.pixel_mm
    orders = max(1, min(HIGHEST_ORDER, int(REACH_PX / expected_px - 1)))
    low, high = (
        _peak_px(np.abs(field) ** 2, waves.plane, path.pixel_mm, side * orders * expected_px)
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


def _beyond_central_pixel(waves: Waves, at_primary: Wave, separation_mm: float) -> float:
    field = waves.at_plane(waves.at_secondary(at_primary, separation_mm))
    line = binned_light(field, waves.plane, SAMPLES_PER_PIXEL)
    return 1 - float(line[REACH_PX] / line.sum())
