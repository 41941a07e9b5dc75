"""The patterns of meshes agree with exact lines, Fourier sums, their symmetries, and a published PSF."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.convolution.convolver import linear_convolve
from psfcore.diffraction.mesh_series import (
    hexagonal_mesh_kernel,
    mesh_line,
    order_spacing_px,
    rotated_mesh_kernel,
)
from psfcore.instruments.model import Mesh, load_instrument
from psfcore.psf import cumulative_curve

HRI = load_instrument("hri_euv")
AIA = load_instrument("aia_171")


def hri_spacing_px(mesh: Mesh) -> float:
    return order_spacing_px(
        wavelength_angstrom=174.0,
        distance_mm=HRI.mesh_distance_mm(mesh),
        pitch_um=mesh.pitch_um,
        pixel_pitch_um=10.0,
    )


ENTRANCE_PX, WHEEL_PX = (hri_spacing_px(mesh) for mesh in HRI.meshes)
AIA_PX = order_spacing_px(
    wavelength_angstrom=171.0, distance_mm=4129.0, pitch_um=362.857, pixel_pitch_um=12.0
)
OF_HRI = {"pitch_um": 1270.0, "wire_um": 40.0}
OF_AIA = {"pitch_um": 362.857, "wire_um": 34.0}
# The spacing of the orders, and the mesh.
MESHES: dict[str, tuple[float, dict[str, float]]] = {
    "hri entrance": (ENTRANCE_PX, OF_HRI | {"windows": 37}),
    "hri filter wheel": (WHEEL_PX, OF_HRI | {"windows": 16}),
    "hri filter wheel, one beam": (WHEEL_PX, OF_HRI | {"windows": 3}),
    "aia": (AIA_PX, OF_AIA | {"windows": 551}),
    "one window": (ENTRANCE_PX, OF_HRI | {"windows": 1}),
}


def line_of(name: str, size: int) -> NDArray[np.float64]:
    spacing_px, mesh = MESHES[name]
    return mesh_line(spacing_px, **mesh, size=size)  # type: ignore[arg-type]


def rotated(name: str, angle_deg: float, size: int) -> NDArray[np.float64]:
    spacing_px, mesh = MESHES[name]
    return rotated_mesh_kernel(spacing_px, **mesh, angle_deg=angle_deg, size=size)  # type: ignore[arg-type]


def published(name: str, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The published formula at x (px), and its integral over the whole axis."""
    spacing_px, mesh = MESHES[name]
    open_share, windows = 1 - mesh["wire_um"] / mesh["pitch_um"], mesh["windows"]
    phase = np.pi * x / spacing_px  # numpy's sinc takes u / pi
    light = np.sinc(open_share * x / spacing_px) ** 2 * (np.sin(windows * phase) / np.sin(phase)) ** 2
    return light, windows * spacing_px / open_share


def test_orders_lie_at_multiples_of_the_spacing_and_rotate_from_x_towards_y() -> None:
    assert [hri_spacing_px(mesh) for mesh in HRI.meshes] == pytest.approx([5.7365, 0.374], abs=0.001)
    pattern = line_of("hri entrance", 2048)[1024:]
    for order in range(1, 20):
        near = round(order * ENTRANCE_PX)
        assert pattern[near - 2 : near + 3].argmax() == 2
    assert line_of("hri filter wheel", 2048)[1024] ** 2 == pytest.approx(0.936, abs=0.001)
    kernel = rotated("aia", 20.0, 129)
    for order in (1, 2, 3):
        along = order * AIA_PX
        x, y = along * np.cos(np.deg2rad(20)), along * np.sin(np.deg2rad(20))
        assert kernel[64 + round(y), 64 + round(x)] > 100 * kernel[64 - round(y), 64 + round(x)]


def test_the_exact_integral_equals_fine_sampling_of_the_published_formula() -> None:
    size, fine = 64, 2048
    x = (np.arange(size * fine) + 0.5) / fine - size // 2 - 0.5
    for name in ("hri entrance", "hri filter wheel"):
        sampled = published(name, x)[0].reshape(size, fine).sum(axis=1)
        np.testing.assert_allclose(line_of(name, size), sampled / sampled.sum(), rtol=2e-4, atol=1e-9)


