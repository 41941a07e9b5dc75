"""Properties of every method: signature, masks, scales, edges, stopping, threads, no drift."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.deconvolve.conditions import Conditions, EngineCache
from psfcore.deconvolve.edges import edge_band_px, share_from_beyond
from psfcore.deconvolve.methods import registry
from psfcore.deconvolve.methods.registry import may_be_negative, method_named, method_names
from psfcore.errors import DataError
from psfcore.image import MaskBit
from psfcore.noise import Noise
from psfcore.psf import Psf, crop_centred
from psfcore.simulate.observe import observe
from psfcore.simulate.scene import solar_scene
from studies import edges as edge_study
from tests.psfcore.conftest import delta, gaussian, make_image, make_psf

METHODS = method_names()
LINEAR = tuple(name for name in METHODS if may_be_negative(name))
# Total variation smooths where there is no noise, too.
FAITHFUL = tuple(name for name in METHODS if name != "richardson-lucy-total-variation")
POSITIVE = tuple(name for name in METHODS if name not in LINEAR)
ZERO = Conditions(edges="zero")


def lopsided(shape: tuple[int, int]) -> NDArray[np.float64]:
    """A sharp PSF with a round halo and a ghost: asymmetric, with its centroid off the centre."""
    y, x = np.indices(shape) - np.array(shape)[:, None, None] // 2
    kernel = np.exp(-(x**2 + y**2) / 18.0)
    kernel *= 0.2 / kernel.sum()
    centre = (shape[0] // 2, shape[1] // 2)
    kernel[centre] += 0.65
    kernel[centre[0] + 1, centre[1] + 3] += 0.15
    return np.asarray(kernel)


@pytest.fixture(scope="module")
def psf_256(hri_psf: Psf) -> Psf:
    kernel = crop_centred(hri_psf.kernel, (256, 256))
    return make_psf(kernel / kernel.sum())


@pytest.fixture(scope="module")
def scene() -> NDArray[np.float64]:
    return solar_scene((448, 448), 4)


@pytest.fixture(scope="module")
def seen(scene: NDArray[np.float64], psf_256: Psf) -> NDArray[np.float64]:
    """A field whose scene extends beyond it."""
    whole = observe(scene, psf_256, exposure_s=1.4, photon_gain_dn=6.0, read_noise_dn=2.0, seed=1)
    return whole[128:320, 144:304]


def test_method_names_follow_the_files() -> None:
    folder = Path(registry.__file__).parent
    files = {path.stem.replace("_", "-") for path in folder.glob("*.py")} - {"registry", "--init--"}
    assert len(files) >= 6 and sorted(files) == METHODS


@pytest.mark.parametrize(
    "name", ["lucy", "result", "conditions", "Linear", "richardson_lucy", "../linear", ""]
)
def test_an_unknown_method_is_refused_and_the_known_ones_listed(name: str) -> None:
    with pytest.raises(DataError, match="richardson-lucy-extended") as caught:
        method_named(name)
    assert caught.value.code == "unknown-method"


@pytest.mark.parametrize("name", FAITHFUL)
def test_a_delta_changes_nothing(name: str, scene: NDArray[np.float64]) -> None:
    found = method_named(name)(make_image(scene), make_psf(delta(64)), Conditions(), steps=10).pixels
    assert np.abs(found - scene).max() < 3e-6 * scene.max()


@pytest.mark.parametrize("name", FAITHFUL)
def test_without_noise_the_scene_is_recovered(name: str, psf_256: Psf) -> None:
    scene = solar_scene((448, 448), 2)
    field = (slice(32, -32),) * 2
    observed = observe(scene, psf_256, exposure_s=1.0, photon_gain_dn=0, read_noise_dn=0, seed=0)[field]
    scene = scene[field]
    result = method_named(name)(make_image(observed), psf_256, Conditions(threads=2), steps=60)
    inside = (slice(150, -150),) * 2
    before, after = (np.abs(plane - scene)[inside].mean() for plane in (observed, result.pixels))
    assert after < 0.08 * before


@pytest.mark.parametrize("name", ["basic-iterative", "richardson-lucy-extended"])
def test_single_precision_follows_the_plain_version(
    name: str, seen: NDArray[np.float64], psf_256: Psf
) -> None:
    """Each method's equation in float64, on field and margin, with transforms without wrap-around."""
    margin = 40
    field = (slice(margin, -margin),) * 2
    mask = np.zeros(seen.shape, np.uint8)
    mask[50:55, 60:70] = MaskBit.SATURATED
    conditions = Conditions(edges="extended", margin_px=margin)
    found = method_named(name)(make_image(seen, mask), psf_256, conditions, steps=20).pixels
    y = np.pad(seen, margin, mode="symmetric")
    weight = np.zeros_like(y)
    weight[field] = mask == 0
    x = plain(name, y, weight, Convolver(psf_256.kernel, y.shape, dtype=np.float64), 20)
    assert np.abs(found - x[field]).max() < 2e-5 * x[field].max()


