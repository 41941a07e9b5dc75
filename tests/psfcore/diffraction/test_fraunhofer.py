"""The far field agrees with direct sums and with formulas, and conserves energy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import j0, j1, jn_zeros

from psfcore.diffraction import fraunhofer, mirrored
from psfcore.diffraction.fraunhofer import FarField, far_field, samples_per_pixel
from psfcore.diffraction.mesh_series import mesh_line, order_spacing_px
from psfcore.diffraction.open_aperture import airy_kernel, airy_light_beyond, edge_kernel
from psfcore.diffraction.pupil import MaskGrid, MaskPicture, Pupil, bar, circle, entrance_pupil
from psfcore.instruments.model import Aperture, Mesh, Sector, load_instrument
from psfcore.psf import cumulative_curve, squared_radii

HRI = load_instrument("hri_euv")
OPTICS = {"wavelength_angstrom": 174.0, "focal_length_mm": 4187.0, "pixel_pitch_um": 10.0}
LAMBDA_F_OVER_P_MM = 174e-7 * 4187.0 / 10e-3


def far(pupil: Pupil, size: int, **changes: object) -> FarField:
    return far_field(pupil, **(OPTICS | {"size": size, "threads": 2} | changes))  # type: ignore[arg-type]


def directly(pupil: Pupil, size: int, samples: int, area_mm2: float) -> NDArray[np.float64]:
    """Reference: the definition, Eq. (1) and (2), as matrix products; not divided by the cells' sinc."""
    grid = MaskGrid(pupil, LAMBDA_F_OVER_P_MM / size)
    c = grid.rows(0, grid.cells).astype(np.float64)
    q = (np.arange(size * samples) + 0.5) / samples - 0.5 - size // 2
    wave = np.exp(-2j * np.pi * np.outer(q, np.arange(grid.cells) - (grid.cells - 1) / 2) / size)
    intensity = np.abs(wave @ c @ wave.T) ** 2
    pixels = intensity.reshape(size, samples, size, samples).sum(axis=(1, 3))
    return np.asarray(pixels / (size**2 * samples**2) / (area_mm2 / grid.cell_mm**2))