def test_without_rotation_the_pattern_is_the_product_of_exact_lines() -> None:
    for name in MESHES:
        line = line_of(name, 512)
        light, whole = published(name, (np.arange(20_000) + 0.5) / 20_000 - 0.5)
        line *= float(light.mean() / whole / line[256])  # as fractions of the light on the whole axis
        exact = np.outer(line, line)
        found = rotated(name, 0.0, 512)
        assert np.abs(found - exact).max() < 1e-4, name
        assert np.abs(found - exact).sum() < 5e-4, name
        assert found.sum() == pytest.approx(exact.sum(), abs=1e-5), name


def test_symmetries_of_a_square_and_light_that_stays_at_its_radius() -> None:
    kernel = rotated("hri entrance", 17.0, 129)
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)
    np.testing.assert_allclose(kernel, np.rot90(kernel), atol=1e-12)
    np.testing.assert_allclose(rotated("hri entrance", 107.0, 129), kernel, atol=1e-12)
    np.testing.assert_allclose(rotated("hri entrance", -17.0, 129), kernel[::-1], atol=2e-5)
    radii = [0.5, 20.3, 60.7, 100.0]
    straight = cumulative_curve(rotated("aia", 0.0, 256), radii)
    for angle_deg in (1.3, 30.0, 45.0, -50.4):
        turned = cumulative_curve(rotated("aia", angle_deg, 256), radii)
        # An order near a radius may fall into a pixel on its other side; a far order holds some 0.1 % of the light.
        np.testing.assert_allclose(turned, straight, atol=0.35, err_msg=f"{angle_deg}")


HEXAGONAL_PX = AIA_PX * 362.857 / 350.0


def hexagonal(angle_deg: float) -> NDArray[np.float64]:
    return hexagonal_mesh_kernel(
        HEXAGONAL_PX, pitch_um=350.0, wire_um=35.0, windows=400, angle_deg=angle_deg, size=257
    )


def test_the_orders_of_a_hexagonal_mesh_are_the_fourier_sum_of_its_openings() -> None:
    """A rectangle of 1 x sqrt(3) pitches repeats the mesh; a point is open if its nearest centre is within w / 2 of it
    in the directions of all three pairs of sides."""
    points, half_width = 1200, 0.45
    x, y = np.meshgrid(
        (np.arange(points) + 0.5) / points, (np.arange(points) + 0.5) / points * np.sqrt(3), indexing="xy"
    )
    mask = np.zeros(x.shape, dtype=bool)
    for cx, cy in ((0, 0), (1, 0), (0.5, np.sqrt(3) / 2), (0, np.sqrt(3)), (1, np.sqrt(3))):
        sides = [
            abs((x - cx) * np.cos(a) + (y - cy) * np.sin(a)) < half_width for a in np.radians([0, 60, 120])
        ]
        mask |= np.logical_and.reduce(sides)
    light = np.abs(np.fft.fft2(mask) / mask.size) ** 2 / mask.mean()
    kernel, spacing = hexagonal(0.0), HEXAGONAL_PX
    assert kernel[128, 128] == pytest.approx(0.81, abs=1e-9), "the open share"
    for m, n in ((1, 1), (0, 2), (-1, 1), (2, 0), (3, 1), (0, 4), (1, 2), (4, 2)):
        column, row = round(128 + m * spacing), round(128 + n / np.sqrt(3) * spacing)
        near = kernel[row - 1 : row + 2, column - 1 : column + 2].sum()
        assert near == pytest.approx(light[n, m], rel=0.02, abs=2e-5), (m, n)
    assert 0.97 < kernel.sum() < 1


def test_the_nearest_orders_of_a_hexagonal_mesh_are_60_degrees_apart() -> None:
    for angle_deg in (0.0, 13.0, 47.0):
        kernel = hexagonal(angle_deg)
        y, x = np.mgrid[-128:129, -128:129]
        spacing = 2 / np.sqrt(3) * HEXAGONAL_PX
        near = abs(np.hypot(x, y) - spacing) < 1.5
        angles = np.degrees(np.arctan2(y, x))[near & (kernel > 1e-3)]
        light = kernel[near & (kernel > 1e-3)]
        turns = np.exp(6j * np.radians(angles - angle_deg - 30))
        assert abs(np.angle((light * turns).sum())) < np.radians(6 * 1.0), (
            "30 degrees from the openings' own axis"
        )
        assert (light * turns.real).sum() > 0.97 * light.sum()
        np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)