def test_linear_converges_to_a_model_equal_to_the_image(seen: NDArray[np.float64], psf_256: Psf) -> None:
    """After five steps x solves H x = y, checked with a convolution in float64."""
    found = method_named("linear")(make_image(seen), psf_256, ZERO).pixels
    model = Convolver(psf_256.kernel, seen.shape, dtype=np.float64).apply(found)
    assert np.abs(model - seen).max() < 1e-4 * seen.max()


def plain(
    name: str, y: NDArray[np.float64], weight: NDArray[np.float64], convolver: Convolver, steps: int
) -> NDArray[np.float64]:
    """The equation of a method in float64, one line per method."""
    if name == "richardson-lucy-extended":
        y = np.maximum(y, 0)
        x = np.maximum(y, 2.0**-23 * y.max())
        share = convolver.adjoint(weight)
        for _ in range(steps):
            x = np.where(share > 1e-3, x / np.maximum(share, 1e-3), 0) * convolver.adjoint(
                weight * y / np.maximum(convolver.apply(x), 2.0**-23 * y.max())
            )
        return np.asarray(x)
    x = y.copy()
    for _ in range(steps):
        x = x + weight * (y - convolver.apply(x))
    return np.asarray(x)


@pytest.mark.parametrize("name", METHODS)
def test_nan_stays_in_place_and_does_not_spread(name: str, seen: NDArray[np.float64], psf_256: Psf) -> None:
    holed = seen.copy()
    holed[80:83, 70:72] = np.nan
    holed[0, :5] = -np.inf
    with_holes = method_named(name)(make_image(holed), psf_256, Conditions())
    whole = method_named(name)(make_image(seen), psf_256, Conditions())
    np.testing.assert_array_equal(np.isnan(with_holes.pixels), ~np.isfinite(holed))
    far = np.ones(seen.shape, bool)
    far[70:93, 60:82] = far[:12, :17] = False
    assert np.abs(with_holes.pixels - whole.pixels)[far].max() < 0.02 * whole.pixels.max()


@pytest.mark.parametrize("name", METHODS)
def test_the_value_of_a_masked_pixel_has_no_influence(
    name: str, seen: NDArray[np.float64], psf_256: Psf
) -> None:
    """The result is the same, pixel by pixel, for any value in the masked pixels."""
    holes = np.zeros(seen.shape, np.uint8)
    holes[80:82, 70:72] = MaskBit.NONFINITE
    changed = np.where(holes > 0, 1e9, seen)
    one, other = (
        method_named(name)(make_image(p, holes), psf_256, Conditions()).pixels for p in (seen, changed)
    )
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e37, 1e300])
def test_the_result_does_not_depend_on_the_scale(
    name: str, scale: float, seen: NDArray[np.float64], psf_256: Psf
) -> None:
    of_one, scaled = (
        method_named(name)(make_image(p), psf_256, ZERO, steps=5).pixels for p in (seen, seen * scale)
    )
    np.testing.assert_allclose(scaled / scale, of_one, rtol=0, atol=1e-5 * of_one.max())


@pytest.mark.parametrize("name", METHODS)
def test_the_result_does_not_depend_on_the_threads(
    name: str, seen: NDArray[np.float64], psf_256: Psf
) -> None:
    one, three = (
        method_named(name)(make_image(seen), psf_256, Conditions(threads=n), steps=8) for n in (1, 3)
    )
    np.testing.assert_array_equal(one.pixels, three.pixels)
    assert one.last_change == pytest.approx(three.last_change, rel=1e-12)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("psf_shape", [(64, 64), (65, 65), (64, 41)])
