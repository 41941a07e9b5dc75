"""Waves agree with closed forms: Gaussian beams, slits, parabolas, a whole telescope of parabolas."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import fresnel as fresnel_integrals

from psfcore.convolution.convolver import ChirpTransform
from psfcore.diffraction import fresnel
from psfcore.diffraction.fresnel import (
    FresnelStep,
    Grid,
    binned_light,
    common_openings_mm,
    conic_sag_mm,
    fraunhofer_field,
    grid_for,
    line_light_beyond,
    mesh_openings_mm,
    mirror_transmission,
    open_share,
)
from psfcore.diffraction.fresnel_study import FresnelStudy, fresnel_study
from psfcore.diffraction.light_path import (
    BestFocus,
    LightPath,
    Waves,
    best_focus,
    focal_mm,
    light_path,
    paraxial_separation_mm,
    waves_to_detector,
)
from psfcore.diffraction.plots import fresnel_png
from psfcore.errors import DataError
from psfcore.instruments.model import Aperture, Mirror, load_instrument

HRI = load_instrument("hri_euv")
LAMBDA_MM = 1.74e-5
Complex = NDArray[np.complex128]


@pytest.fixture(scope="module")
def path() -> LightPath:
    return light_path(HRI)


@pytest.fixture(scope="module")
def focus(path: LightPath) -> BestFocus:
    return best_focus(waves_to_detector(path), nominal_focal_length_mm=HRI.focal_length_mm)


@pytest.fixture(scope="module", autouse=True)
def one_focus(focus: BestFocus) -> Iterator[None]:
    """All studies have the same mirrors, so they use one search for the best focus."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("psfcore.diffraction.fresnel_study.best_focus", lambda waves, **_: focus)
        yield


@pytest.fixture(scope="module")
def study(one_focus: None) -> FresnelStudy:
    return fresnel_study(HRI, distances_mm=(273.0,), phases=4)


def gaussian_beam(x_mm: NDArray[np.float64], z_mm: float, waist_mm: float) -> Complex:
    q = 1 + 1j * z_mm * LAMBDA_MM / (np.pi * waist_mm**2)
    return np.exp(-(x_mm**2) / waist_mm**2 / q) / np.sqrt(q)


def slit_field(x_mm: NDArray[np.float64], begin_mm: float, end_mm: float, z_mm: float) -> Complex:
    """A plane wave behind a slit, by the Fresnel integrals."""
    scale = np.sqrt(2 / (LAMBDA_MM * z_mm))
    s_end, c_end = fresnel_integrals(scale * (end_mm - x_mm))
    s_begin, c_begin = fresnel_integrals(scale * (begin_mm - x_mm))
    return (c_end - c_begin + 1j * (s_end - s_begin)) / np.sqrt(2j)


# --- the transform and the propagator ---


def through(field: Complex, source: Grid, target: Grid, distance_mm: float) -> Complex:
    return FresnelStep(source, target, distance_mm).apply(field)


def test_the_chirp_transform_equals_the_direct_sum() -> None:
    for samples, out_samples in ((7, 7), (12, 5), (5, 12), (1, 4), (64, 33)):
        f = np.random.default_rng(1).normal(size=samples) + 1j * np.arange(samples)
        n, k = np.arange(samples) - (samples - 1) / 2, np.arange(out_samples) - (out_samples - 1) / 2
        plain = np.exp(-2j * np.pi * 0.037 * np.outer(k, n)) @ f
        transformed = ChirpTransform(0.037, samples, out_samples).apply(f)
        np.testing.assert_allclose(transformed, plain, atol=1e-12 * samples)
    with pytest.raises(DataError, match="field-shape"):
        ChirpTransform(0.1, 8, 8).apply(np.zeros(9, dtype=np.complex128))


