"""How well the simplified-combined method approximates Fresnel propagation, in one dimension.

Hofmeister et al., The point-spread function of HRI_EUV, section "Implementation" and the discussion of the
positions that diffracting components may have. Each method computes an image of a point, binned to pixels. The two
images are compared by their light beyond a distance from the centre (1 - encircled energy):

- Fresnel: entrance aperture and mesh -> primary -> secondary -> filter-wheel mesh -> detector;
- simplified-combined: Fraunhofer image of the entrance aperture and mesh, convolved with the analytic series
  of the filter-wheel mesh.

The paper leaves some choices open; the result states each of them:

- The mirrors have the separation of best focus. Both methods use the focal length that follows from this separation.
- The position of the filter-wheel wires across the beam is unknown. Results are means over equally spaced phases of
  the mesh. The range of the single phases is given with the means.
- The number of windows of the series is the number in the instrument file (all windows that the field illuminates), or
  a number that the caller gives. The wave crosses only the few windows within the beam of one field point, but this
  small number would be wrong for the series: the image of the entrance already contains the diffraction at the edges of
  the beam, and a series of few windows would add this diffraction a second time. With more windows the two methods
  agree better.
- To study another distance, the filter wheel is moved between secondary and detector. The distance from secondary to
  detector does not change.
- Each one-dimensional image ("line") is normalised to the light within REACH_PX of the axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Vector, json_attributes
from psfcore.convolution.convolver import linear_convolve
from psfcore.diffraction.fresnel import (
    SAMPLING_MARGIN,
    FresnelStep,
    Grid,
    Wave,
    binned_light,
    fraunhofer_field,
    line_light_beyond,
    mesh_openings_mm,
    open_share,
)
from psfcore.diffraction.light_path import (
    REACH_PX,
    SAMPLES_PER_PIXEL,
    BestFocus,
    LightPath,
    Waves,
    best_focus,
    light_path,
    waves_to_detector,
)
from psfcore.diffraction.mesh_series import mesh_line, order_spacing_px
from psfcore.errors import DataError
from psfcore.instruments.model import MM_PER_UM, UM_PER_MM, Instrument

DISTANCES_MM = (50.0, 100.0, 200.0, 273.0, 400.0, 500.0, 550.0)
ZOOM_PX = 64
_SIZE_PX = 2 * REACH_PX + 1
_ANGSTROM_PER_MM = 1e7
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Sampling:
    """The sampling of a plane: width X, step dx and count N = X / dx.

    Attributes
    ----------
    least_samples
        The smallest allowed count, X1 X2 / (lambda z); None for the detector.
    """

    plane: str
    width_mm: float
    step_um: float
    samples: int
    least_samples: int | None
    # Fraction of the entering light that passes the mask of this plane; mean over phases.
    light: float


@dataclass(frozen=True)
class DistanceResult:
    """The results of both methods with the filter wheel at one distance from the detector.

    Lines have shape (2 REACH_PX + 1,), sum 1 and their centre at [REACH_PX]. Curves are given at FresnelStudy.radii_px:
    1 - encircled energy in percent, and differences (Fresnel minus combined) in percentage points. difference_points is
    the difference for the mean over phases; phase_lowest_points and phase_highest_points are the range of the
    differences for single phases.
    """

    distance_mm: float
    beam_mm: float
    beam_pitches: float
    wheel_order_spacing_px: float
    sampling: tuple[Sampling, ...]
    fresnel_line: Vector
    combined_line: Vector
    fresnel_beyond_pct: Vector
    combined_beyond_pct: Vector
    difference_points: Vector
    phase_lowest_points: Vector
    phase_highest_points: Vector
    phase_largest_points: Vector  # for each phase the largest absolute difference, shape (phases,)

    @property
    def largest_points(self) -> float:
        """The largest absolute difference of the two curves, each averaged over the phases of the mesh."""
        return float(np.abs(self.difference_points).max())

    @property
    def largest_single_points(self) -> float:
        """The largest absolute difference of the two curves for a single phase of the mesh."""
        return float(self.phase_largest_points.max())


@dataclass(frozen=True)
class FresnelStudy:
    """The settings of a comparison, and its results."""

    instrument: str
    version: str
    wavelength_angstrom: float
    printed_distance_mm: float
    focus: BestFocus
    phases: int
    windows: int
    reach_px: int
    samples_per_pixel: int
    sampling_margin: float
    radii_px: Vector
    distances: tuple[DistanceResult, ...]

    def as_json(self) -> dict[str, object]:
        """The study as JSON values.

        Curves are given at every radius up to ZOOM_PX and in growing steps beyond; lines are given up to ZOOM_PX. The
        largest differences are taken over all radii.
        """
        far = np.geomspace(ZOOM_PX, self.radii_px.size - 1, 96).round().astype(np.int64)
        kept = np.unique(np.concatenate([np.arange(ZOOM_PX), far]))
        content = vars(self) | {"focus": asdict(self.focus), "radii_px": self.radii_px[kept].tolist()}
        del content["distances"]
        return content | {
            "offsets_px": list(range(-ZOOM_PX, ZOOM_PX + 1)),
            "distances": [_distance_json(result, kept) for result in self.distances],
        }


def fresnel_study(
    instrument: Instrument,
    *,
    distances_mm: Sequence[float] = DISTANCES_MM,
    phases: int = 16,
    windows: int | None = None,
    progress: Progress | None = None,
) -> FresnelStudy:
    """Compare the methods with the filter wheel at each distance (mm) from the detector.

    Raises DataError "bad-instrument-file", "no-focus", "bad-distance", "bad-phases", "bad-windows" or
    "too-many-samples".

    Parameters
    ----------
    phases
        Number of positions of the filter-wheel mesh, equally spaced over its pitch.
    windows
        Number of windows of the analytic series; default: the number in the instrument file.
    progress
        Function that is called with (done, of).
    """
    path = light_path(instrument)
    windows = path.wheel_mesh.windows if windows is None else windows
    _check(path, distances_mm, phases, windows)
    report = progress or (lambda done, of: None)
    steps = 1 + len(distances_mm) * phases
    report(0, steps)
    waves = waves_to_detector(path)
    focus = best_focus(waves, nominal_focal_length_mm=instrument.focal_length_mm)
    entrance_line = _entrance_line(path, focus.focal_length_mm)
    at_primary = waves.at_primary(path.entrance_mm)
    report(1, steps)
    results = []
    for index, distance_mm in enumerate(distances_mm):
        done = 1 + index * phases
        wheel = _AtWheel(path, at_primary, focus.separation_mm, distance_mm)
        lines = []
        for phase in range(phases):
            lines.append(wheel.line(phase / phases))
            report(done + phase + 1, steps)
        combined = _combined_line(path, entrance_line, distance_mm, windows)
        results.append(_compared(wheel, np.array(lines), combined))
    return FresnelStudy(
        instrument=instrument.name,
        version=instrument.version,
        wavelength_angstrom=instrument.wavelength_angstrom,
        printed_distance_mm=path.printed_distance_mm,
        focus=focus,
        phases=phases,
        windows=windows,
        reach_px=REACH_PX,
        samples_per_pixel=SAMPLES_PER_PIXEL,
        sampling_margin=SAMPLING_MARGIN,
        radii_px=np.arange(REACH_PX, dtype=np.float64),
        distances=tuple(results),
    )


class _AtWheel:
    """The focused wave in front of the filter wheel, and its propagation through the mesh of the wheel to the
    detector.
    """

    def __init__(self, path: LightPath, at_primary: Wave, separation_mm: float, distance_mm: float) -> None:
        self.path, self.distance_mm = path, distance_mm
        self.behind_secondary_mm = path.secondary_to_detector_mm - distance_mm
        self.beam_mm = path.beam_mm(separation_mm, self.behind_secondary_mm)
        self._grid, self._detector = path.wheel_grid(distance_mm), path.detector_grid
        waves = Waves(path, self._grid, self.behind_secondary_mm)
        at_secondary = waves.at_secondary(at_primary, separation_mm)
        self._field = waves.at_plane(at_secondary)
        self._step = FresnelStep(self._grid, self._detector, distance_mm)
        self._lights: list[float] = []
        self._upstream: list[tuple[Grid, float]] = [
            (waves.aperture, 1.0),
            (waves.primary, waves.primary.light(at_primary)),
            (waves.secondary, waves.secondary.light(at_secondary)),
        ]

    def line(self, phase: float) -> Vector:
        """The light in each pixel, for the mesh shifted by `phase` of its pitch."""
        openings_mm = mesh_openings_mm(self.path.wheel_mesh, phase, self._grid.width_mm)
        field = self._field * open_share(self._grid, openings_mm)
        self._lights.append(self._grid.light(field))
        return binned_light(self._step.apply(field), self._detector, SAMPLES_PER_PIXEL)

    def sampling(self, detector_light: float) -> tuple[Sampling, ...]:
        """The sampling of all planes from the aperture to the detector, with the light behind each plane."""
        wheel_light = float(np.mean(self._lights))
        planes = [*self._upstream, (self._grid, wheel_light), (self._detector, detector_light)]
        lengths_mm = [
            self.path.aperture_to_primary_mm,
            self.path.printed_separation_mm,
            self.behind_secondary_mm,
            self.distance_mm,
        ]
        least: list[int | None] = [
            round(this.width_mm * after.width_mm / (self.path.wavelength_mm * length_mm))
            for (this, _), (after, _), length_mm in zip(planes, planes[1:], lengths_mm, strict=False)
        ]
        return tuple(
            Sampling(grid.plane, grid.width_mm, grid.step_mm * UM_PER_MM, grid.samples, count, light)
            for (grid, light), count in zip(planes, [*least, None], strict=True)
        )


def _entrance_line(path: LightPath, focal_length_mm: float) -> Vector:
    """The Fraunhofer image of entrance aperture and mesh in pixels, sum 1."""
    grid = path.detector_grid
    field = fraunhofer_field(path.entrance_mm, grid, focal_length_mm)
    line = binned_light(field, grid, SAMPLES_PER_PIXEL)
    return np.asarray(line / line.sum())


def _wheel_spacing_px(path: LightPath, distance_mm: float) -> float:
    """The spacing of the orders of the filter-wheel mesh at a distance from the detector, px."""
    return order_spacing_px(
        wavelength_angstrom=path.wavelength_mm * _ANGSTROM_PER_MM,
        distance_mm=distance_mm,
        pitch_um=path.wheel_mesh.pitch_um,
        pixel_pitch_um=path.pixel_mm * UM_PER_MM,
    )


def _combined_line(path: LightPath, entrance_line: Vector, distance_mm: float, windows: int) -> Vector:
    """The image of the entrance, convolved with the series of the filter-wheel mesh, sum 1."""
    mesh, spacing_px = path.wheel_mesh, _wheel_spacing_px(path, distance_mm)
    series = mesh_line(
        spacing_px, pitch_um=mesh.pitch_um, wire_um=mesh.wire_um, windows=windows, size=_SIZE_PX
    )
    line = linear_convolve(entrance_line[None, :], series[None, :], (1, _SIZE_PX))[0]
    return np.asarray(line / line.sum())


def _compared(wheel: _AtWheel, lines: Vector, combined: Vector) -> DistanceResult:
    """The curves and differences that follow from the lines of all phases, (phases, 2 REACH_PX + 1)."""
    path = wheel.path
    radii_px = np.arange(REACH_PX)
    combined_beyond = 100 * line_light_beyond(combined, radii_px)
    # Each line is divided by its sum. Therefore the mean of the curves equals the curve of the mean line.
    shares = lines / lines.sum(axis=1, keepdims=True)
    single = np.array([100 * line_light_beyond(line, radii_px) for line in shares]) - combined_beyond
    mean_line = shares.mean(axis=0)
    fresnel_beyond = 100 * line_light_beyond(mean_line, radii_px)
    pitch_mm = path.wheel_mesh.pitch_um * MM_PER_UM
    return DistanceResult(
        distance_mm=wheel.distance_mm,
        beam_mm=wheel.beam_mm,
        beam_pitches=wheel.beam_mm / pitch_mm,
        wheel_order_spacing_px=_wheel_spacing_px(path, wheel.distance_mm),
        sampling=wheel.sampling(float(lines.sum(axis=1).mean())),
        fresnel_line=mean_line,
        combined_line=combined,
        fresnel_beyond_pct=fresnel_beyond,
        combined_beyond_pct=combined_beyond,
        difference_points=fresnel_beyond - combined_beyond,
        phase_lowest_points=single.min(axis=0),
        phase_highest_points=single.max(axis=0),
        phase_largest_points=np.abs(single).max(axis=1),
    )


def _check(path: LightPath, distances_mm: Sequence[float], phases: int, windows: int) -> None:
    longest = path.secondary_to_detector_mm
    wrong = [d for d in distances_mm if not 0 < d < longest]
    if wrong or not distances_mm:
        got = f"{wrong[0]:g} mm" if wrong else "no distance"
        raise DataError(
            "bad-distance", f"expected distances between 0 and {longest:g} mm (exclusive); got {got}"
        )
    for distance_mm in distances_mm:  # raises "too-many-samples"
        path.secondary_grid(path.wheel_grid(distance_mm).width_mm, longest - distance_mm)
    for code, value, most in (("bad-phases", phases, 1000), ("bad-windows", windows, 100_000)):
        if not 1 <= value <= most:
            raise DataError(code, f"expected 1 to {most} {code.removeprefix('bad-')}; got {value}")


def _distance_json(result: DistanceResult, kept: NDArray[np.int64]) -> dict[str, object]:
    near = slice(REACH_PX - ZOOM_PX, REACH_PX + ZOOM_PX + 1)
    lines = ("fresnel_line", "combined_line")
    curves = (
        "fresnel_beyond_pct",
        "combined_beyond_pct",
        "difference_points",
        "phase_lowest_points",
        "phase_highest_points",
    )
    return {
        **json_attributes(result, "distance_mm", "beam_mm", "beam_pitches", "wheel_order_spacing_px"),
        **json_attributes(
            result, "sampling", "largest_points", "largest_single_points", "phase_largest_points"
        ),
        **{name: getattr(result, name)[near].tolist() for name in lines},
        **{name: getattr(result, name)[kept].tolist() for name in curves},
    }