@pytest.mark.parametrize("shape", [(96, 96), (97, 75)])
def test_nothing_drifts(name: str, psf_shape: tuple[int, int], shape: tuple[int, int]) -> None:
    """A blurred star keeps its position, for even, odd, oblong and asymmetric PSFs and even and odd fields."""
    y, x = np.indices(shape)
    truth = 5.0 + 500 * np.exp(-((y - 46.3) ** 2 + (x - 31.2) ** 2) / 3)
    psf = make_psf(lopsided(psf_shape))
    observed = Convolver(psf.kernel, shape, dtype=np.float64).apply(truth)
    found = method_named(name)(make_image(observed), psf, Conditions(), steps=100).pixels
    # Forward differences cause a small shift to one side.
    allowed_px = 1e-3 if name in FAITHFUL else 3e-3
    for found_px, true_px in zip(centroid(found), centroid(truth), strict=True):
        assert found_px == pytest.approx(true_px, abs=allowed_px)


def centroid(plane: NDArray[np.float64]) -> tuple[float, float]:
    box = plane[38:55, 23:40] - 5.0
    y, x = np.indices(box.shape)
    return float((box * y).sum() / box.sum()), float((box * x).sum() / box.sum())


@pytest.mark.parametrize("name", LINEAR)
def test_linear_methods_are_linear_and_keep_negative_light(
    name: str, seen: NDArray[np.float64], psf_256: Psf
) -> None:
    other = np.random.default_rng(3).normal(0, 100, seen.shape)
    deconvolve = method_named(name)
    of_sum, of_one, of_other = (
        deconvolve(make_image(p), psf_256, Conditions()).pixels for p in (2 * seen - other, seen, other)
    )
    assert np.abs(of_sum - (2 * of_one - of_other)).max() < 1e-5 * np.abs(of_sum).max()
    assert of_other.min() < 0


@pytest.mark.parametrize("name", METHODS)
def test_translation_shifts_the_result(name: str) -> None:
    psf = make_psf(gaussian(21, 0.8))
    plane = np.full((120, 120), 5.0)
    plane[50:60, 50:53] = 90.0
    moved = np.roll(plane, (3, -7), axis=(0, 1))
    here, there = (
        method_named(name)(make_image(p), psf, Conditions(), steps=5).pixels for p in (plane, moved)
    )
    inside = (slice(20, -20),) * 2
    np.testing.assert_allclose(np.roll(here, (3, -7), axis=(0, 1))[inside], there[inside], atol=2e-3)


@pytest.mark.parametrize("name", LINEAR)
def test_noise_grows_by_the_stated_amplification(name: str, hri_psf: Psf) -> None:
    noise = np.random.default_rng(1).normal(0, 1, (512, 512))
    result = method_named(name)(make_image(noise), hri_psf, Conditions(threads=2))
    assert result.noise_amplification == pytest.approx(result.pixels[64:-64, 64:-64].std(), rel=0.02)
    assert 2.0 < result.noise_amplification < 2.6


@pytest.mark.parametrize("name", METHODS)
def test_discrepancy_stops_near_the_noise(name: str, psf_256: Psf, seen: NDArray[np.float64]) -> None:
    image = dataclasses.replace(make_image(seen), exposure_s=1.4)
    conditions = Conditions(noise=Noise(6.0, 2.0))
    result = method_named(name)(image, psf_256, conditions, steps=50, stop="discrepancy")
    assert 0 < result.steps_done < 20
    assert result.chi2_per_pixel is not None
    assert result.chi2_per_pixel <= 1
    assert "noise" in result.stopped_because
    before = method_named(name)(image, psf_256, conditions, steps=result.steps_done)
    assert before.chi2_per_pixel is not None
    assert before.chi2_per_pixel > 1
    if name != "richardson-lucy-accelerated":  # it stops at a prediction, not at the result of a step
        np.testing.assert_allclose(before.pixels, result.pixels, atol=1e-4 * seen.max())


def test_twenty_steps_fit_noise_and_discrepancy_does_not(hri_psf: Psf) -> None:
    scene = solar_scene((512, 512), 1)
    observed = observe(scene, hri_psf, exposure_s=1.4, photon_gain_dn=6.0, read_noise_dn=2.0, seed=1)
    image = dataclasses.replace(make_image(observed), exposure_s=1.4)
    conditions, engines = Conditions(noise=Noise(6.0, 2.0), threads=2), EngineCache()
    conditions = dataclasses.replace(conditions, engine_for=engines)
    inside = (slice(64, -64),) * 2

    def error(**asked: object) -> float:
        result = method_named("richardson-lucy")(image, hri_psf, conditions, **asked)
        # In units of each pixel's photon noise, so that faint and bright pixels have equal weight.
        return float(np.sqrt(np.mean(((result.pixels - scene) ** 2 / scene)[inside])))

    errors = {steps: error(steps=steps) for steps in (2, 3, 5, 8, 20)}
    best = min(errors.values())
    assert errors[20] > 1.05 * best
    assert error(steps=20, stop="discrepancy") < errors[20]