def test_propagation_conserves_the_light_of_any_field() -> None:
    source = Grid("a", 2000, 0.001, LAMBDA_MM)
    rng = np.random.default_rng(0)
    field = rng.normal(size=2000) + 1j * rng.normal(size=2000)
    for out_samples in (2000, 3001):
        period_mm = LAMBDA_MM * 300.0 / 0.001  # of the sum
        target = Grid("b", out_samples, period_mm / out_samples, LAMBDA_MM)
        light = target.light(through(field, source, target, 300.0))
        assert light == pytest.approx(source.light(field), rel=1e-10)


def test_a_gaussian_beam_spreads_by_its_formula() -> None:
    # The sum is periodic in lambda z / step, at least 1.7 mm.
    source, target = Grid("a", 8000, 0.0005, LAMBDA_MM), Grid("b", 1601, 0.0008, LAMBDA_MM)
    waist = gaussian_beam(source.x_mm, 0.0, 0.2).astype(complex)
    for z_mm in (50.0, 655.9):
        after = through(waist, source, target, z_mm)
        np.testing.assert_allclose(after, gaussian_beam(target.x_mm, z_mm, 0.2), atol=1e-10)


def test_a_slit_gives_the_fresnel_integrals() -> None:
    source = grid_for("slit", LAMBDA_MM, 1.3, 6.0, 273.0)
    target = Grid("screen", 2001, 0.001, LAMBDA_MM)
    field = open_share(source, np.array([[-0.61, 0.62]])).astype(complex)
    after = through(field, source, target, 273.0)
    np.testing.assert_allclose(after, slit_field(target.x_mm, -0.61, 0.62, 273.0), atol=0.004)


# --- mirrors and masks ---


def test_the_sag_lies_on_its_conic_and_ends_at_the_radius_of_a_sphere() -> None:
    x_mm = np.linspace(-60, 60, 25)
    for conic in (0.0, -1.0, -2.04, 0.5):
        sag = conic_sag_mm(x_mm, radius_mm=257.0, conic=conic)
        np.testing.assert_allclose(x_mm**2 - 2 * 257.0 * sag + (1 + conic) * sag**2, 0, atol=1e-9)
        assert sag[12] == 0 and np.all(sag >= 0)
    sag = conic_sag_mm([0.0, 3.0, 5.0, 6.0], radius_mm=5.0, conic=0.0)
    np.testing.assert_allclose(sag, [0, 1, 5, np.nan])


def test_a_parabola_focuses_at_half_its_radius() -> None:
    mirror = Mirror(name="m", radius_mm=1518.0, conic=-1.0, diameter_mm=10.0, figure="concave")
    grid = Grid("mirror", 60_000, 0.0002, LAMBDA_MM)
    field = mirror_transmission(mirror, grid)
    axis = Grid("axis", 1, 1.0, LAMBDA_MM)
    distances = np.arange(758.0, 760.01, 0.05)
    on_axis = [abs(through(field, grid, axis, z)[0]) for z in distances]
    assert distances[np.argmax(on_axis)] == pytest.approx(759.0, abs=0.06)
    screen = Grid("focus", 1601, 0.0002, LAMBDA_MM)
    image = through(field, grid, screen, 759.0)
    u = screen.x_mm / (LAMBDA_MM * 759.0)
    expected = 10.0**2 * np.sinc(10.0 * u) ** 2 / (LAMBDA_MM * 759.0)
    np.testing.assert_allclose(np.abs(image) ** 2, expected, atol=1e-4 * expected.max())


