"""Simulated transits agree with their plan and their truth."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.fits.observation import read_observation
from psfcore.instruments.model import load_instrument
from psfcore.noise import Noise
from psfcore.scatter.power_law import scatter_kernel
from psfcore.simulate.plan import COMBINED, HIGH, Plan, default_plan
from psfcore.simulate.scatter_truth import ScatterTruth, anisotropic_kernel, total_kernel
from psfcore.simulate.scene import drawn_scene, observe, scene_from_image, solar_scene
from psfcore.simulate.sky import TrueSky, covered_share, fully_dark, true_sky
from psfcore.simulate.transit import (
    HRI_EUV,
    SimulatedTransit,
    imitated,
    observed_transit,
    read_sky,
    reported_places,
    simulate,
    write,
)
from psfcore.transit.folder import read_transit
from psfcore.transit.transit import Place
from tests.conftest import SMALL_INSTRUMENT
from tests.psfcore.conftest import LIMITS, delta, gaussian, make_psf
from tests.psfcore.small_transits import true_scene

SCATTER = ScatterTruth(6.15, 2.53, 0.411)
DIFFRACTION = gaussian(31, 1.5)


@pytest.fixture(scope="module")
def small() -> SimulatedTransit:
    return simulate(default_plan(6, 96), SCATTER, DIFFRACTION, 3)


@pytest.fixture(scope="module")
def beyond() -> TrueSky:
    """A field of 96 px, with 48 px more of the Sun on each side."""
    return true_sky(default_plan(6, 96, beyond="on"), SCATTER, DIFFRACTION, 3)


def flat_sky(plan: Plan, dn_per_s: float) -> TrueSky:
    """Uniform scenes for all pointings."""
    edge = (plan.size_px + 2 * plan.margin_px) * plan.oversampling
    scenes = {pointing: np.full((edge, edge), dn_per_s) for pointing in plan.pointings}
    return true_sky(plan, SCATTER, DIFFRACTION, 1, scenes=scenes)


# --- the plan ---------------------------------------------------------------------------------------------


def counts(plan: Plan) -> list[tuple[int, float, str, int]]:
    kinds = [(shot.pointing, shot.exposure_s, shot.gain_mode) for shot in plan.shots]
    return [(*kind, kinds.count(kind)) for kind in dict.fromkeys(kinds)]


def test_the_plan_of_the_paper_and_of_any_number_of_images_and_field() -> None:
    assert counts(default_plan(126, 512)) == [
        (1, 5.0, COMBINED, 10),
        (1, 0.9, HIGH, 14),
        (2, 1.8, HIGH, 78),
        (3, 0.9, HIGH, 14),
        (3, 5.0, COMBINED, 10),
    ]
    for images, size_px in itertools.product((1, 2, 3, 7, 30, 61, 200), (64, 100, 512)):
        plan = default_plan(images, size_px)
        assert len(plan.shots) == images
        times = [shot.time_s for shot in plan.shots]
        assert times == sorted(times) and len(set(times)) == images
        for index in range(images):
            place = plan.place(index)
            assert place.radius_px < min(place.x_px, place.y_px)
            assert max(place.x_px, place.y_px) < size_px - 1 - place.radius_px
    assert Counter(shot.pointing for shot in default_plan(30, 512).shots) == {1: 10, 2: 10, 3: 10}


def test_impossible_plans_scatter_and_diffraction_are_refused() -> None:
    plans: tuple[dict[str, object], ...] = (
        {"oversampling": 3},
        {"beyond": "dim"},
        {"brightness": 0.0},
        {"saturation_dn": float("nan")},
        {"dark_offset_dn": float("inf")},
        {"radius_px": 40.0},
        {"views": ("disc", "disc")},
    )
    for changes in plans:
        with pytest.raises(DataError, match="bad-plan"):
            default_plan(6, 64, **changes)
    for values in ({"b_px": 0.0}, {"c": float("nan")}, {"total": 1.0}, {"stretch": -1.0}, {"dipole": 1.1}):
        with pytest.raises(DataError, match="bad-scatter"):
            dataclasses.replace(SCATTER, **values)
    with pytest.raises(DataError, match="bad-diffraction"):
        simulate(default_plan(1, 64), SCATTER, 0.9 * DIFFRACTION, 1)


# --- the occulter -----------------------------------------------------------------------------------------


def test_the_covered_area_is_that_of_the_circle() -> None:
    place = Place(20.3, 18.77, 10.75)
    # Brute force: 40 points a pixel and axis.
    y, x = ((np.arange(40 * n) + 0.5) / 40 - 0.5 for n in (40, 41))
    inside = np.hypot(x[None, :] - place.x_px, y[:, None] - place.y_px) <= place.radius_px
    for fine in (1, 2):
        share = covered_share(place, (0, 0), (40, 41), fine)
        assert share.sum() / fine**2 == pytest.approx(np.pi * 10.75**2, rel=1e-12)
        n = 40 // fine
        counted = inside.reshape(40 * fine, n, 41 * fine, n).mean(axis=(1, 3))
        np.testing.assert_allclose(share, counted, atol=0.03)
    dark = fully_dark(place, (3, 5), (36, 35))
    np.testing.assert_array_equal(dark, covered_share(place, (3, 5), (36, 35)) > 1 - 1e-12)
    assert 290 < dark.sum() < 350


# --- the PSF ----------------------------------------------------------------------------------------------


def test_shares_are_finite_if_a_radius_squared_is_rounded_down() -> None:
    radius_px = 10.310282443350118
    assert radius_px**2 < radius_px * radius_px  # the power and the product are rounded differently
    assert np.isfinite(covered_share(Place(20.0, 20.0, radius_px), (0, 0), (40, 40))).all()


def test_isotropic_scatter_is_the_power_law_and_every_kernel_sums_to_1() -> None:
    expected = scatter_kernel(6.15, 2.53, 0.411, 128)
    np.testing.assert_allclose(anisotropic_kernel(SCATTER, 128), expected, rtol=1e-10)
    for stretch, dipole in ((0.0, 0.0), (-0.1, 0.3)):
        scatter = dataclasses.replace(SCATTER, stretch=stretch, angle_deg=30.0, dipole=dipole)
        kernel = anisotropic_kernel(scatter)
        assert kernel.sum() == pytest.approx(1, abs=1e-12)
        assert kernel[1024, 1024] == pytest.approx(1 - 0.411, abs=1e-12)
    assert total_kernel(scatter, DIFFRACTION).sum() == pytest.approx(1, abs=3e-5)  # 1e-5 falls past the reach


def test_stretch_and_dipole_follow_their_definitions() -> None:
    """Along t the radius is u / (1 + s), across it v (1 + s)."""
    scatter = dataclasses.replace(SCATTER, stretch=0.2, angle_deg=90.0)
    kernel = anisotropic_kernel(scatter, 256)
    up, right = kernel[128 + 60, 128], kernel[128, 128 + 60]
    assert up == pytest.approx(scatter.a * (6.15 + 60 / 1.2) ** -2.53, rel=1e-12)
    assert right == pytest.approx(scatter.a * (6.15 + 60 * 1.2) ** -2.53, rel=1e-12)
    scatter = dataclasses.replace(SCATTER, dipole=0.25, angle_deg=0.0)
    kernel = anisotropic_kernel(scatter, 128)
    assert kernel[64, 64 + 20] / kernel[64, 64 - 20] == pytest.approx(1.25 / 0.75, rel=1e-12)
    assert kernel[64 + 20, 64] == pytest.approx(kernel[64 - 20, 64], rel=1e-12)


# --- what a camera without noise sees ---------------------------------------------------------------------


def test_removing_a_patch_equals_convolving_the_dark_scene(small: SimulatedTransit, beyond: TrueSky) -> None:
    for sky in (small.sky, beyond):
        margin = sky.plan.margin_px
        edge = sky.plan.size_px + 2 * margin
        whole = Convolver(sky.kernel, (edge, edge), dtype=np.float64)
        for index in (0, 3, 5):
            direct = whole.apply(true_scene(sky, index))
            direct = direct[margin : edge - margin, margin : edge - margin]
            np.testing.assert_allclose(sky.expected(index), direct, rtol=1e-9)


def test_a_pixel_is_the_sum_of_the_definition(beyond: TrueSky) -> None:
    """The scene is convolved with the diffraction, then with the power law by an explicit sum over pixels."""
    index, margin = 2, beyond.plan.margin_px
    diffracted = fftconvolve(true_scene(beyond, index), DIFFRACTION)  # 15 px more on each side
    expected = beyond.expected(index)
    first = -margin - DIFFRACTION.shape[0] // 2
    rows, columns = (np.arange(n) + first for n in diffracted.shape)
    for y, x in ((10, 80), (47, 33), (95, 0)):
        r = np.hypot(columns[None, :] - x, rows[:, None] - y)
        weights = np.where(r > 0, SCATTER.a / (6.15 + r) ** 2.53, 1 - 0.411)
        assert expected[y, x] == pytest.approx((weights * diffracted).sum(), rel=1e-9)


def test_the_occulter_is_dark_in_the_true_scene_and_lit_by_scatter(small: SimulatedTransit) -> None:
    for index in range(6):
        dark = fully_dark(small.plan.place(index), (0, 0), (96, 96))
        assert true_scene(small.sky, index)[dark].max() < 1e-9
        assert small.sky.expected(index)[dark].min() > 0
        lit = covered_share(small.plan.place(index), (0, 0), (96, 96)) == 0
        pointing = small.plan.shots[index].pointing
        np.testing.assert_array_equal(true_scene(small.sky, index)[lit], small.sky.scenes[pointing][lit])


def test_half_pixels_are_binned_after_the_disc_is_removed() -> None:
    """Light in one half pixel; the edge of the disc is between it and the other half."""
    plan = default_plan(1, 64)
    plan = dataclasses.replace(plan, shots=(dataclasses.replace(plan.shots[0], x_px=32 - 10.75, y_px=30.0),))
    fine = np.zeros((128, 128))
    fine[60, 64] = 4.0  # the left half of column 32, row 30, ends at the disc's edge at x = 32
    fine[60, 65] = 8.0
    sky = true_sky(plan, SCATTER, DIFFRACTION, 1, scenes={2: fine})
    assert sky.scenes[2][30, 32] == pytest.approx(3.0)
    assert true_scene(sky, 0)[30, 32] == pytest.approx(2.0, abs=0.02)


# --- noise, ephemeris, camera -----------------------------------------------------------------------------


def test_noise_has_the_variance_of_photon_and_read_noise_and_repeats_its_seed() -> None:
    plan = default_plan(6, 64, whole_dn=False)
    sky = flat_sky(plan, 60.0)
    pulls: dict[int, list[NDArray[np.float64]]] = {index: [] for index in range(6)}
    for seed in range(12):
        for index, frame in enumerate(observed_transit(sky, seed).transit.frames):
            expected = sky.expected(index)
            sigma = np.sqrt(6.0 * expected * frame.exposure_s + 2.0**2) / frame.exposure_s
            pulls[index].append((frame.pixels - expected) / sigma)
    for found in pulls.values():
        stacked = np.stack(found)
        assert stacked.mean() == pytest.approx(0, abs=4 / np.sqrt(stacked.size))
        assert stacked.std() == pytest.approx(1, abs=0.015)
        assert abs(np.corrcoef(stacked.reshape(12, -1))[0, 1:]).max() < 0.08  # no seed repeats another's
    frames = np.corrcoef([np.concatenate(pulls[index]).ravel() for index in range(6)])
    assert abs(frames - np.eye(6)).max() < 0.03  # nor an image another's
    scene, quiet = solar_scene((48, 48), 2), {"photon_gain_dn": 0.0, "read_noise_dn": 0.0, "seed": 1}
    seen = observe(scene, make_psf(delta(16)), exposure_s=2.0, **quiet)
    np.testing.assert_allclose(seen, scene, rtol=1e-12)
    point = np.zeros((64, 64))
    point[32, 32] = 1000.0
    seen = observe(point, make_psf(gaussian(31, 2.0)), exposure_s=1.0, **quiet)
    assert seen.sum() == pytest.approx(1000.0)
    assert seen[32, 32] == pytest.approx(1000 / (2 * np.pi * 4), rel=0.01)
    noise = {"photon_gain_dn": 6.0, "read_noise_dn": 2.0, "seed": 3}
    flat = np.full((200, 200), 300.0)
    seen = observe(flat, make_psf(delta(16)), exposure_s=1.4, **noise)
    np.testing.assert_array_equal(seen, Noise(6.0, 2.0).observe(flat, 1.4, np.random.default_rng(3)))


def test_images_are_whole_dn_with_saturation_and_dark_offset(small: SimulatedTransit) -> None:
    for frame in small.transit.frames:
        dn = frame.pixels.astype(np.float64) * frame.exposure_s
        np.testing.assert_allclose(dn, np.rint(dn), atol=1e-3)
        assert len(np.unique(np.rint(dn))) > 20
    part = simulate(default_plan(1, 64, whole_dn=False), SCATTER, DIFFRACTION, 1)
    dn = part.transit.frames[0].pixels * part.transit.frames[0].exposure_s
    assert abs(dn - np.rint(dn)).mean() == pytest.approx(0.25, abs=0.02)
    plan = default_plan(6, 64, saturation_dn=250.4)
    frames = observed_transit(flat_sky(plan, 400.0), 1).transit.frames
    for frame in frames:
        dn = frame.pixels * frame.exposure_s
        if frame.gain_mode == HIGH:
            assert dn.max() == pytest.approx(250, abs=1e-3)
            assert (abs(dn - 250) < 1e-3).sum() > 100
        else:
            assert dn.max() > 1000
    sky = flat_sky(default_plan(3, 64, dark_offset_dn=7.0), 100.0)
    for index, frame in enumerate(observed_transit(sky, 1).transit.frames):
        added = (frame.pixels - sky.expected(index)) * frame.exposure_s
        assert added.mean() == pytest.approx(7.0, abs=4 * added.std() / 64)


def test_the_errors_of_the_ephemeris_have_its_rms() -> None:
    plan = default_plan(6, 64)
    errors = []
    for seed in range(100):
        for place, shot in zip(reported_places(plan, seed), plan.shots, strict=True):
            assert round(place.x_px, 1) == place.x_px
            errors.append((place.x_px - shot.x_px, place.y_px - shot.y_px))
    assert np.std(errors, axis=0) == pytest.approx(0.6, abs=0.05)
    assert np.mean(errors, axis=0) == pytest.approx(0.0, abs=0.1)
    exact = dataclasses.replace(plan, ephemeris_error_px=0.0)
    for place, shot in zip(reported_places(exact, 1), plan.shots, strict=True):
        assert place.x_px == pytest.approx(shot.x_px, abs=0.0501)


def test_equal_seeds_give_equal_transits(small: SimulatedTransit) -> None:
    again = simulate(small.plan, SCATTER, DIFFRACTION, 3)
    other = observed_transit(small.sky, 4)
    assert [frame.place for frame in other.transit.frames] == reported_places(small.plan, 4)
    for one, same, differs in zip(
        small.transit.frames, again.transit.frames, other.transit.frames, strict=True
    ):
        np.testing.assert_array_equal(one.pixels, same.pixels)
        assert one.place == same.place
        assert not np.array_equal(one.pixels, differs.pixels)
        assert one.place != differs.place


# --- scenes -----------------------------------------------------------------------------------------------


def test_the_limb_is_on_the_side_of_the_pointing() -> None:
    plan = default_plan(3, 128)
    east, disc, west = (drawn_scene(plan, pointing, 5) for pointing in (1, 2, 3))
    assert east[:, -20:].mean() > 20 * east[:, :20].mean()
    assert west[:, :20].mean() > 20 * west[:, -20:].mean()
    assert np.percentile(disc, 1) > 20
    assert abs(np.corrcoef(east.ravel(), west[:, ::-1].ravel())[0, 1]) < 0.999  # not the same limb


def test_a_scene_has_the_contrasts_of_the_sun_and_its_seed() -> None:
    """The numbers are those of the first version: a seed names the same scene for ever."""
    for shape, mean, brightest in (
        ((64, 64), 1806.6784176258332, 57303.802124101276),
        ((33, 128), 1685.2884243856727, 31376.684082156185),
    ):
        scene = solar_scene(shape, 5)
        assert scene.shape == shape and (scene > 0).all()
        assert scene.mean() == pytest.approx(mean, rel=1e-9)
        assert scene.max() == pytest.approx(brightest, rel=1e-9)
        np.testing.assert_array_equal(scene, solar_scene(shape, 5))
        assert not np.array_equal(scene, solar_scene(shape, 6))
    # The real image: 1 % of pixels below 86, median 540, 1 % above 2480, brightest 17000 DN/s.
    low, middle, high, brightest = np.percentile(solar_scene((384, 384), 1), [1, 50, 99, 100])
    assert 10 < low < 150 and 250 < middle < 1000 and 1500 < high < 10000 and brightest > 5000
    scene = solar_scene((96, 96), 4, margin_px=30)
    assert scene.shape == (156, 156)
    # The limb is where it is without a margin: dim to its left, bright to its right.
    inner = scene[30:-30, 30:-30]
    assert inner[30, 40:].mean() > 1.5 * scene[60, :25].mean()


def test_a_scene_from_an_image_is_cut_or_enlarged_or_refused() -> None:
    plan = default_plan(3, 64)
    large = np.random.default_rng(1).uniform(0, 100, (300, 280))
    large[5, 5], large[150, 140] = np.nan, -3.0
    scene = scene_from_image(large, plan)
    assert scene.shape == (128, 128)
    np.testing.assert_array_equal(scene[64, 65:], large[150, 141:204])
    assert scene[64, 64] == 0
    small = scene_from_image(np.full((40, 50), 7.0), plan)
    np.testing.assert_allclose(small, 7.0)
    seen = simulate(plan, SCATTER, DIFFRACTION, 1, scenes={1: scene, 2: small, 3: scene})
    assert seen.sky.scenes[2].max() == pytest.approx(7.0)
    for image in (np.zeros((70, 70)), np.full((70, 70), np.nan), np.ones(9)):
        with pytest.raises(DataError, match="bad-scene"):
            scene_from_image(image, default_plan(3, 64))
    with pytest.raises(DataError, match="bad-scene"):
        true_sky(default_plan(1, 64), SCATTER, DIFFRACTION, 1, scenes={2: np.ones((64, 64))})


# --- files ------------------------------------------------------------------------------------------------


def test_a_folder_contains_the_transit_and_its_truth(tmp_path: Path) -> None:
    plan = default_plan(6, 64, saturation_dn=300.0)
    simulated = simulate(plan, dataclasses.replace(SCATTER, stretch=0.1), DIFFRACTION, 9)
    write(simulated, tmp_path / "t")
    described = json.loads((tmp_path / "t/transit.json").read_text())
    assert described["schema"] == "transit/1" and described["known_psf"] == "diffraction.fits"
    assert described["noise"] == {"photon_gain_dn": 6.0, "read_noise_dn": 2.0}
    for frame, shot, entry in zip(simulated.transit.frames, plan.shots, described["images"], strict=True):
        path = tmp_path / "t" / entry["file"]
        with fits.open(path) as hdus:
            assert hdus[0].data.dtype.kind == "i" and hdus[0].data.dtype.itemsize == 4
            assert hdus[0].header["GAINCOMB"] == shot.gain_mode
            assert ("SATURATE" in hdus[0].header) == (shot.gain_mode == HIGH)
        image = read_observation(path, LIMITS)
        assert image.unit == "DN" and image.exposure_s == shot.exposure_s
        np.testing.assert_allclose(image.pixels / shot.exposure_s, frame.pixels, rtol=1e-6, atol=1e-6)
        place = (frame.place.x_px, frame.place.y_px, 10.75)
        assert (entry["fov"], entry["x"], entry["y"], entry["r"]) == (frame.pointing, *place)
    truth = json.loads((tmp_path / "t/truth.json").read_text())
    assert truth["effects"] == [] and truth["seed"] == 9
    assert truth["psf"]["total"] == 0.411 and truth["psf"]["stretch"] == 0.1
    assert truth["exact"][1] == {"x": plan.shots[1].x_px, "y": plan.shots[1].y_px}
    diffraction = fits.getdata(tmp_path / "t/diffraction.fits")
    np.testing.assert_allclose(diffraction, DIFFRACTION, rtol=1e-6, atol=1e-30)
    noise_free = fits.getdata(tmp_path / "t/noise_free/002.fits")
    np.testing.assert_allclose(noise_free, simulated.sky.expected(2), rtol=1e-6)


def test_a_sky_is_read_back_and_a_folder_without_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not-simulated"):
        read_sky(tmp_path)
    (tmp_path / "truth.json").write_text('{"psf": {"b": 1}}')
    with pytest.raises(DataError, match="not-simulated"):
        read_sky(tmp_path)
    plan = default_plan(3, 64, beyond="on", beyond_px=20)
    simulated = simulate(plan, SCATTER, DIFFRACTION, 2)
    write(simulated, tmp_path)
    sky = read_sky(tmp_path)
    assert sky.scatter == SCATTER and sky.plan.margin_px == 20
    for index in range(3):
        # Half pixels at the disc's edge are gone: what they hide differs a little, and only there.
        dark = fully_dark(plan.place(index), (0, 0), (64, 64))
        ratio = sky.expected(index) / simulated.sky.expected(index)
        assert ratio[dark].mean() == pytest.approx(1, abs=0.02)
        share = covered_share(plan.place(index), (0, 0), (64, 64))
        scenes = [true_scene(of, index)[20:-20, 20:-20][share == 0] for of in (sky, simulated.sky)]
        np.testing.assert_allclose(*scenes, rtol=1e-6)


# --- keywords of the imitated instrument ---

# What level 1 files of AIA's 171 A channel say, as 2013-03-10T12:00:11.
REAL_AIA_171 = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171, "WAVEUNIT": "angstrom"}


def written(folder: Path, instrument: str) -> fits.Header:
    """The header of the first image of a transit that imitates an instrument."""
    of_instrument = imitated(load_instrument(instrument))
    plan = default_plan(3, 64, oversampling=1)
    write(simulate(plan, ScatterTruth(6.0, 2.5, 0.4), DIFFRACTION, 1, imitated=of_instrument), folder)
    return fits.getheader(folder / "000.fits")


def test_aia_171_has_the_keywords_of_aia(tmp_path: Path) -> None:
    header = written(tmp_path, "aia_171")
    assert {key: header[key] for key in REAL_AIA_171} == REAL_AIA_171
    assert header["CDELT1"] == header["CDELT2"] == pytest.approx(0.599489, abs=1e-6)
    assert header["EXPTIME"] == 5.0 and "T" in header["DATE-OBS"]
    assert not {"DETECTOR", "GAINCOMB", "XPOSURE", "DATE-BEG"} & set(header)
    assert "HRI" not in repr(header) and "SIMULATED" in header["ORIGIN"]
    assert fits.getheader(tmp_path / "diffraction.fits")["INSTRUME"] == "AIA_3"
    assert fits.getheader(tmp_path / "scenes/fov1.fits")["INSTRUME"] == "AIA_3"
    assert json.loads((tmp_path / "transit.json").read_text())["instrument"] == "aia_171"
    transit = read_transit(tmp_path, LIMITS)
    assert transit.instrument == "aia_171"
    assert [frame.exposure_s for frame in transit.frames] == [5.0, 1.8, 5.0]
    assert transit.plate_scale_arcsec == pytest.approx(0.599489, abs=1e-6)


def test_hri_euv_and_another_instrument_have_their_own_keywords(tmp_path: Path) -> None:
    assert imitated(load_instrument("hri_euv")) == HRI_EUV
    header = written(tmp_path, "hri_euv")
    assert (header["TELESCOP"], header["INSTRUME"]) == ("SOLO/EUI/HRI_EUV", "EUI")
    assert (header["DETECTOR"], header["WAVELNTH"], header["CDELT1"]) == ("HRI_EUV", 174, 0.492)
    assert header["GAINCOMB"] == "combined" and header["XPOSURE"] == 5.0
    assert load_instrument("hri_euv").detector.plate_scale_arcsec == HRI_EUV.plate_scale_arcsec
    path = tmp_path / "own.toml"
    path.write_text(SMALL_INSTRUMENT)
    instrument = load_instrument(path)
    header = written(tmp_path / "t", str(path))
    assert {key: header[key] for key in instrument.match} == instrument.match
    assert header["WAVELNTH"] == round(instrument.wavelength_angstrom)
    assert "HRI_EUV" not in repr(header)