def test_total_variation_is_better_on_a_noisy_scene(hri_psf: Psf) -> None:
    """Its error is smaller than with any number of plain steps, and further steps do not increase it."""
    scene = solar_scene((512, 512), 1)
    observed = observe(scene, hri_psf, exposure_s=1.4, photon_gain_dn=6.0, read_noise_dn=2.0, seed=1)
    conditions = Conditions(edges="zero", threads=2, engine_for=EngineCache())
    inside = (slice(64, -64),) * 2

    def error(name: str, steps: int) -> float:
        found = method_named(name)(make_image(observed), hri_psf, conditions, steps=steps)
        return float(np.sqrt(np.mean(((found.pixels - scene) ** 2 / scene)[inside])))

    plain_best = min(error("richardson-lucy", steps) for steps in (1, 2, 3, 4, 6))
    smooth = [error("richardson-lucy-total-variation", steps) for steps in (10, 20, 40)]
    assert max(smooth) < plain_best
    assert max(smooth) < 0.8 * error("richardson-lucy", 20)
    assert max(smooth) < 1.1 * min(smooth)


def test_discrepancy_that_is_not_reached_ends_after_all_steps(
    psf_256: Psf, seen: NDArray[np.float64]
) -> None:
    conditions = Conditions(noise=Noise(1e-3, 1e-3))
    result = method_named("richardson-lucy")(
        make_image(seen), psf_256, conditions, steps=3, stop="discrepancy"
    )
    assert result.steps_done == 3
    assert "still above 1" in result.stopped_because


def test_the_cache_drops_the_least_recently_used_engine(psf_256: Psf) -> None:
    cache = EngineCache(2)
    first = cache(psf_256, (32, 32), (32, 32), 1)
    second = cache(psf_256, (48, 32), (48, 32), 1)
    assert cache(psf_256, (32, 32), (32, 32), 1) is first
    cache(psf_256, (64, 64), (64, 64), 1)
    assert cache(psf_256, (32, 32), (32, 32), 1) is first
    assert cache(psf_256, (48, 32), (48, 32), 1) is not second


@pytest.mark.parametrize("name", METHODS)
def test_a_cached_engine_gives_the_same_result(name: str, seen: NDArray[np.float64], psf_256: Psf) -> None:
    kept = Conditions(engine_for=EngineCache())
    deconvolve = method_named(name)
    deconvolve(make_image(seen[::-1]), psf_256, kept, steps=3)
    again, new = (deconvolve(make_image(seen), psf_256, c, steps=3).pixels for c in (kept, Conditions()))
    np.testing.assert_array_equal(again, new)


def test_the_edge_band_follows_from_the_psf() -> None:
    kernel = np.zeros((9, 9))
    kernel[4, 4], kernel[4, 8], kernel[1, 4] = 0.6, 0.2, 0.2
    psf = make_psf(kernel)
    # Mean over the four directions: light from 4 px and from 3 px beyond, 0.2 / 4 each.
    np.testing.assert_allclose(share_from_beyond(psf), [0.1, 0.1, 0.1, 0.05, 0.0])
    assert (edge_band_px(psf, 0.07), edge_band_px(psf, 0.04), edge_band_px(psf, 0.2)) == (3, 4, 0)