def test_a_mesh_is_open_in_its_windows_for_any_samples(
    path: LightPath,
) -> None:
    grid = Grid("g", 1270, 0.01, LAMBDA_MM)  # ten pitches
    still, moved = (open_share(grid, mesh_openings_mm(HRI.meshes[0], phase, 20.0)) for phase in (0.0, 0.5))
    assert still.mean() == pytest.approx(1.23 / 1.27, rel=1e-12)
    assert still[635] == pytest.approx(1, abs=1e-9), "at phase 0 a window is on the axis"
    assert moved[635] == pytest.approx(0, abs=1e-9), "at phase 0.5 a wire is"
    ring = replace(path, aperture=Aperture(diameter_mm=47.4, obscuration_diameter_mm=9.1))
    windows = mesh_openings_mm(HRI.meshes[0], 0.21, 47.4)
    both = common_openings_mm(ring.aperture_mm, windows)
    for samples in (999, 50_000):
        grid = Grid("g", samples, 48.0 / samples, LAMBDA_MM)
        length = open_share(grid, both).sum() * grid.step_mm
        assert length == pytest.approx(float(np.diff(both).sum()), rel=1e-12)
    assert open_share(Grid("g", 9, 1.0, LAMBDA_MM), both).max() == 0, "the middle is obscured"


def test_fraunhofer_is_the_integral_over_the_openings() -> None:
    openings = np.array([[-3.0, -1.0], [0.5, 2.0]])
    grid = Grid("d", 41, 0.001, LAMBDA_MM)
    x = (np.arange(50_000) + 0.5) * 1e-4 - 3.0
    lit = ((x > -3) & (x < -1)) | ((x > 0.5) & (x < 2))
    reach = LAMBDA_MM * 4187.0
    plain = np.exp(-2j * np.pi * np.outer(grid.x_mm, x[lit]) / reach).sum(axis=1) * 1e-4 / np.sqrt(1j * reach)
    found = fraunhofer_field(openings, grid, 4187.0)
    np.testing.assert_allclose(found, plain, atol=1e-5)


def test_light_beyond_counts_whole_pixels_on_both_sides() -> None:
    line = np.array([1.0, 2.0, 10.0, 3.0, 4.0])
    np.testing.assert_allclose(line_light_beyond(line, [0, 1, 2]), [0.5, 0.25, 0.0])


# --- the telescope ---


def collins(path: LightPath, separation_mm: float, behind_mm: float, x_mm: NDArray[np.float64]) -> Complex:
    """The field behind a parabolic secondary as one integral from the entrance, each window in closed form."""
    free: Callable[[float], NDArray[np.float64]] = lambda z: np.array([[1.0, z], [0.0, 1.0]])  # noqa: E731
    lens: Callable[[float], NDArray[np.float64]] = lambda f: np.array([[1.0, 0.0], [-1 / f, 1.0]])  # noqa: E731
    system = free(behind_mm) @ lens(focal_mm(path.secondary)) @ free(separation_mm)
    system = system @ lens(focal_mm(path.primary)) @ free(path.aperture_to_primary_mm)
    (a, b), (_, d) = system
    curve = a / (path.wavelength_mm * b)
    total = np.zeros(x_mm.size, dtype=complex)
    for begin, end in path.entrance_mm:
        s1, c1 = fresnel_integrals(np.sqrt(2 * abs(curve)) * (begin - x_mm / a))
        s2, c2 = fresnel_integrals(np.sqrt(2 * abs(curve)) * (end - x_mm / a))
        total += c2 - c1 + 1j * np.sign(curve) * (s2 - s1)
    total /= np.sqrt(2 * abs(curve) * abs(path.wavelength_mm * b))
    phase = np.pi / (path.wavelength_mm * b) * (d - 1 / a) * x_mm**2
    return total * np.exp(1j * phase) / np.sqrt(np.diff(path.entrance_mm).sum())


