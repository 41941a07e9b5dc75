"""The entrance pupil as a transmission mask, computed in strips of rows.

Hofmeister et al., The point-spread function of HRI_EUV, section "Implementation": amplitude masks of the aperture,
its mount and its mesh. The value of a cell of the mask is its open share: the fraction of its area that lets light
through. This fraction is exact: every outline is a polygon, and in a cell the area under an edge of a polygon is a
trapezoid. A circle is replaced by a polygon of the same area with 4096 corners.

    open area of cell i = sum over edges of dy (i + 1 - x), with x the mean x of the edge in the cell   Eq. (1)
    circle of radius R: corners at the radius R sqrt((2 pi / m) / sin(2 pi / m))                        Eq. (2)

If outlines of different components cross in one cell, the open shares of the cell in these components are multiplied.

| symbol | name | unit |
|---|---|---|
| d | pitch_um of a mesh; wires are at (k + 1/2) d, or at k d if its number of windows is even | um |
| wire_um | width of a wire | um |
| dx | cell_mm, edge of a cell of the mask | mm |
| N | cells along an edge of the mask; the optical axis is in the middle | - |
| m | corners of a circle | - |

Angles are measured from +x of the detector towards +y, and mask[y, x] has the axes of image[y, x].
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.errors import DataError
from psfcore.instruments.model import UM_PER_MM, Aperture, MaskImage, Mesh, Mount, Sector, signed_area

CIRCLE_CORNERS = 4096
# A ring that crosses the rim is a mistake in the instrument file. This small excess is allowed, because numbers are
# rounded.
_RIM_TOLERANCE_MM = 1e-6
_FARTHEST_CORNER = 100

Corners = NDArray[np.float64]
Outline = tuple[Corners, ...]


@dataclass(frozen=True)
class MaskPicture:
    """A mask given as pixels [y, x]: open share, 0 to 1, on a square of `width_mm`; row 0 is at the lowest y."""

    open_share: NDArray[np.float64]
    width_mm: float


@dataclass(frozen=True)
class Pupil:
    """The open area of the pupil: the opening minus the opaque outlines, the mesh wires and the opaque parts of a
    picture.

    An outline consists of one or more closed polygons with corners (x, y) in mm. A polygon may be a hole in another
    one.

    Attributes
    ----------
    meshes
        Meshes with square openings that are parallel to the axes.
    """

    opening: Outline
    opaque: tuple[Outline, ...] = ()
    meshes: tuple[Mesh, ...] = ()
    picture: MaskPicture | None = None

    @property
    def width_mm(self) -> float:
        """Edge of the smallest square around the optical axis that contains the opening."""
        return 2 * float(max(np.abs(corners).max() for corners in self.opening))


def entrance_pupil(
    aperture: Aperture,
    *,
    mount: Mount | None = None,
    mount_image: NDArray[np.floating] | None = None,
    meshes: Iterable[Mesh] = (),
) -> Pupil:
    """The pupil of an aperture, with its mount and its meshes if they are given.

    Raises DataError "bad-mount" if the hub or a ray is as wide as the aperture, if a ring crosses the rim, if a corner
    is far outside, or if the mask image is missing or cannot be used. The message names the key.

    Parameters
    ----------
    mount_image
        Pixels [y, x] of the mount's mask image; row 0 is at the lowest y, and 0 is opaque.
    """
    radius_mm = aperture.diameter_mm / 2
    opaque = [] if mount is None else _mount_outlines(mount, radius_mm)
    picture = None
    if mount is not None and mount.mask_image is not None:
        picture = _mask_picture(mount.mask_image, mount_image, aperture)
    return Pupil(_opening(aperture), tuple(opaque), tuple(meshes), picture)


def _opening(aperture: Aperture) -> Outline:
    outer_mm, inner_mm = aperture.diameter_mm / 2, aperture.obscuration_diameter_mm / 2
    if aperture.corners_mm:
        corners = np.array(aperture.corners_mm, dtype=np.float64)
        return (corners if signed_area(aperture.corners_mm) > 0 else corners[::-1],)
    if aperture.sector is not None:
        return (_sector(outer_mm, inner_mm, aperture.sector),)
    hole = (circle(inner_mm)[::-1],) if inner_mm > 0 else ()
    return (circle(outer_mm), *hole)


def _sector(outer_mm: float, inner_mm: float, sector: Sector) -> Corners:
    """Corners in mm, counter-clockwise, of a polygon that has the area of a sector of a disc or ring."""
    opening = math.radians(sector.opening_deg)
    steps = math.ceil(CIRCLE_CORNERS * opening / (2 * math.pi))
    angle = math.radians(sector.first_angle_deg) + np.arange(steps + 1) * opening / steps
    arc = math.sqrt((opening / steps) / math.sin(opening / steps)) * np.stack(
        [np.cos(angle), np.sin(angle)], axis=1
    )
    inner = inner_mm * arc[::-1] if inner_mm > 0 else np.zeros((1, 2))
    return np.concatenate([outer_mm * arc, inner])


def circle(radius_mm: float) -> Corners:
    """Corners (4096, 2) in mm, counter-clockwise, of a polygon that has the area of a circle."""
    step = 2 * math.pi / CIRCLE_CORNERS
    # No corner lies on an axis or a diagonal, so the polygon has the mirror symmetries of a circle.
    angle = (np.arange(CIRCLE_CORNERS) + 0.5) * step
    reach_mm = radius_mm * math.sqrt(step / math.sin(step))  # Eq. (2)
    return reach_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def bar(start_mm: float, end_mm: float, width_mm: float, angle_deg: float) -> Corners:
    """Corners (4, 2) in mm of a bar from start_mm to end_mm along the direction `angle_deg` through the optical
    axis.
    """
    half_mm = width_mm / 2
    corners = np.array([(start_mm, -half_mm), (end_mm, -half_mm), (end_mm, half_mm), (start_mm, half_mm)])
    cos, sin = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.asarray(corners @ np.array([[cos, -sin], [sin, cos]]).T)


def _mount_outlines(mount: Mount, rim_mm: float) -> list[Outline]:
    outlines: list[Outline] = []
    hub_mm = mount.hub_diameter_mm / 2
    if hub_mm >= rim_mm:
        raise _bad_mount(
            "hub_diameter_mm", f"less than the aperture's {2 * rim_mm:g} mm", f"{mount.hub_diameter_mm:g}"
        )
    if hub_mm > 0:
        outlines.append((circle(hub_mm),))
    for index, rays in enumerate(mount.rays):
        if rays.width_mm >= 2 * rim_mm:
            raise _bad_mount(
                f"rays.{index}.width_mm", f"less than the aperture's {2 * rim_mm:g} mm", f"{rays.width_mm:g}"
            )
        for ray in range(rays.count):
            angle_deg = rays.first_angle_deg + 360 * ray / rays.count
            outlines.append((bar(0.0, 2 * rim_mm, rays.width_mm, angle_deg),))
    for index, ring in enumerate(mount.rings):
        inner_mm, outer_mm = ring.radius_mm - ring.width_mm / 2, ring.radius_mm + ring.width_mm / 2
        if inner_mm < 0 or outer_mm > rim_mm + _RIM_TOLERANCE_MM:
            raise _bad_mount(
                f"rings.{index}",
                f"a ring within the aperture's radius {rim_mm:g} mm",
                f"{inner_mm:g} to {outer_mm:g} mm",
            )
        hole = (circle(inner_mm)[::-1],) if inner_mm > 0 else ()
        outlines.append((circle(outer_mm), *hole))
    for index, polygon in enumerate(mount.polygons):
        corners = np.array(polygon.corners_mm, dtype=np.float64)
        if np.abs(corners).max() > _FARTHEST_CORNER * 2 * rim_mm:
            raise _bad_mount(
                f"polygons.{index}",
                f"corners within {_FARTHEST_CORNER} diameters of the aperture",
                f"a corner at {np.abs(corners).max():g} mm",
            )
        outlines.append((corners,))
    return outlines


def _mask_picture(
    described: MaskImage, pixels: NDArray[np.floating] | None, aperture: Aperture
) -> MaskPicture:
    key = "mask_image"
    if pixels is None:
        raise _bad_mount(key, f"the pixels of {described.file}", "none: give them as mount_image")
    if pixels.ndim != 2 or pixels.shape[0] != pixels.shape[1] or pixels.size == 0:
        raise _bad_mount(key, "a square image with two axes", f"shape {pixels.shape}")
    if not np.isfinite(pixels).all() or pixels.min() < 0 or pixels.max() <= 0:
        finite = "finite values of at least 0 (0 is opaque), some of them above 0 (open)"
        raise _bad_mount(key, finite, f"{pixels.min():g} to {pixels.max():g}")
    if described.width_mm < aperture.diameter_mm:
        raise _bad_mount(
            f"{key}.width_mm",
            f"at least the aperture's {aperture.diameter_mm:g} mm",
            f"{described.width_mm:g}",
        )
    return MaskPicture(np.asarray(pixels, dtype=np.float64) / float(pixels.max()), described.width_mm)


def _bad_mount(key: str, expected: str, got: str) -> DataError:
    return DataError("bad-mount", f"mount.{key}: expected {expected}; got {got}")


class MaskGrid:
    """The mask of `pupil` in N x N cells of `cell_mm` around the optical axis; rows are computed on request."""

    def __init__(self, pupil: Pupil, cell_mm: float) -> None:
        self.cell_mm = cell_mm
        self.cells = 2 * math.ceil(pupil.width_mm / cell_mm / 2) + 2
        lines = [self._mesh_line(mesh) for mesh in pupil.meshes]
        self._line = (np.prod(lines, axis=0) if lines else np.ones(self.cells)).astype(np.float32)
        self._edges, self._outline_of_edge = self._in_cells((pupil.opening, *pupil.opaque))
        self._first_entry, self._entries = _edges_by_row(self._edges, self.cells)
        self._picture = pupil.picture

    def rows(self, first: int, stop: int, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """The open shares of the rows `first` to `stop` - 1, shape (stop - first, cells), written to `out` if it is
        given.
        """
        strip = np.empty((stop - first, self.cells), dtype=np.float32) if out is None else out[: stop - first]
        most = int(np.diff(self._first_entry[first : stop + 1]).max(initial=1))
        _cover(
            strip,
            np.zeros(self.cells + 2),
            np.empty((2, most), np.int64),
            first,
            self._line,
            self._edges,
            self._outline_of_edge,
            self._first_entry,
            self._entries,
        )
        if self._picture is not None:
            cells_per_pixel = self._picture.width_mm / self._picture.open_share.shape[0] / self.cell_mm
            _shade(strip, first, self._picture.open_share, cells_per_pixel)
        return strip

    def _in_cells(self, outlines: tuple[Outline, ...]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """All edges (x0, y0, x1, y1), measured in cells from the lower left corner of the mask, and the outline of each
        edge.
        """
        edges, owners = [], []
        for owner, outline in enumerate(outlines):
            for corners in outline:
                start = corners / self.cell_mm + self.cells / 2
                edges.append(np.hstack([start, np.roll(start, -1, axis=0)]))
                owners.append(np.full(len(start), owner))
        return np.concatenate(edges), np.concatenate(owners).astype(np.int64)

    def _mesh_line(self, mesh: Mesh) -> NDArray[np.float64]:
        """The open share of each cell along an axis of the mesh, shape (cells,)."""
        edges_um = (np.arange(self.cells + 1, dtype=np.float64) - self.cells / 2) * self.cell_mm * UM_PER_MM
        return np.diff(_open_length_um(edges_um, mesh)) / (self.cell_mm * UM_PER_MM)


def _open_length_um(x_um: NDArray[np.floating], mesh: Mesh) -> NDArray[np.float64]:
    """The integral of the open share along an axis of a mesh, up to a constant."""
    window_um = mesh.pitch_um - mesh.wire_um
    from_window_um = x_um + window_um / 2 - (0 if mesh.windows % 2 else mesh.pitch_um / 2)
    whole, part_um = np.divmod(from_window_um, mesh.pitch_um)
    return np.asarray(whole * window_um + np.minimum(part_um, window_um))


def _edges_by_row(edges: NDArray[np.float64], rows: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List the edges that cross each row of cells: entries[first[row] : first[row + 1]], in order."""
    low = np.maximum(np.floor(np.minimum(edges[:, 1], edges[:, 3])).astype(np.int64), 0)
    high = np.minimum(np.ceil(np.maximum(edges[:, 1], edges[:, 3])).astype(np.int64), rows)
    count = np.maximum(high - low, 0)
    before = np.cumsum(count) - count  # crossings of the edges before each edge
    row = np.repeat(low - before, count) + np.arange(count.sum())
    first = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=rows))]).astype(np.int64)
    return first, np.repeat(np.arange(len(edges)), count)[np.argsort(row, kind="stable")]