@pytest.mark.parametrize("name", METHODS)
def test_a_field_smaller_than_its_psf_agrees_with_the_whole_image(name: str, hri_psf: Psf) -> None:
    """A sub-region of 128 px with the whole PSF agrees with the whole image to 8 % away from its edges, although
    half of the light within reach is cut off."""
    scene = solar_scene((512, 512), 5)
    observed = observe(scene, hri_psf, exposure_s=1.0, photon_gain_dn=0, read_noise_dn=0, seed=0)
    whole = method_named(name)(make_image(observed), hri_psf, Conditions(threads=2)).pixels
    region = (slice(60, 188), slice(100, 228))
    part = method_named(name)(make_image(observed[region]), hri_psf, Conditions()).pixels
    middle = (slice(32, -32),) * 2
    assert part[middle].mean() == pytest.approx(whole[region][middle].mean(), rel=0.08)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(
    ("pixels", "conditions", "asked", "code"),
    [
        (np.full((32, 32), np.nan), {}, {}, "all-masked"),
        (np.zeros((32, 32)), {}, {}, "no-signal"),
        (np.ones((32, 32)), {}, {"steps": 0}, "bad-steps"),
        (np.ones((32, 32)), {}, {"stop": "soon"}, "bad-stop"),
        (np.ones((32, 32)), {}, {"stop": "discrepancy"}, "no-noise-model"),
        (np.ones((32, 32)), {"edges": "open"}, {}, "bad-edges"),
    ],
)
def test_refusals(
    name: str, pixels: NDArray[np.float64], conditions: dict[str, object], asked: dict[str, object], code: str
) -> None:
    with pytest.raises(DataError) as caught:
        method_named(name)(make_image(pixels), make_psf(delta(16)), Conditions(**conditions), **asked)  # type: ignore[arg-type]
    assert caught.value.code == code


def test_a_psf_with_which_additive_steps_diverge_is_refused() -> None:
    box = np.zeros((21, 21))
    box[8:13, 8:13] = 1 / 25
    image = make_image(np.random.default_rng(0).random((64, 64)))
    with pytest.raises(DataError) as caught:
        method_named("basic-iterative")(image, make_psf(box), Conditions(), steps=50)
    assert caught.value.code == "method-diverges"
    assert np.isfinite(method_named("linear")(image, make_psf(box), Conditions(), steps=50).pixels).all()


@pytest.mark.parametrize(("photon", "read"), [(0, 0), (-1, 2), (float("nan"), 1)])
def test_wrong_noise_is_refused(photon: float, read: float) -> None:
    with pytest.raises(DataError, match="noise"):
        Noise(photon, read)


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(METHODS),
    edges=st.sampled_from(["zero", "symmetric", "extended"]),
    shape=st.tuples(st.integers(16, 40), st.integers(16, 40)),
    kernel_size=st.integers(1, 50),
    masked=st.floats(0, 0.9),
    bit=st.sampled_from([MaskBit.NONFINITE, MaskBit.SATURATED]),
    dtype=st.sampled_from([np.float32, np.float64, np.int16]),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_shape_mask_and_type_gives_finite_light(
    name: str,
    edges: str,
    shape: tuple[int, int],
    kernel_size: int,
    masked: float,
    bit: MaskBit,
    dtype: type,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    pixels = (rng.normal(100.0, 100.0, shape)).astype(dtype)
    pixels[0, 0] = 100
    mask = np.where(rng.random(shape) < masked, int(bit), 0).astype(np.uint8)
    mask[0, 0] = 0
    conditions = Conditions(edges=edges)  # type: ignore[arg-type]
    psf = make_psf(gaussian(kernel_size, 0.7))
    result = method_named(name)(make_image(pixels, mask), psf, conditions, steps=4)
    np.testing.assert_array_equal(np.isnan(result.pixels), (mask & MaskBit.NONFINITE) != 0)
    finite = result.pixels[~np.isnan(result.pixels)]
    assert np.isfinite(finite).all()
    if name in POSITIVE:
        assert (finite >= 0).all()


@settings(max_examples=30, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    kernel=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_reference_adjoint_is_the_adjoint(
    shape: tuple[int, int], kernel: tuple[int, int], seed: int
) -> None:
    """<H x, y> = <x, H^T y>, in float64 to 1e-12."""
    rng = np.random.default_rng(seed)
    weights = rng.random(kernel)
    convolver = Convolver(weights / weights.sum(), shape, dtype=np.float64)
    x, y = rng.random(shape), rng.random(shape)
    there, back = np.vdot(convolver.apply(x), y), np.vdot(x, convolver.adjoint(y))
    assert there == pytest.approx(back, rel=1e-12, abs=1e-12)


@pytest.mark.slow
def test_the_default_is_close_to_a_run_without_edges() -> None:
    """The errors near edges that README and methods state: 2.5, 2 and 1 % in the bands of the edge study."""
    psf, cache = edge_study.study_psf(), EngineCache(8)
    for seed in edge_study.SEEDS:
        (row,) = edge_study.rows(seed, psf, cache, methods=("richardson-lucy",), ways=(None,))
        assert row.edges == "symmetric"
        assert np.all(np.abs(row.bias_pct) <= (2.5, 2.0, 1.0)), row