def test_a_telescope_of_parabolas_matches_the_closed_form(path: LightPath) -> None:
    """At every plane and with both meshes, the transforms agree with Fresnel integrals and with a plain sum."""
    path = replace(path, secondary=replace(path.secondary, conic=-1.0))
    separation = paraxial_separation_mm(path)
    behind, distance = path.secondary_to_detector_mm - 273.0, 273.0
    wheel, detector = path.wheel_grid(distance), path.detector_grid
    waves = Waves(path, wheel, behind)
    field = waves.at_plane(waves.at_secondary(waves.at_primary(path.entrance_mm), separation))
    sample = np.flatnonzero(np.abs(wheel.x_mm) < 2.5)[::211]
    exact = collins(path, separation, behind, wheel.x_mm[sample])
    np.testing.assert_allclose(np.abs(field[sample]), np.abs(exact), atol=0.006 * float(np.abs(exact).max()))

    windows = mesh_openings_mm(path.wheel_mesh, 0.3, wheel.width_mm)
    after = through(field * open_share(wheel, windows), wheel, detector, distance)
    # An independent grid, finer and narrower than that of the study.
    fine = Grid("fine", 60_001, 8.0 / 60_001, LAMBDA_MM)
    lit = collins(path, separation, behind, fine.x_mm) * open_share(fine, windows)
    points = detector.samples // 2 + np.array([0, 2, 9, 40, 92, 183])
    reach = path.wavelength_mm * distance
    kernel = np.exp(1j * np.pi / reach * (detector.x_mm[points][:, None] - fine.x_mm) ** 2)
    plain = np.abs(kernel @ lit * fine.step_mm) / np.sqrt(reach)
    np.testing.assert_allclose(np.abs(after[points]), plain, atol=0.003 * plain.max())