@compiled()
def _cover(strip, area, ranges, first_row, line, edges, outline_of_edge, first_entry, entries):  # type: ignore[no-untyped-def]  # compiled
    """Write the open share of each cell into `strip`.

    The open share of a cell is the product of its open shares in the meshes, in the opening (outline 0) and in all
    other outlines.

    Parameters
    ----------
    area
        Array of zeros; it is two longer than a row of cells.
    ranges
        Array for the ranges of cells that the edges of an outline cross in a row.
    """
    rows, cells = strip.shape
    begins, ends = ranges[0], ranges[1]
    for k in range(rows):
        row = first_row + k
        for i in range(cells):
            strip[k, i] = 0.0
        entry, stop = first_entry[row], first_entry[row + 1]
        while entry < stop:
            outline = outline_of_edge[entries[entry]]
            touched = np.int64(0)  # for a literal 0, `_insert` would be compiled twice
            while entry < stop and outline_of_edge[entries[entry]] == outline:
                begin, end = _add_edge(area, edges[entries[entry]], row, cells)
                entry += 1
                if begin <= end:
                    _insert(begins, ends, touched, begin, end)
                    touched += 1
            inside, done = 0.0, cells
            for j in range(touched):
                # The covered share is constant over cells that no edge crosses.
                _apply(strip[k], line, line[row], done, begins[j], inside, outline)
                for i in range(max(begins[j], done if j else 0), min(ends[j] + 2, cells)):
                    inside += area[i]
                    area[i] = 0.0
                    _apply(strip[k], line, line[row], i, i + 1, inside, outline)
                done = max(ends[j] + 2, done if j else 0)
            # The cells after the last edge may lie inside the outline too, because it may extend beyond the mask.
            _apply(strip[k], line, line[row], done, cells, inside, outline)
            area[cells] = area[cells + 1] = 0.0