# --- AIA 171 against aiapy --------------------------------------------------------------------------------

ARMS_DEG = (49.81, 39.57, -40.13, -50.38)  # Grigis et al. (2012), as aiapy has them
SIZE = 1024


@pytest.fixture(scope="module")
def aiapy(real: Callable[[str], Path]) -> NDArray[np.float64]:
    whole = np.asarray(fits.getdata(real("psf/derived_aia171_psf_aiapy0.10.2.fits")), dtype=np.float64)
    half = whole.shape[0] // 2
    return whole[half - SIZE // 2 : half + SIZE // 2, half - SIZE // 2 : half + SIZE // 2]


@pytest.fixture(scope="module")
def ours() -> NDArray[np.float64]:
    places = {place: np.zeros((SIZE, SIZE)) for place in ("entrance", "filter_wheel")}
    for mesh in AIA.meshes:
        spacing_px = order_spacing_px(
            wavelength_angstrom=AIA.wavelength_angstrom,
            distance_mm=AIA.mesh_distance_mm(mesh),
            pitch_um=mesh.pitch_um,
            pixel_pitch_um=AIA.detector.pixel_pitch_um,
        )
        series = {key: getattr(mesh, key) for key in ("pitch_um", "wire_um", "windows", "angle_deg")}
        places[mesh.place] += mesh.share * rotated_mesh_kernel(spacing_px, **series, size=SIZE)
    return linear_convolve(places["entrance"], places["filter_wheel"], (SIZE, SIZE), threads=2)


def arms_by_centroid(kernel: NDArray[np.float64], spacing_px: float) -> list[tuple[float, float]]:
    """(angle in degrees, spacing in px) of each arm: a line through the centroids of orders 3 to 30.

    All orders have the same weight: each unblurred order fills one pixel, and only their number averages the rounding.
    """
    found = []
    box = np.arange(-3, 4)
    middle = kernel.shape[0] // 2
    for angle in np.deg2rad(ARMS_DEG):
        places = []
        for order in range(3, 31):
            x, y = (round(middle + order * spacing_px * f(angle)) for f in (np.cos, np.sin))
            light = kernel[y - 3 : y + 4, x - 3 : x + 4]
            light = np.maximum(light - np.median(light), 0)
            dx, dy = (light.sum(axis=0) @ box, light.sum(axis=1) @ box) / light.sum()
            places.append((order, x + dx - middle, y + dy - middle))
        k, x, y = np.array(places).T
        slope_x, slope_y = k @ x / (k @ k), k @ y / (k @ k)
        found.append((float(np.rad2deg(np.arctan2(slope_y, slope_x))), float(np.hypot(slope_x, slope_y))))
    return found


def test_aia_arms_and_light_agree_with_aiapy(aiapy: NDArray[np.float64], ours: NDArray[np.float64]) -> None:
    theirs, found = arms_by_centroid(aiapy, 16.26), arms_by_centroid(ours, 16.26)
    for (their_angle, their_spacing), (angle, spacing) in zip(theirs, found, strict=True):
        # The file has one angle per mesh; the measured arms differ from 90 degrees by 0.06 and 0.05 degrees.
        assert angle == pytest.approx(their_angle, abs=0.06)
        assert their_spacing == pytest.approx(16.26, abs=0.01)
        assert spacing == pytest.approx(16.26, abs=0.02)
    # 18.4 % lie beyond 10.75 px. Both keep 0.82 in order zero and give each arm the same light.
    # aiapy stops at order 100 and has no orders off the axes (0.9 % of the light here), so it has less light
    # far out. Its core is a Gaussian of 0.47 px, so it has less light in the central pixel.
    theirs = dict(zip((0.5, 1.5, 10.75, 100), cumulative_curve(aiapy, [0.5, 1.5, 10.75, 100]), strict=True))
    found = dict(zip((0.5, 1.5, 10.75, 100), cumulative_curve(ours, [0.5, 1.5, 10.75, 100]), strict=True))
    assert theirs[10.75] == pytest.approx(18.43, abs=0.05)
    assert found[10.75] == pytest.approx(theirs[10.75], abs=0.15)
    assert found[1.5] == pytest.approx(theirs[1.5], abs=0.3)
    assert 0.2 < found[100] - theirs[100] < 0.6
    assert 4 < theirs[0.5] - found[0.5] < 7