def test_best_focus_is_where_rays_meet_and_gives_fraunhofer(focus: BestFocus, path: LightPath) -> None:
    assert focus.separation_mm == pytest.approx(653.81, abs=0.01)
    assert focus.separation_mm == pytest.approx(focus.paraxial_separation_mm, abs=0.01)
    assert focus.shift_mm == pytest.approx(-1.89, abs=0.01)
    assert "655.700 mm by -1.887 mm" in focus.message
    assert focus.printed_blur_px > 30
    assert focus.beyond_central_pixel_printed > 0.9 > 0.05 > focus.beyond_central_pixel_focused
    # The focal length of the rays is that of the orders.
    assert focus.focal_length_mm == pytest.approx(4187.0, rel=1e-3)
    assert focus.focal_length_from_orders_mm == pytest.approx(focus.focal_length_mm, rel=3e-4)
    assert focus.order_spacing_px == pytest.approx(5.73, abs=0.005)
    # The light of the open aperture outside the central pixel is 1 - integral of sinc^2.
    grid = path.detector_grid
    field = fraunhofer_field(path.aperture_mm, grid, focus.focal_length_mm)
    line = binned_light(field, grid, 16)
    ideal = 1 - line[line.size // 2] / line.sum()
    assert focus.beyond_central_pixel_focused == pytest.approx(ideal, abs=0.002)


# --- the study ---


def test_the_methods_agree_and_the_sampling_loses_no_light(study: FresnelStudy, tmp_path: Path) -> None:
    """The mesh moved to the left gives the same as moved to the right. The study is plotted."""
    (result,) = study.distances
    assert result.largest_points < 0.6
    assert result.largest_single_points < 1.5
    assert result.fresnel_line.sum() == pytest.approx(1, abs=1e-12)
    assert result.beam_mm == pytest.approx(3.09, abs=0.01)
    np.testing.assert_allclose(result.fresnel_line, result.fresnel_line[::-1], atol=1e-9)
    assert result.phase_largest_points[1] == pytest.approx(result.phase_largest_points[3], abs=1e-6)
    fresnel_png(study, tmp_path / "f.png")
    assert matplotlib.image.imread(tmp_path / "f.png").std() > 0.05
    planes = {plane.plane: plane for plane in study.distances[0].sampling}
    assert list(planes) == ["aperture", "primary", "secondary", "filter wheel", "detector"]
    assert planes["aperture"].least_samples == pytest.approx(47.4 * 66 / (LAMBDA_MM * 655.9), rel=1e-5)
    assert planes["aperture"].samples >= 1.49 * (planes["aperture"].least_samples or 0)
    assert planes["secondary"].light == pytest.approx(1, abs=2e-4)
    assert planes["filter wheel"].light == pytest.approx(1.23 / 1.27, abs=0.003)
    assert planes["detector"].light == pytest.approx(planes["filter wheel"].light, abs=5e-4)


def test_finer_sampling_changes_nothing(study: FresnelStudy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fresnel, "SAMPLING_MARGIN", 2.5)
    finer = fresnel_study(HRI, distances_mm=(273.0,), phases=1)
    coarse = study.distances[0].phase_largest_points[0]
    assert finer.distances[0].phase_largest_points[0] == pytest.approx(coarse, abs=0.01)


def test_more_windows_bring_the_series_closer() -> None:
    """A series of few windows adds the diffraction at the edges of the beam, which the entrance's image already has.

    A study is plain JSON, and reports its progress.
    """
    reported: list[tuple[int, int]] = []
    few = fresnel_study(
        HRI, distances_mm=(400.0, 250.0), phases=2, windows=4, progress=lambda *done: reported.append(done)
    )
    assert reported == [(done, 5) for done in range(6)]
    many = fresnel_study(HRI, distances_mm=(400.0,), phases=2, windows=100)
    assert many.distances[0].largest_points < 0.3 < 1.0 < few.distances[0].largest_points
    content = json.loads(json.dumps(few.as_json(), allow_nan=False))
    assert content["focus"]["shift_mm"] == pytest.approx(-1.89, abs=0.01)
    assert [result["distance_mm"] for result in content["distances"]] == [400.0, 250.0]
    for result in content["distances"]:
        assert len(result["difference_points"]) == len(content["radii_px"])
        assert len(result["fresnel_line"]) == len(content["offsets_px"])
        assert len(result["phase_largest_points"]) == 2


def test_bad_requests_are_refused_before_the_work_and_a_missing_key_is_named() -> None:
    reported: list[int] = []
    for code, options in (
        ("bad-distance", {"distances_mm": (273.0, 580.0)}),
        ("bad-distance", {"distances_mm": (float("nan"),)}),
        ("bad-distance", {"distances_mm": ()}),
        ("bad-phases", {"phases": 0}),
        ("bad-windows", {"windows": 0}),
        ("too-many-samples", {"distances_mm": (273.0, 1.0)}),
        ("too-many-samples", {"distances_mm": (273.0, 579.0)}),
    ):
        with pytest.raises(DataError, match=code):
            fresnel_study(HRI, progress=lambda done, of: reported.append(done), **options)  # type: ignore[arg-type]
    assert reported == []
    secondary = replace(light_path(HRI).secondary, figure="concave")
    blind = replace(light_path(HRI), secondary=secondary, secondary_to_detector_mm=128.5)
    with pytest.raises(DataError, match="no-focus"):
        paraxial_separation_mm(blind)
    tilted = (replace(HRI.meshes[0], angle_deg=45.0), HRI.meshes[1])
    for changes, key in (
        ({"mirrors": ()}, "mirrors: expected a primary and a secondary"),
        ({"mirrors": HRI.mirrors[:1]}, "mirrors"),
        ({"distances": None}, "distances"),
        ({"meshes": HRI.meshes[:1]}, "meshes: expected one mesh at place 'filter_wheel'; got 0"),
        ({"meshes": tilted}, "angle_deg"),
    ):
        with pytest.raises(DataError, match=f"bad-instrument-file: hri_euv: .*{key}"):
            fresnel_study(replace(HRI, **changes))


@pytest.mark.slow
def test_every_distance_of_the_published_study() -> None:
    """The mean over phases is within a point everywhere; single phases reach 3.7 points near the detector."""
    study = fresnel_study(HRI)
    largest = {result.distance_mm: result.largest_points for result in study.distances}
    assert list(largest) == [50, 100, 200, 273, 400, 500, 550]
    assert max(largest.values()) < 1.0
    assert largest[273.0] < 0.73
    near = study.distances[0].largest_single_points
    assert 3.0 < near < 4.0
    assert near > 3 * study.distances[3].largest_single_points