@compiled()
def _insert(begins: NDArray[np.int64], ends: NDArray[np.int64], count: int, begin: int, end: int) -> None:
    """Insert a range of cells into a list that is sorted by first cell."""
    j = count
    while j > 0 and begins[j - 1] > begin:
        begins[j], ends[j] = begins[j - 1], ends[j - 1]
        j -= 1
    begins[j], ends[j] = begin, end


@compiled()
def _apply(row, line, line_y, start, stop, inside, outline):  # type: ignore[no-untyped-def]  # compiled
    """Apply one outline to the cells from `start` to `stop` - 1.

    Outline 0, the opening, sets the open share of these cells. Every other outline is opaque and reduces the open
    share.

    Parameters
    ----------
    inside
        The share of the area of these cells that is inside the outline.
    """
    covered = np.float32(min(abs(inside), 1.0))
    if outline == 0:
        covered *= line_y
        for i in range(start, stop):
            row[i] = covered * line[i]
    elif covered > 0:
        for i in range(start, stop):
            row[i] *= np.float32(1.0) - covered


@compiled()
def _add_edge(area, edge, row, cells):  # type: ignore[no-untyped-def]  # compiled
    """Add the part of an edge that lies in a row, Eq. (1), to `area`. The running sum of `area` is the covered share.

    Returns the first and last cell that the edge crosses. If the edge crosses no cell, the last is before the first.
    """
    x0, y0, x1, y1 = edge[0], edge[1], edge[2], edge[3]
    ya, yb = min(max(y0, row), row + 1), min(max(y1, row), row + 1)
    dy = yb - ya
    if dy == 0.0:
        return cells, 0
    slope = (x1 - x0) / (y1 - y0)
    xa, xb = x0 + (ya - y0) * slope, x0 + (yb - y0) * slope
    if xa > xb:
        xa, xb = xb, xa
    if xb <= 0:
        area[0] += dy
        return 0, 0
    if xa >= cells:
        return cells, 0
    if xb - xa < 1e-12:
        i = min(int(xa), cells - 1)
        area[i] += dy * (i + 1 - xa)
        area[i + 1] += dy * (xa - i)
        return i, i
    per_x = dy / (xb - xa)
    if xa < 0:
        area[0] += per_x * -xa
        xa = 0.0
    begin, end = int(xa), min(int(xb), cells - 1)
    for i in range(begin, end + 1):
        left, right = max(xa, i), min(xb, i + 1)
        part, mean = per_x * (right - left), 0.5 * (left + right)
        area[i] += part * (i + 1 - mean)  # Eq. (1)
        area[i + 1] += part * (mean - i)
    return begin, end


