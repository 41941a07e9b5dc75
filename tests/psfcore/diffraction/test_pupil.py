"""Masks have the area and the position of the described parts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.diffraction.pupil import MaskGrid, MaskPicture, Pupil, bar, entrance_pupil
from psfcore.errors import DataError
from psfcore.instruments.model import Aperture, MaskImage, Mesh, Mount, Polygon, Rays, Ring, Sector

CELL_MM = 0.05
APERTURE = Aperture(diameter_mm=10.0)
DISC_MM2 = math.pi * 25


def mesh(**changes: object) -> Mesh:
    known = {"name": "m", "place": "entrance", "pitch_um": 1000.0, "wire_um": 70.0, "windows": 9}
    return Mesh(**(known | changes))  # type: ignore[arg-type]


def mask(pupil: Pupil, cell_mm: float = CELL_MM) -> NDArray[np.float64]:
    grid = MaskGrid(pupil, cell_mm)
    whole = grid.rows(0, grid.cells).astype(np.float64)
    assert whole.min() >= 0
    assert whole.max() <= 1
    return whole


def area_mm2(pupil: Pupil, cell_mm: float = CELL_MM) -> float:
    return float(mask(pupil, cell_mm).sum()) * cell_mm**2


def by_points(pupil_inside: object, cells: int, cell_mm: float, points: int = 30) -> NDArray[np.float64]:
    """Reference: share of a grid of points x points in each cell at which a function of (x, y) is true."""
    fine = (np.arange(cells * points) + 0.5) / points - cells / 2
    x, y = np.meshgrid(fine * cell_mm, fine * cell_mm)
    inside = np.asarray(pupil_inside(x, y), dtype=np.float64)  # type: ignore[operator]
    return inside.reshape(cells, points, cells, points).mean(axis=(1, 3))


def test_discs_rings_bars_and_hubs_have_their_area() -> None:
    ring = Aperture(diameter_mm=10.0, obscuration_diameter_mm=4.0)
    for cell_mm in (0.05, 0.0371, 0.3):
        assert area_mm2(entrance_pupil(APERTURE), cell_mm) == pytest.approx(DISC_MM2, rel=1e-6)
        assert area_mm2(entrance_pupil(ring), cell_mm) == pytest.approx(DISC_MM2 * (1 - 0.16), rel=1e-6)
    for angle_deg in (0.0, 17.0, 45.0, 90.0, 133.0):
        square = Pupil((bar(-5, 5, 10, 0.0),), ((bar(-3, 2, 0.8, angle_deg),),))
        assert area_mm2(square) == pytest.approx(100 - 4.0, rel=1e-6), angle_deg
    mount = Mount(basis="assumed", rings=(Ring(radius_mm=3.0, width_mm=0.4),), hub_diameter_mm=2.0)
    wanted = DISC_MM2 - 2 * math.pi * 3.0 * 0.4 - math.pi
    assert area_mm2(entrance_pupil(APERTURE, mount=mount)) == pytest.approx(wanted, rel=1e-6)


def test_sectors_and_polygons_are_the_points_inside_them() -> None:
    """A sector across the x axis, one beyond a half turn, and a polygon with a corner inwards, listed clockwise."""
    notched = ((-4.0, -3.0), (-3.0, 3.0), (0.0, 0.5), (4.0, 2.0), (3.0, -3.5))

    def sector(
        x: NDArray[np.float64], y: NDArray[np.float64], first: float, opening: float
    ) -> NDArray[np.bool_]:
        r = np.hypot(x, y)
        return (r < 5) & (r > 2) & ((np.degrees(np.arctan2(y, x)) - first) % 360 < opening)

    def polygon(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        crossings = np.zeros(x.shape, dtype=int)
        for (x0, y0), (x1, y1) in zip(notched, notched[1:] + notched[:1], strict=True):
            crossings += ((y0 > y) != (y1 > y)) & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
        return crossings % 2 == 1

    ring = {"diameter_mm": 10.0, "obscuration_diameter_mm": 4.0}
    for first, opening in ((-20.0, 90.0), (100.0, 250.0)):
        part = Aperture(**ring, sector=Sector(first_angle_deg=first, opening_deg=opening))  # type: ignore[arg-type]
        found = mask(entrance_pupil(part), 0.1)
        wanted = by_points(lambda x, y, a=first, b=opening: sector(x, y, a, b), len(found), 0.1)
        assert np.abs(found - wanted).mean() < 2e-4
        assert found.sum() * 0.01 == pytest.approx(math.radians(opening) / 2 * (25 - 4), rel=1e-6)
    found = mask(entrance_pupil(Aperture(diameter_mm=10.0, corners_mm=notched)), 0.1)
    assert np.abs(found - by_points(polygon, len(found), 0.1)).mean() < 2e-4


def test_meshes_have_the_right_open_area_with_a_window_or_a_wire_on_the_axis() -> None:
    """Full windows in a square opening, with cells that are no fraction of pitch or wire."""
    square = Pupil((bar(-4.5, 4.5, 9.0, 0.0),), meshes=(mesh(),))
    assert area_mm2(square, 0.0337) == pytest.approx(81 * 0.93**2, rel=1e-5)
    odd, even = (mask(Pupil((bar(-4, 4, 8.0, 0.0),), meshes=(mesh(windows=n),))) for n in (9, 8))
    centre = len(odd) // 2
    assert odd[centre - 9 : centre + 9, centre - 9 : centre + 9].min() == 1
    assert even[centre, centre + 5] == pytest.approx(0.3, abs=1e-6)  # 35 of 50 um are wire
    np.testing.assert_allclose(odd, odd[::-1], atol=1e-6)
    np.testing.assert_allclose(odd, odd.T, atol=1e-6)


def test_a_mask_equals_counting_points_in_each_cell() -> None:
    """With off-centre parts and no symmetry."""
    corners = ((0.3, -2.0), (2.9, -1.1), (1.2, 0.7))
    mount = Mount(
        basis="drawing",
        rays=(Rays(count=1, width_mm=0.5, first_angle_deg=110.0),),
        polygons=(Polygon(corners_mm=corners),),
    )

    def inside(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        angle = math.radians(110.0)
        along = x * math.cos(angle) + y * math.sin(angle)
        across = -x * math.sin(angle) + y * math.cos(angle)
        on_bar = (along > 0) & (abs(across) < 0.25)
        sides = [
            (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > 0
            for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True)
        ]
        return (np.hypot(x, y) < 5) & ~on_bar & ~np.logical_and.reduce(sides)

    found = mask(entrance_pupil(APERTURE, mount=mount), 0.1)
    wanted = by_points(inside, len(found), 0.1)
    # 900 points give the share of a cell to 0.03; where two edges cross in a cell, shares are multiplied.
    assert np.abs(found - wanted).mean() < 2e-4
    assert np.quantile(np.abs(found - wanted), 0.999) < 0.05
    assert found.sum() == pytest.approx(wanted.sum(), rel=2e-5)


def test_strips_are_parts_of_the_whole() -> None:
    grid = MaskGrid(entrance_pupil(APERTURE, meshes=[mesh()]), CELL_MM)
    whole = grid.rows(0, grid.cells)
    np.testing.assert_array_equal(np.concatenate([grid.rows(0, 77), grid.rows(77, grid.cells)]), whole)
    out = np.full((80, grid.cells), np.nan, dtype=np.float32)
    np.testing.assert_array_equal(grid.rows(40, 90, out=out), whole[40:90])


def test_a_mask_image_keeps_its_area_and_position() -> None:
    """The upper left quarter (y high, x low) is opaque; pixels are wider or narrower than cells."""
    for pixels in (37, 200, 1000):
        share = np.ones((pixels, pixels))
        share[pixels // 2 :, : pixels // 2] = 0
        found = mask(Pupil((bar(-5, 5, 10.0, 0.0),), picture=MaskPicture(share, 10.0)))
        centre = len(found) // 2
        assert found[centre + 40, centre - 40] == 0
        assert found[centre - 40, centre - 40] == found[centre + 40, centre + 40] == pytest.approx(1)
        assert found.sum() * CELL_MM**2 == pytest.approx(100 * share.mean(), rel=1e-5)


def image_mount(width_mm: float = 10.0) -> Mount:
    return Mount(basis="drawing", mask_image=MaskImage(file="mask.png", width_mm=width_mm))


UNFIT = [
    (image_mount(), None, "mask_image"),
    (image_mount(), np.ones((4, 5)), "mask_image"),
    (image_mount(), np.zeros((4, 4)), "mask_image"),
    (image_mount(), np.full((4, 4), np.nan), "mask_image"),
    (image_mount(9.0), np.ones((4, 4)), "mask_image.width_mm"),
    (Mount(basis="assumed", rings=(Ring(radius_mm=4.9, width_mm=0.4),)), None, "rings.0"),
    (Mount(basis="assumed", hub_diameter_mm=11.0), None, "hub_diameter_mm"),
    (Mount(basis="assumed", rays=(Rays(count=2, width_mm=10.0),)), None, "rays.0.width_mm"),
]


def test_the_error_of_an_unfit_mount_names_the_key(subtests: pytest.Subtests) -> None:
    for mount, image, key in UNFIT:
        with subtests.test(key), pytest.raises(DataError, match=rf"bad-mount: mount\.{key}: expected"):
            entrance_pupil(APERTURE, mount=mount, mount_image=image)