def unwindowed(pattern: NDArray[np.float64]) -> NDArray[np.float64]:
    n = len(pattern)
    sinc = np.sinc((np.arange(n) - n // 2) / n) ** 2
    return pattern * sinc[:, None] * sinc[None, :]


def small(opaque: tuple[NDArray[np.float64], ...] = (), **changes: object) -> Pupil:
    return Pupil((circle(6.0),), tuple((corners,) for corners in opaque), **changes)  # type: ignore[arg-type]


POLYGON = np.array([(1.0, 0.5), (5.0, 1.0), (2.0, 2.5)])
PICTURE = np.ones((5, 5))
PICTURE[3, 0] = 0


PUPILS = [
    (small(), "mirror and transpose"),
    (small((bar(-7, 7, 1.0, 0.0),)), "mirror"),  # both axes
    (small((bar(0, 7, 1.0, 0.0),)), "mirror"),  # y alone
    (small((bar(0, 7, 1.0, 90.0),)), "mirror"),  # x alone
    (small((bar(0, 7, 1.0, 30.0),)), "none"),
    (small((bar(0, 7, 1.0, 45.0),)), "none"),  # a diagonal alone
    (small((POLYGON - 4.0, POLYGON)), "none"),
    (small(picture=MaskPicture(PICTURE, 14.0)), "none"),
]


def test_a_small_pupil_equals_the_direct_sum() -> None:
    for number, (pupil, symmetry) in enumerate(PUPILS):
        found = far(pupil, 32)
        assert found.symmetry == symmetry, number
        expected = directly(pupil, 32, found.samples, found.open_area_mm2)
        np.testing.assert_allclose(
            unwindowed(found.pattern), expected, rtol=2e-5, atol=1e-9, err_msg=f"{number}"
        )


def test_a_mirrored_pupil_gives_the_pattern_of_the_complex_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    pupil = entrance_pupil(HRI.aperture, mount=HRI.mount, meshes=HRI.meshes[:1])
    for size, period in ((40, 64), (96, 96), (30, 512)):
        found = far(pupil, size, period=period)
        with monkeypatch.context() as patched:
            patched.setattr(fraunhofer, "can_transform", lambda period: False)
            complex_sum = far(pupil, size, period=period)
        largest = complex_sum.pattern.max()
        np.testing.assert_allclose(found.pattern, complex_sum.pattern, rtol=2e-5, atol=1e-8 * largest)
        assert found.pattern.sum() == pytest.approx(complex_sum.pattern.sum(), rel=3e-7)


def test_energy_is_conserved_with_any_threads_and_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Over a whole period the sum is that of the mask's squares (Parseval), within the rounding of float32."""
    for pupil in (small(), small((POLYGON,))):
        found = far(pupil, 256)
        grid = MaskGrid(pupil, LAMBDA_F_OVER_P_MM / 256)
        c = grid.rows(0, grid.cells).astype(np.float64)
        assert unwindowed(found.pattern).sum() == pytest.approx((c**2).sum() / c.sum(), rel=2e-7)
        assert found.open_area_mm2 == pytest.approx(c.sum() * grid.cell_mm**2, rel=1e-5)
    # With little memory, the mask is read in several passes, each for some of the samples.
    for pupil in (small(), small((POLYGON,))):
        one, three = (far(pupil, 96, threads=threads).pattern for threads in (1, 3))
        np.testing.assert_array_equal(one, three)
    whole = far(small(), 32).pattern
    monkeypatch.setattr(mirrored, "FIELD_BYTES", 1)
    np.testing.assert_array_equal(far(small(), 32).pattern, whole)


def test_samples_follow_the_pupils_width() -> None:
    assert samples_per_pixel(47.4, **OPTICS) == samples_per_pixel(3.0, **OPTICS) == 14
    assert samples_per_pixel(10 * LAMBDA_F_OVER_P_MM, **OPTICS) == 20
    assert samples_per_pixel(10.01 * LAMBDA_F_OVER_P_MM, **OPTICS) == 22


def test_a_longer_period_removes_wrapped_light() -> None:
    exact = airy_kernel(**OPTICS, diameter_mm=12.0, size=64)
    wrapped, longer = (far(small(), 64, period=period).pattern for period in (64, 256))
    outside = squared_radii(exact.shape) > 5**2  # further in, the sum over samples dominates the difference
    errors = [np.abs(found - exact)[outside].sum() for found in (wrapped, longer)]
    assert longer.shape == (64, 64)
    assert errors[1] < 0.1 * errors[0]
    assert 1 - longer.sum() == pytest.approx(1 - exact.sum(), rel=0.05)


def test_the_airy_pattern_agrees_with_its_formula_and_the_open_disc_with_it() -> None:
    """Dark at 1.22 lambda f / D with 83.8 % within; the pixels equal a fine sum of (2 J1(v) / v)^2."""
    assert 1 - airy_light_beyond(jn_zeros(1, 1))[0] == pytest.approx(0.8378, abs=1e-4)
    fine, size = 100, 16
    q = (np.arange(size * fine) + 0.5) / fine - 0.5 - size // 2
    v_per_px = np.pi * 5.0 / LAMBDA_F_OVER_P_MM
    v = v_per_px * np.hypot(q[:, None], q[None, :])
    intensity = v_per_px**2 / (4 * np.pi) * (2 * j1(v) / v) ** 2
    wanted = intensity.reshape(size, fine, size, fine).mean(axis=(1, 3))
    found = airy_kernel(**OPTICS, diameter_mm=5.0, size=size)
    np.testing.assert_allclose(found, wanted, rtol=3e-4)
    # The sum over samples and the integral differ by at most 4e-4 of the light in a pixel.
    pupil = entrance_pupil(HRI.aperture)
    found = far(pupil, 128, period=512).pattern
    exact = airy_kernel(**OPTICS, diameter_mm=47.4, size=128)
    assert np.abs(found - exact).max() < 4e-4
    near = squared_radii(exact.shape) < 30**2
    np.testing.assert_allclose(found[near], exact[near], rtol=0.06)
    assert found.sum() == pytest.approx(exact.sum(), abs=2e-5)


def test_a_ring_aperture_agrees_with_the_integral_and_spreads_more_light() -> None:
    v = np.arange(0, 60, 0.02)
    np.testing.assert_allclose(airy_light_beyond(v, 1e-9), j0(v) ** 2 + j1(v) ** 2, atol=1e-7)
    ring = Aperture(diameter_mm=12.0, obscuration_diameter_mm=5.0)
    found = far(entrance_pupil(ring), 64, period=256).pattern
    exact = airy_kernel(**OPTICS, diameter_mm=12.0, obscuration_diameter_mm=5.0, size=64)
    assert np.abs(found - exact).max() < 1e-3
    assert (
        cumulative_curve(exact, [0.5])[0]
        > cumulative_curve(airy_kernel(**OPTICS, diameter_mm=12.0, size=64), [0.5])[0]
    )


def test_a_square_mesh_is_the_analytic_series() -> None:
    """With N windows in a square pupil the published formula holds, along an axis and off it."""
    windows, pitch_mm = 11, 1.27
    side_mm = windows * pitch_mm
    mesh = Mesh(name="m", place="entrance", pitch_um=1270.0, wire_um=40.0, windows=windows)
    pupil = Pupil((bar(-side_mm / 2, side_mm / 2, side_mm, 0.0),), meshes=(mesh,))
    found = far(pupil, 128, period=1024).pattern
    spacing_px = order_spacing_px(
        wavelength_angstrom=174.0, distance_mm=4187.0, pitch_um=1270.0, pixel_pitch_um=10.0
    )
    line = mesh_line(spacing_px, pitch_um=1270.0, wire_um=40.0, windows=windows, size=4096)
    line = line[2048 - 64 : 2048 + 64]
    exact = np.outer(line, line)
    assert np.abs(found - exact).max() < 1e-3
    blocks = [part.reshape(16, 8, 16, 8).sum(axis=(1, 3)) for part in (found, exact)]
    assert np.abs(blocks[0] - blocks[1]).max() < 5e-4
    assert found.sum() == pytest.approx(exact.sum(), abs=1e-3)


def test_a_square_pupil_is_the_product_of_two_slits() -> None:
    """The share of a slit of width a in a pixel is the integral of a sinc^2(a q) over it."""
    side_mm, size, fine = 9.0, 32, 200
    corners = tuple((side_mm / 2 * x, side_mm / 2 * y) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
    found = far(entrance_pupil(Aperture(diameter_mm=13.0, corners_mm=corners)), size, period=1024).pattern
    q = (np.arange(size * fine) + 0.5) / fine - 0.5 - size // 2
    slit = side_mm / LAMBDA_F_OVER_P_MM * np.sinc(side_mm / LAMBDA_F_OVER_P_MM * q) ** 2
    line = slit.reshape(size, fine).mean(axis=1)
    np.testing.assert_allclose(found, np.outer(line, line), atol=2e-3 * found.max())
    assert found.sum() == pytest.approx(line.sum() ** 2, abs=3e-4)


WIDE = {"wavelength_angstrom": 171.0, "focal_length_mm": 1750.0, "pixel_pitch_um": 13.5, "size": 64}


def test_the_edges_of_a_wide_disc_or_ring_give_its_airy_pattern() -> None:
    for obscuration_mm in (0.0, 65.0):
        ring = Aperture(diameter_mm=98.0, obscuration_diameter_mm=obscuration_mm)
        found = edge_kernel(ring, **WIDE)  # type: ignore[arg-type]
        exact = airy_kernel(diameter_mm=98.0, obscuration_diameter_mm=obscuration_mm, **WIDE)  # type: ignore[arg-type]
        assert found[32, 32] == pytest.approx(exact[32, 32], abs=1e-3)
        radii = [1.5, 5.5, 20.5]
        beyond = [cumulative_curve(one, radii) - 100 * (1 - one.sum()) for one in (found, exact)]
        np.testing.assert_allclose(100 * (1 - found.sum()), 100 * (1 - exact.sum()), rtol=0.02)
        np.testing.assert_allclose(beyond[0], beyond[1], rtol=0.02)


def test_the_edges_of_a_sector_and_of_a_polygon_give_their_far_field() -> None:
    """In the spikes of the straight edges and in the fan of the arc."""
    optics = {"wavelength_angstrom": 171.0, "focal_length_mm": 1750.0, "pixel_pitch_um": 13.5}
    quadrant = Sector(first_angle_deg=0.0, opening_deg=90.0)
    turned = [(20 * math.cos(a), 20 * math.sin(a)) for a in np.radians(np.arange(15.0, 375.0, 60.0))]
    for aperture in (
        Aperture(diameter_mm=52.0, obscuration_diameter_mm=16.0, sector=quadrant),
        Aperture(diameter_mm=40.0, corners_mm=tuple(turned)),
    ):
        found = edge_kernel(aperture, size=32, **optics)  # type: ignore[arg-type]
        exact = far_field(entrance_pupil(aperture), size=32, period=256, threads=1, **optics).pattern  # type: ignore[arg-type]
        assert found[16, 16] == pytest.approx(exact[16, 16], abs=4e-3)
        bright = exact > 1e-4
        bright[16, 16] = False
        assert bright.sum() > 20 and found[bright].sum() == pytest.approx(exact[bright].sum(), rel=0.02)
        np.testing.assert_allclose(found[bright], exact[bright], rtol=0.15, atol=2e-5)