@compiled()
def _shade(strip, first_row, open_share, cells_per_pixel):  # type: ignore[no-untyped-def]  # compiled
    """Multiply `strip` by the mean of a picture over each cell. Everything outside the picture is opaque."""
    rows, cells = strip.shape
    pixels = len(open_share)
    corner = 0.5 * (cells - pixels * cells_per_pixel)  # lower left corner of the picture, in cells
    running = np.zeros(pixels + 1)
    for k in range(rows):
        low = (first_row + k - corner) / cells_per_pixel
        high = low + 1 / cells_per_pixel
        running[:] = 0.0
        for j in range(max(int(low), 0), min(math.ceil(high), pixels)):
            weight = (min(high, j + 1) - max(low, j)) * cells_per_pixel
            for i in range(pixels):
                running[i + 1] += weight * open_share[j, i]
        for i in range(pixels):
            running[i + 1] += running[i]
        before = _running_at(running, -corner / cells_per_pixel)
        for i in range(cells):
            upto = _running_at(running, (i + 1 - corner) / cells_per_pixel)
            strip[k, i] *= (upto - before) * cells_per_pixel
            before = upto


@compiled()
def _running_at(running: NDArray[np.float64], x: float) -> Any:
    """The running sum at a position between pixels, interpolated linearly."""
    last = len(running) - 1
    if x <= 0:
        return running[0]
    if x >= last:
        return running[last]
    i = int(x)
    return running[i] + (x - i) * (running[i + 1] - running[i])
