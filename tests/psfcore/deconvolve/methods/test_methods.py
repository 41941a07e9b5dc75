"""Every method: its equation in double precision, and what all have in common: masks, scales, edges, stopping,
threads."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs
from psfcore.deconvolve.edges import band_px, share_from_beyond
from psfcore.deconvolve.iterations.richardson_lucy_total_variation import SOFTENING
from psfcore.deconvolve.methods import registry
from psfcore.deconvolve.methods.registry import method_named, method_names, properties_of
from psfcore.errors import DataError
from psfcore.image import MaskBit
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.scatter.power_law import scatter_kernel
from psfcore.simulate.scene import observe, solar_scene
from tests.psfcore.conftest import delta, gaussian, make_image, make_psf
from tests.psfcore.deconvolve.scattering import scattering_psf

Plane = NDArray[np.float64]
METHODS = method_names()
LINEAR = tuple(name for name in METHODS if properties_of(name).may_be_negative)
POSITIVE = tuple(name for name in METHODS if name not in LINEAR)
ZERO = Conditions(edges="zero")
TINY = 2.0**-23


@pytest.fixture(scope="module")
def psf() -> Psf:
    """With sum 1, and as sharp as the PSF of HRI_EUV."""
    kernel = scattering_psf(core_px=0.4).kernel
    return make_psf(kernel / kernel.sum())


@pytest.fixture(scope="module")
def seen(psf: Psf) -> Plane:
    """A field whose scene extends beyond it."""
    scene = solar_scene((448, 448), 4)
    whole = observe(scene, psf, exposure_s=1.4, photon_gain_dn=6.0, read_noise_dn=2.0, seed=1)
    return whole[128:320, 144:304]


def test_method_names_follow_the_files() -> None:
    folder = Path(registry.__file__).parent
    files = {path.stem.replace("_", "-") for path in folder.glob("*.py")} - {
        "registry",
        "declaration",
        "--init--",
    }
    assert len(files) >= 6 and sorted(files) == sorted(METHODS)
    for name in ("lucy", "result", "conditions", "Linear", "richardson_lucy", "../linear", ""):
        with pytest.raises(DataError, match=r"unknown-method: .*richardson-lucy-extended"):
            method_named(name)


# --- the equation of each method ---


def accelerated(y: Plane, weight: Plane, convolver: Convolver, steps: int, order: int) -> Plane:
    """Biggs & Andrews: predict, take a Richardson-Lucy step, and compute the acceleration from the last two steps."""
    ones = convolver.adjoint(np.ones_like(y))
    x = before = earlier = np.maximum(y, TINY * y.max())
    acceleration, gradient = 0.0, np.zeros_like(x)
    for _ in range(steps):
        bend = (x - 2 * before + earlier) * acceleration**2 / 2 if order == 2 else 0
        p = np.maximum(x + acceleration * (x - before) + bend, np.minimum(x, 1e-6 * TINY * y.max()))
        new = p * convolver.adjoint(weight * y / convolver.apply(p) + (1 - weight) / ones)
        latest = new - p
        length = float((gradient**2).sum())
        acceleration = float(np.clip((latest * gradient).sum() / length, 0, 0.999)) if length else 0.0
        earlier, before, x, gradient = before, x, new, latest
    return x


def divergence_of_direction(x: Plane) -> Plane:
    """div(grad x / |grad x|) with forward differences, whose length is softened by a share of x."""
    dy, dx = np.zeros_like(x), np.zeros_like(x)
    dy[:-1], dx[:, :-1] = x[1:] - x[:-1], x[:, 1:] - x[:, :-1]
    length = np.sqrt(dy**2 + dx**2 + (SOFTENING * x) ** 2)
    dy, dx = dy / length, dx / length
    dy[1:] -= dy[:-1].copy()
    dx[:, 1:] -= dx[:, :-1].copy()
    return dy + dx


def plain(name: str, y: Plane, weight: Plane, convolver: Convolver, steps: int, **more: float) -> Plane:
    """The equation of a method in float64."""
    if name == "basic-iterative":
        x = y
        for _ in range(steps):
            x = x + weight * (y - convolver.apply(x))
        return x
    y = np.maximum(y, 0)
    x = np.maximum(y, TINY * y.max())
    if name == "richardson-lucy-accelerated":
        return accelerated(y, weight, convolver, steps, int(more.get("order", 1)))
    ones, share = convolver.adjoint(np.ones_like(y)), convolver.adjoint(weight)
    for _ in range(steps):
        model = np.maximum(convolver.apply(x), TINY * y.max())
        if name == "richardson-lucy-extended":
            gain = np.where(share > 1e-3, 1 / np.maximum(share, 1e-3), 0)
            x = x * gain * convolver.adjoint(weight * y / model)
            continue
        penalty = 0.01 * divergence_of_direction(x) if name == "richardson-lucy-total-variation" else 0
        x = x / (1 - penalty) * convolver.adjoint(weight * y / model + (1 - weight) / ones)
    return x


CASES = [*((name, {}) for name in METHODS if name != "linear"), ("richardson-lucy-accelerated", {"order": 2})]


def test_single_precision_follows_the_plain_version(seen: Plane, psf: Psf) -> None:
    """On field and margin, with masked pixels and transforms without wrap-around."""
    margin = 40
    field = (slice(margin, -margin),) * 2
    mask = np.zeros(seen.shape, np.uint8)
    mask[50:55, 60:70] = MaskBit.SATURATED
    conditions = Conditions(edges="extended", margin_px=margin, threads=2)
    y = np.pad(seen, margin, mode="symmetric")
    weight = np.zeros_like(y)
    weight[field] = mask == 0
    convolver = Convolver(psf.kernel, y.shape, dtype=np.float64)
    for name, more in CASES:
        single = method_named(name)(make_image(seen, mask), psf, conditions, steps=12, **more).pixels
        double = plain(name, y, weight, convolver, 12, **more)[field]
        # The acceleration is a ratio of sums, in which the rounding of single precision adds up.
        allowed = 1e-4 if name == "richardson-lucy-accelerated" else 2e-5
        assert np.abs(single - double).max() < allowed * double.max(), (name, more)


def test_linear_methods_converge_and_amplify_noise_as_stated(seen: Plane, psf: Psf) -> None:
    """After five steps x solves H x = y, checked with a convolution in float64, for an asymmetric PSF too."""
    for one in (psf, make_psf(lopsided((65, 65)))):
        pixels = method_named("linear")(make_image(seen), one, ZERO).pixels
        model = Convolver(one.kernel, seen.shape, dtype=np.float64).apply(pixels)
        assert np.abs(model - seen).max() < 1e-4 * seen.max()
    # They keep negative light.
    rng = np.random.default_rng(1)
    noise, other = rng.normal(0, 1, (384, 384)), rng.normal(3, 1, (384, 384))
    for name in LINEAR:
        deconvolve = method_named(name)
        one, two, of_sum = (
            deconvolve(make_image(p), psf, Conditions(threads=2)) for p in (noise, other, 2 * noise - other)
        )
        off = np.abs(of_sum.pixels - (2 * one.pixels - two.pixels)).max()
        assert off < 1e-5 * np.abs(of_sum.pixels).max() and one.pixels.min() < 0, name
        spread = one.pixels[64:-64, 64:-64].std()
        assert one.noise_amplification == pytest.approx(spread, rel=0.03) and spread > 1.5, name


def test_a_psf_with_which_additive_steps_diverge_is_refused() -> None:
    box = np.zeros((21, 21))
    box[8:13, 8:13] = 1 / 25
    image = make_image(np.random.default_rng(0).random((64, 64)))
    with pytest.raises(DataError, match="method-diverges"):
        method_named("basic-iterative")(image, make_psf(box), Conditions(), steps=50)
    assert np.isfinite(method_named("linear")(image, make_psf(box), Conditions(), steps=50).pixels).all()


# --- what all methods have in common ---


def test_bad_pixels_have_no_influence(seen: Plane, psf: Psf) -> None:
    """NaN stays in place and does not spread. The result is the same, pixel by pixel, for any value of a masked
    pixel."""
    holed = seen.copy()
    holed[80:83, 70:72] = np.nan
    holed[0, :5] = -np.inf
    far = np.ones(seen.shape, bool)
    far[70:93, 60:82] = far[:12, :17] = False
    holes = np.zeros(seen.shape, np.uint8)
    holes[80:82, 70:72] = MaskBit.NONFINITE
    changed = np.where(holes > 0, 1e9, seen)
    for name in METHODS:
        deconvolve = method_named(name)
        with_holes, whole = (deconvolve(make_image(p), psf, Conditions()).pixels for p in (holed, seen))
        np.testing.assert_array_equal(np.isnan(with_holes), ~np.isfinite(holed), err_msg=name)
        assert np.abs(with_holes - whole)[far].max() < 0.02 * whole.max(), name
        one, other = (deconvolve(make_image(p, holes), psf, Conditions()).pixels for p in (seen, changed))
        np.testing.assert_array_equal(one, other, err_msg=name)


def test_the_result_does_not_depend_on_scale_threads_or_a_cached_engine(seen: Plane, psf: Psf) -> None:
    for name in METHODS:
        deconvolve = method_named(name)
        one, three = (deconvolve(make_image(seen), psf, Conditions(threads=n), steps=5) for n in (1, 3))
        np.testing.assert_array_equal(one.pixels, three.pixels, err_msg=name)
        assert one.last_change == pytest.approx(three.last_change, rel=1e-12)
        for scale in (1e-300, 1e-30, 1e37, 1e300):
            scaled = deconvolve(make_image(seen * scale), psf, Conditions(), steps=5).pixels
            np.testing.assert_allclose(scaled / scale, one.pixels, rtol=0, atol=1e-5 * one.pixels.max())
        kept = Conditions(engine_for=PreparedPsfs().engine_for)
        deconvolve(make_image(seen[::-1]), psf, kept, steps=5)
        again = deconvolve(make_image(seen), psf, kept, steps=5).pixels
        np.testing.assert_array_equal(again, one.pixels, err_msg=name)


def lopsided(shape: tuple[int, int]) -> Plane:
    """A sharp PSF with a round halo and a ghost: asymmetric, with its centroid off the centre."""
    y, x = np.indices(shape) - np.array(shape)[:, None, None] // 2
    kernel = np.exp(-(x**2 + y**2) / 18.0)
    kernel *= 0.2 / kernel.sum()
    centre = (shape[0] // 2, shape[1] // 2)
    kernel[centre] += 0.65
    kernel[centre[0] + 1, centre[1] + 3] += 0.15
    return np.asarray(kernel)


def centroid(plane: Plane) -> tuple[float, float]:
    box = plane[38:55, 23:40] - 5.0
    y, x = np.indices(box.shape)
    return float((box * y).sum() / box.sum()), float((box * x).sum() / box.sum())


def test_nothing_drifts() -> None:
    """A blurred star keeps its position, for even, odd, oblong and asymmetric PSFs and even and odd fields."""
    shapes = [((96, 96), (64, 64)), ((97, 75), (65, 65)), ((96, 96), (64, 41)), ((97, 75), (64, 64))]
    for shape, psf_shape in shapes:
        y, x = np.indices(shape)
        truth = 5.0 + 500 * np.exp(-((y - 46.3) ** 2 + (x - 31.2) ** 2) / 3)
        psf = make_psf(lopsided(psf_shape))
        observed = Convolver(psf.kernel, shape, dtype=np.float64).apply(truth)
        for name in METHODS:
            pixels = method_named(name)(make_image(observed), psf, Conditions(), steps=100).pixels
            # Forward differences cause a small shift to one side.
            allowed_px = 3e-3 if name == "richardson-lucy-total-variation" else 1e-3
            assert centroid(pixels) == pytest.approx(centroid(truth), abs=allowed_px), (name, psf_shape)


def test_without_noise_the_scene_is_recovered(psf: Psf) -> None:
    scene = solar_scene((448, 448), 2)
    field, inside = (slice(32, -32),) * 2, (slice(150, -150),) * 2
    observed = observe(scene, psf, exposure_s=1.0, photon_gain_dn=0, read_noise_dn=0, seed=0)[field]
    for name in ("linear", "richardson-lucy"):
        pixels = method_named(name)(make_image(observed), psf, Conditions(threads=2), steps=60).pixels
        before, after = (np.abs(plane - scene[field])[inside].mean() for plane in (observed, pixels))
        assert after < 0.08 * before, name


def test_a_field_smaller_than_its_psf_agrees_with_the_whole_image(psf: Psf) -> None:
    """To 8 % away from its edges, although half of the light within reach is cut off; one method for each margin."""
    scene = solar_scene((448, 448), 5)
    observed = observe(scene, psf, exposure_s=1.0, photon_gain_dn=0, read_noise_dn=0, seed=0)
    region, middle = (slice(60, 156), slice(100, 196)), (slice(24, -24),) * 2
    for name in ("richardson-lucy", "richardson-lucy-extended", "linear", "basic-iterative"):
        whole = method_named(name)(make_image(observed), psf, Conditions(threads=2)).pixels
        part = method_named(name)(make_image(observed[region]), psf, Conditions()).pixels
        assert part[middle].mean() == pytest.approx(whole[region][middle].mean(), rel=0.08), name


# --- noise and stopping ---


def test_discrepancy_stops_near_the_noise(psf: Psf, seen: Plane) -> None:
    image = dataclasses.replace(make_image(seen), exposure_s=1.4)
    conditions = Conditions(noise=Noise(6.0, 2.0))
    for name in METHODS:
        result = method_named(name)(image, psf, conditions, steps=50, stop="discrepancy")
        assert 0 < result.steps_done < 20 and "noise" in result.stopped_because, name
        assert result.chi2_per_pixel is not None and result.chi2_per_pixel <= 1, name
        before = method_named(name)(image, psf, conditions, steps=result.steps_done)
        assert before.chi2_per_pixel is not None and before.chi2_per_pixel > 1, name
        if name != "richardson-lucy-accelerated":  # it stops at a prediction, not at the result of a step
            np.testing.assert_allclose(before.pixels, result.pixels, atol=1e-4 * seen.max())
    conditions = Conditions(noise=Noise(1e-3, 1e-3))
    result = method_named("richardson-lucy")(image, psf, conditions, steps=3, stop="discrepancy")
    assert result.steps_done == 3 and "still above 1" in result.stopped_because


def test_twenty_steps_fit_noise_and_discrepancy_and_total_variation_do_not(psf: Psf) -> None:
    """The error of total variation is smaller than with any number of plain steps, and further steps do not increase
    it."""
    scene = solar_scene((384, 384), 1)
    observed = observe(scene, psf, exposure_s=1.4, photon_gain_dn=6.0, read_noise_dn=2.0, seed=1)
    image = dataclasses.replace(make_image(observed), exposure_s=1.4)
    conditions = Conditions(noise=Noise(6.0, 2.0), threads=2, engine_for=PreparedPsfs().engine_for)
    inside = (slice(64, -64),) * 2

    def error(name: str, **options: object) -> float:
        pixels = method_named(name)(image, psf, conditions, **options).pixels
        # In units of each pixel's photon noise, so that faint and bright pixels have equal weight.
        return float(np.sqrt(np.mean(((pixels - scene) ** 2 / scene)[inside])))

    errors = {steps: error("richardson-lucy", steps=steps) for steps in (1, 2, 3, 4, 6, 8, 20)}
    assert errors[20] > 1.05 * min(errors.values())
    assert error("richardson-lucy", steps=20, stop="discrepancy") < errors[20]
    smooth = [error("richardson-lucy-total-variation", steps=steps) for steps in (10, 20, 40)]
    assert max(smooth) < min(errors.values()) and max(smooth) < 0.8 * errors[20]
    assert max(smooth) < 1.1 * min(smooth)


def test_the_edge_band_follows_from_the_psf() -> None:
    kernel = np.zeros((9, 9))
    kernel[4, 4], kernel[4, 8], kernel[1, 4] = 0.6, 0.2, 0.2
    psf = make_psf(kernel)
    # Mean over the four directions: light from 4 px and from 3 px beyond, 0.2 / 4 each.
    shares = share_from_beyond(psf)
    np.testing.assert_allclose(shares, [0.1, 0.1, 0.1, 0.05, 0.0])
    assert [band_px(shares, fraction) for fraction in (0.07, 0.04, 0.2)] == [3, 4, 0]


# --- what is refused ---

ONES, DARK, BAD = np.ones((32, 32)), np.zeros((32, 32)), np.full((32, 32), np.nan)
REFUSALS = [
    *((name, BAD, {}, {}, "all-masked") for name in METHODS),
    *((name, DARK, {}, {}, "no-signal") for name in METHODS),
    *((name, -ONES, {}, {}, "no-signal") for name in POSITIVE),
    *((name, ONES, {}, {"steps": 0}, "bad-steps") for name in METHODS),
    *((name, ONES, {}, {"steps": 1001}, "bad-steps") for name in METHODS),
    *((name, ONES, {}, {"stop": "soon"}, "bad-stop") for name in METHODS),
    *((name, ONES, {}, {"stop": "discrepancy"}, "no-noise-model") for name in METHODS),
    *((name, ONES, {"edges": "open"}, {}, "bad-edges") for name in METHODS),
    *(("richardson-lucy-accelerated", ONES, {}, {"order": order}, "bad-order") for order in (0, 3, 1.5, "2")),
    *(
        ("richardson-lucy-total-variation", ONES, {}, {"smoothing": k}, "bad-smoothing")
        for k in (-0.01, 0.021, math.nan, None)
    ),
]


def test_what_no_method_can_use_is_refused() -> None:
    for name, pixels, conditions, options, code in REFUSALS:
        with pytest.raises(DataError, match=f"^{code}:"):
            method_named(name)(make_image(pixels), make_psf(delta(16)), Conditions(**conditions), **options)


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(METHODS),
    edges=st.sampled_from(["zero", "symmetric", "extended", "periodic"]),
    shape=st.tuples(st.integers(16, 40), st.integers(16, 40)),
    kernel_size=st.integers(3, 50),
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
    if edges == "periodic":  # some shapes only
        shape = (16 * (shape[0] // 16), 16 * (shape[1] // 16))
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
    assert name in LINEAR or (finite >= 0).all()


@pytest.mark.slow
def test_the_default_is_close_to_a_run_without_edges() -> None:
    """The bias near the edges of a field of 1024 px in a scene of 2048 px: the relative error of the mean of a band."""
    line = np.exp(-((np.arange(17) - 8) ** 2) / (2 * 0.45**2))
    scatter, core = scatter_kernel(6.15, 2.53, 0.411, 2048), np.outer(line, line) / line.sum() ** 2
    psf = make_psf(np.maximum(linear_convolve(scatter, core, (2048, 2048)), 0))
    plain, conditions = (
        method_named("richardson-lucy"),
        Conditions(threads=2, engine_for=PreparedPsfs().engine_for),
    )
    from_side = np.minimum(np.arange(1024), np.arange(1024)[::-1])
    distance_px, middle = np.minimum.outer(from_side, from_side), np.s_[512:1536, 512:1536]
    for seed in (1, 2, 3):
        noise = {"photon_gain_dn": 6.0, "read_noise_dn": 2.0, "seed": seed}
        whole = observe(solar_scene((2048, 2048), seed), psf, exposure_s=1.4, **noise, threads=2)
        # The middle of the whole image is far from its edges; outside the image, the scene is zero.
        of_whole = dataclasses.replace(conditions, edges="zero", margin_px=0)
        reference = plain(make_image(whole), psf, of_whole).pixels[middle]
        found = plain(make_image(whole[middle]), psf, conditions)
        assert found.edges == "symmetric"
        for near_px, far_px, most_pct in ((0, 2, 2.5), (2, 20, 2.0), (20, 64, 1.0)):
            band = (near_px <= distance_px) & (distance_px < far_px)
            bias_pct = 100 * (found.pixels[band].sum() / reference[band].sum() - 1)
            assert abs(bias_pct) <= most_pct, (seed, near_px, bias_pct)


def test_a_deconvolution_between_two_steps_of_another_changes_neither() -> None:
    psf = make_psf(gaussian(64, 1.5))
    long, short = make_image(solar_scene((96, 80), 1)), make_image(solar_scene((96, 80), 2))
    for name in method_names():
        method, between = method_named(name), []

        def pause(step: int, _steps: int, method=method, between=between) -> None:  # type: ignore[no-untyped-def]
            if step < 3:
                between.append(method(short, psf, Conditions()).pixels)

        interrupted = method(long, psf, Conditions(progress=pause)).pixels
        assert between, "the method reports its steps"
        np.testing.assert_array_equal(interrupted, method(long, psf, Conditions()).pixels, err_msg=name)
        alone = method(short, psf, Conditions()).pixels
        for pixels in between:
            np.testing.assert_array_equal(pixels, alone, err_msg=name)
