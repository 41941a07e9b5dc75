"""Deconvolution with a PSF that changes over the field: all methods, regions, errors, and what the terms are worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.deconvolve.box import Box
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs, new_engine
from psfcore.deconvolve.forward import convolve
from psfcore.deconvolve.methods.registry import method_named, method_names
from psfcore.deconvolve.run import deconvolve
from psfcore.deconvolve.work import Options, Work, box_work
from psfcore.image import Image, MaskBit
from psfcore.noise import Noise
from psfcore.psf import Psf, crop_centred
from psfcore.psf_field import FieldTerm, Place
from psfcore.scatter.power_law import scatter_kernel
from psfcore.simulate.scene import solar_scene
from tests.psfcore.conftest import delta, make_image, make_psf

Plane = NDArray[np.float64]
SIZE_PX = 256
ZERO = Conditions(edges="zero", threads=2)


def growing(*, size: int = 129, slope: float = 0.2) -> Psf:
    """60 % of the light is scattered at the centre, with a slope along x: 0.2 makes it grow by half."""
    halo = crop_centred(scatter_kernel(6.15, 2.53, 0.6, SIZE_PX), (size, size))
    halo[size // 2, size // 2] = 0
    halo *= 0.6 / halo.sum()
    term = slope * (halo - 0.6 * delta(size))
    place = Place.of_detector(SIZE_PX, SIZE_PX)
    return make_psf(halo + 0.4 * delta(size), field_terms=(FieldTerm(term, 1, 0),), place=place)


def constant(psf: Psf) -> Psf:
    return replace(psf, field_terms=(), place=None)


def blurred(scene: Plane, psf: Psf) -> Plane:
    """The sum of plain convolutions in double precision."""
    assert psf.place is not None
    u, v = psf.place.coordinates((scene.shape[0], scene.shape[1]))
    out = Convolver(psf.kernel, scene.shape, dtype=np.float64).apply(scene)
    for term in psf.field_terms:
        weighted = scene * u**term.x_power * v[:, None] ** term.y_power
        out += Convolver(term.kernel, scene.shape, dtype=np.float64).apply(weighted)
    return np.asarray(out)


@pytest.fixture(scope="module")
def scene() -> Plane:
    """Dark near its edges, so that no light is lost there."""
    scene = solar_scene((SIZE_PX, SIZE_PX), 3)
    dark = np.ones(scene.shape, np.bool_)
    dark[40:-40, 40:-40] = False
    scene[dark] = 0
    return scene


def test_the_terms_take_away_most_of_the_error_that_one_kernel_leaves(scene: Plane) -> None:
    psf = growing()
    image = make_image(blurred(scene, psf))
    for name in method_names():
        rms = [
            np.sqrt(np.mean((method_named(name)(image, one, ZERO).pixels - scene) ** 2))
            for one in (psf, constant(psf))
        ]
        # Total variation smooths the scene.
        assert rms[0] <= (0.6 if "total-variation" in name else 0.45) * rms[1], (name, rms)
        if name in ("linear", "basic-iterative"):
            assert rms[0] < 1e-3 * rms[1], "they invert the operator exactly"


def test_a_step_is_the_equation_of_the_method(scene: Plane) -> None:
    """Eq. (1) of richardson_lucy with plain convolutions in double precision."""
    psf = growing()
    assert psf.place is not None
    (u, _), term = psf.place.coordinates(scene.shape), psf.field_terms[0].kernel
    h, h1 = (Convolver(one, scene.shape, dtype=np.float64) for one in (psf.kernel, term))
    y = blurred(scene, psf) + 1.0
    x = y.copy()
    for _ in range(5):
        ratio = y / (h.apply(x) + h1.apply(u * x))
        x *= h.adjoint(ratio) + u * h1.adjoint(ratio)
    found = method_named("richardson-lucy")(make_image(y), psf, ZERO, steps=5)
    np.testing.assert_allclose(found.pixels, x, rtol=1e-4, atol=1e-4 * x.max())
    assert abs(found.flux_change_pct) < 1e-3, "each K sums to 1, so the flux is kept"


def test_terms_of_zero_change_no_bit(scene: Plane) -> None:
    psf = growing()
    zero = replace(psf, field_terms=(FieldTerm(np.zeros((9, 9)), 1, 0), FieldTerm(np.zeros((3, 3)), 0, 2)))
    image = make_image(blurred(scene, psf))
    for name in method_names():
        one, other = (method_named(name)(image, each, Conditions()).pixels for each in (zero, constant(psf)))
        np.testing.assert_array_equal(one, other, err_msg=name)


def test_edges_masks_threads_and_margins(scene: Plane) -> None:
    psf = growing()
    pixels = blurred(solar_scene(scene.shape, 3), psf)
    mask = np.zeros(pixels.shape, np.uint8)
    mask[100:104, 60:70], pixels[100:104, 60:70] = MaskBit.NONFINITE, np.nan
    image = make_image(pixels, mask)
    for name in method_names():
        for edges in ("zero", "symmetric", "extended"):
            prepared = PreparedPsfs()
            one, other = (
                method_named(name)(
                    image, psf, Conditions(edges=edges, threads=n, engine_for=prepared.engine_for), steps=3
                ).pixels
                for n in (1, 2)
            )
            np.testing.assert_array_equal(one, other, err_msg=f"{name} {edges}")
            assert np.isfinite(one[mask == 0]).all()
    lit = make_image(solar_scene((SIZE_PX, SIZE_PX), 3))
    wide = np.pad(lit.pixels, 64, mode="symmetric")
    u, _ = Place.of_detector(SIZE_PX, SIZE_PX).from_pixel(-64, -64).coordinates(wide.shape)
    expected = Convolver(psf.kernel, wide.shape).apply(wide) + Convolver(
        psf.field_terms[0].kernel, wide.shape
    ).apply(u * wide)
    found = convolve(lit, psf, edges="symmetric")
    np.testing.assert_allclose(found, expected[64:-64, 64:-64], rtol=1e-4)


def test_a_box_agrees_with_the_whole_image_within_its_bound() -> None:
    psf = growing(size=255)
    image = make_image(blurred(solar_scene((SIZE_PX, SIZE_PX), 5), psf))
    for name in ("richardson-lucy", "linear"):
        work = Work(image, psf, Options(method=name, region_error=0.4))
        for box in (Box(150, 200, 90, 140), Box(10, 60, 40, 90)):
            alone = box_work(work, box)
            result = alone.run()
            assert alone.rim.shape != image.pixels.shape and result.of_box is not None
            difference = np.abs(result.pixels - work.run().pixels[box.slices]).max()
            assert difference <= result.of_box.error, (name, box)


def test_planes_of_errors_and_the_whole_product(scene: Plane) -> None:
    psf = growing()
    expected = blurred(scene + 5.0, psf)
    noisy = np.random.default_rng(1).normal(expected, np.sqrt(expected))
    image: Image = replace(make_image(noisy), exposure_s=1.0)
    options = Options(error_draws=2, noise=Noise(1.0, 0.1), parameters={"steps": 5}, threads=2)
    product = deconvolve(image, psf, options, warnings={})
    assert product.errors is not None and product.errors.amplification is not None
    assert 1 < product.errors.amplification < 4
    assert set(product.planes) == {"QUALITY", "ERROR"}


def test_steps_that_cannot_converge_somewhere_on_the_detector_are_refused() -> None:
    """The transfer function is 0.2 at the centre and -0.6 at the right edge for the highest frequencies."""
    from psfcore.errors import DataError

    kernel = np.zeros((5, 5))
    kernel[2, 1:4] = 0.3, 0.4, 0.3
    term = np.zeros((5, 5))
    term[2, 1:4] = 0.05, -0.1, 0.05
    psf = make_psf(kernel, field_terms=(FieldTerm(term, 1, 0),), place=Place.of_detector(64, 64))
    with pytest.raises(DataError, match="method-diverges"):
        method_named("basic-iterative")(make_image(np.ones((64, 64))), psf, Conditions(), steps=100)
    engine = new_engine(psf, (64, 64), (64, 64), 1)
    assert len(list(engine.local_transfers(4))) == 9
