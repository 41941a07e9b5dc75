"""The sizes of the arrays that the diffraction of an instrument needs, computed from the instrument file alone.

A small instrument file can describe a mesh with so many orders, or an aperture so wide, that the pattern would need
terabytes of memory. `check_workload` refuses such a file. Estimates of memory and time use the same sizes. This module
imports no numerical library, so that the web process can import it.

| symbol | name | unit |
|---|---|---|
| S | samples: samples per pixel and axis that resolve the pattern of the aperture, 2 D p / (lambda f) | - |
| N | mask_cells: cells along an edge of the mask of the entrance pupil | - |
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from psfcore.errors import DataError
from psfcore.instruments.model import MM_PER_ANGSTROM, MM_PER_UM, Instrument, Mesh

LARGEST_SIZE_PX = 4096
PERIOD_PX = 4096  # size of the transform: light wraps around at 4096 px, not at the 2048 px that are kept
MOST_MASK_SAMPLES = 32  # a mask that needs more samples per pixel is replaced by an analytic pattern
NARROW_WINDOWS = 400  # a series of at least this number of windows has narrow orders
FINEST_CELL_PX = 0.02  # cells of the pattern of a rotated mesh are at most this wide before they are combined
AIRY_STEP = 0.02  # step in v of the table of the analytic pattern
MOST_SAMPLES = 256
MOST_CELLS = 2_000_000
MOST_ORDERS = 10_000  # of a hexagonal mesh, from the centre to the corner of the largest array


@dataclass(frozen=True)
class Workload:
    """Sizes of the arrays for one spectral line: the line with the shortest wavelength, which needs the largest arrays.

    Attributes
    ----------
    airy_points
        Points of the table of the analytic pattern.
    cells
        Cells of one axis of each rotated mesh.
    orders
        Orders of each hexagonal mesh, up to the corner.
    mask
        Whether the mask of the pupil is transformed.
    mount_entries
        Entries of the list of edges by rows of the mask.
    """

    samples: float
    airy_points: int
    cells: tuple[int, ...]
    orders: tuple[int, ...]
    mask: bool
    mask_cells: int
    mount_entries: int


def workload(instrument: Instrument, size: int) -> Workload:
    """The sizes for a PSF of `size` px."""
    shortest_mm = min(line.wavelength_angstrom for line in instrument.spectral_lines) * MM_PER_ANGSTROM
    pixel_mm = instrument.detector.pixel_pitch_um * MM_PER_UM
    samples = 2 * instrument.aperture.diameter_mm * pixel_mm / (shortest_mm * instrument.focal_length_mm)
    corner_px = (size // 2 + 1.5) * math.sqrt(2)
    # The error of a missing table of distances is raised when the PSF is built.
    places = ("entrance",) if instrument.distances is None else ("entrance", "filter_wheel")
    meshes = [mesh for mesh in instrument.meshes if mesh.place in places]
    drawn = instrument.mount is not None or bool(instrument.meshes) or not instrument.aperture.round
    mask = samples <= MOST_MASK_SAMPLES and drawn
    mask_cells = 2 * math.ceil(max(size, PERIOD_PX) * samples / 4) + 2 if mask else 0
    mount = instrument.mount
    outlines = 0 if mount is None else mount.ray_count + 4 * len(mount.rings) + mount.corner_count
    outlines += len(instrument.aperture.corners_mm)
    square = [mesh for mesh in meshes if mesh.openings == "square"]
    return Workload(
        samples=samples,
        airy_points=math.ceil(math.pi * samples / 2 * corner_px / AIRY_STEP),
        cells=tuple(
            _cells(instrument, mesh, shortest_mm, corner_px) for mesh in square if mesh.angle_deg % 90 != 0
        ),
        orders=tuple(
            math.ceil(corner_px / _spacing_px(instrument, mesh, shortest_mm))
            for mesh in meshes
            if mesh not in square
        ),
        mask=mask,
        mask_cells=mask_cells,
        mount_entries=outlines * mask_cells,
    )


def windows_of(mesh: Mesh) -> int:
    """The number of windows of the series of a mesh.

    For a mesh at the entrance, the pattern of the aperture gives the orders their width. The orders of the series
    itself must then be narrow, so the number of windows is at least NARROW_WINDOWS.
    """
    return max(mesh.windows, NARROW_WINDOWS) if mesh.place == "entrance" else mesh.windows


def check_workload(instrument: Instrument, label: str) -> None:
    """Raise DataError "bad-instrument-file" if the largest PSF of an instrument needs arrays that are too large."""
    largest = workload(instrument, LARGEST_SIZE_PX)
    if largest.samples > MOST_SAMPLES:
        expected = (
            f"aperture.diameter_mm: expected a pattern that needs at most {MOST_SAMPLES} samples per pixel"
        )
        needs = "2 x diameter x pixel pitch / (wavelength x focal length)"
        raise DataError(
            "bad-instrument-file",
            f"{label}: {expected}; got {needs} = {largest.samples:.3g}: correct these quantities",
        )
    if max(largest.cells, default=0) > MOST_CELLS:
        expected = f"meshes: expected at most {MOST_CELLS} cells along an axis of a rotated mesh"
        advice = "use fewer windows, a smaller pitch_um or a longer distance"
        raise DataError("bad-instrument-file", f"{label}: {expected}; got {max(largest.cells):.3g}: {advice}")
    if max(largest.orders, default=0) > MOST_ORDERS:
        expected = f"meshes: expected at most {MOST_ORDERS} orders of a hexagonal mesh up to the corner"
        advice = "use a smaller pitch_um or a longer distance"
        raise DataError(
            "bad-instrument-file", f"{label}: {expected}; got {max(largest.orders):.3g}: {advice}"
        )


def _cells(instrument: Instrument, mesh: Mesh, wavelength_mm: float, corner_px: float) -> int:
    """Cells of one axis of the pattern of a rotated mesh, before they are combined (see `mesh_series`)."""
    lobe_px = _spacing_px(instrument, mesh, wavelength_mm) / windows_of(mesh)
    return math.ceil(corner_px / lobe_px * max(1, math.ceil(lobe_px / FINEST_CELL_PX)))


def _spacing_px(instrument: Instrument, mesh: Mesh, wavelength_mm: float) -> float:
    """Lambda z / d, the spacing of the orders of a square mesh, px."""
    reach_mm2 = wavelength_mm * instrument.mesh_distance_mm(mesh)
    return reach_mm2 / (mesh.pitch_um * MM_PER_UM) / (instrument.detector.pixel_pitch_um * MM_PER_UM)
