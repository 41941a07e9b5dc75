"""The optical path of a two-mirror telescope: the planes that a wave crosses, and the paths of rays.

Hofmeister et al., The point-spread function of HRI_EUV, section "Fresnel propagation": the wave goes from
the entrance aperture to primary, secondary, filter wheel and detector, in this order. Eq. (1) describes a ray that
enters parallel to the axis at height 1. The mirrors are thin: f = R / 2 for a concave mirror, -R / 2 for a convex one.

    y2 = 1 - s / f1,   u2 = -1 / f1 - y2 / f2,   y(z) = y2 + z u2,   focal length = -1 / u2        Eq. (1)

| symbol | name | unit |
|---|---|---|
| s | separation_mm, of the mirrors | mm |
| f1, f2 | focal_mm of primary and secondary | mm |
| z | distance behind the secondary | mm |
| y, u | height and slope of a ray that enters at height 1 | -, 1/mm |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfcore.diffraction.fresnel import (
    MM_PER_UM,
    Grid,
    Vector,
    Wave,
    common_openings_mm,
    grid_for,
    mesh_openings_mm,
    mirror_transmission,
    open_share,
    propagate,
)
from psfcore.errors import DataError
from psfcore.instruments.model import Aperture, Instrument, Mesh, Mirror

REACH_PX = 1023
SAMPLES_PER_PIXEL = 16
_MM_PER_ANGSTROM = 1e-7
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
        """The grid of the secondary. next_width_mm, distance_mm: width of the next plane and its distance."""
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

    def field_at_primary(self, openings_mm: Vector, aperture: Grid, primary: Grid) -> Wave:
        """The field behind the primary, for a plane wave along the axis. The light that enters through the openings is 1."""
        field = open_share(aperture, openings_mm).astype(np.complex128)
        field /= np.sqrt(aperture.light(field))
        field = propagate(field, aperture, primary, self.aperture_to_primary_mm)
        return np.asarray(field * mirror_transmission(self.primary, primary))

    def field_at_secondary(
        self, at_primary: Wave, primary: Grid, secondary: Grid, separation_mm: float
    ) -> Wave:
        """The field behind the secondary, from the field behind the primary."""
        field = propagate(at_primary, primary, secondary, separation_mm)
        return np.asarray(field * mirror_transmission(self.secondary, secondary))


def focal_mm(mirror: Mirror) -> float:
    """The focal length of a thin mirror: half its radius of curvature, negative if the mirror is convex."""
    return mirror.radius_mm / 2 if mirror.figure == "concave" else -mirror.radius_mm / 2


def light_path(instrument: Instrument) -> LightPath:
    """The optical path of an instrument.

    Raises DataError "bad-instrument-file"; the message names the missing or unsuitable key.
    """
    distances = instrument.distances
    meshes = [mesh for place in _PLACES for mesh in instrument.meshes if mesh.place == place]
    if len(instrument.mirrors) != 2:
        got = f"{len(instrument.mirrors)} mirrors"
        raise _lacking(instrument, "mirrors", "a primary and a secondary", got)
    if distances is None:
        raise _lacking(instrument, "distances", "the distances along the optical path", "none")
    for place in _PLACES:
        count = sum(mesh.place == place for mesh in meshes)
        if count != 1:
            raise _lacking(instrument, "meshes", f"one mesh at place {place!r}", str(count))
    entrance, wheel = meshes
    if (entrance.angle_deg - wheel.angle_deg) % 90:
        wanted = "meshes with the same axes, for propagation in one dimension"
        got = f"{entrance.angle_deg:g} and {wheel.angle_deg:g} degrees"
        raise _lacking(instrument, "meshes.angle_deg", wanted, got)
    return LightPath(
        wavelength_mm=instrument.wavelength_angstrom * _MM_PER_ANGSTROM,
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
    return DataError("bad-instrument-file", f"{instrument.name}: {key}: expected {expected}; got {got}")
