"""The engine for a PSF that changes over the field agrees with a direct sum, and its adjoint is its adjoint."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.convolution.engine import PERIODIC
from psfcore.convolution.field_engine import FieldEngine
from psfcore.psf_field import FieldTerm, Place
from tests.psfcore.conftest import gaussian
from tests.psfcore.convolution.test_convolution import direct

Plane = NDArray[np.float64]
POWERS = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 2))


def lopsided(size: int, rng: np.random.Generator) -> Plane:
    """A term that sums to 0."""
    kernel = rng.standard_normal((size, size + 2))
    return np.asarray((kernel - kernel.mean()) / np.abs(kernel).sum())


def plain_sum(kernel: Plane, terms: list[FieldTerm], u: Plane, v: Plane, scene: Plane) -> Plane:
    """Eq. (1) of psfcore.convolution.field_engine, term by term."""
    out = direct(scene, kernel)
    for term in terms:
        out += direct(scene * u**term.x_power * v[:, None] ** term.y_power, term.kernel)
    return out


def test_equals_the_direct_sum_at_48_px() -> None:
    rng = np.random.default_rng(1)
    kernel, scene = gaussian(21, 2.0), rng.random((48, 45))
    u, v = Place.of_detector(60, 40).from_pixel(-5, 3).coordinates((48, 45))
    assert (u[0], v[-1]) == (-1, 1), "beyond the detector the value at its edge holds"
    for count in range(1, len(POWERS) + 1):
        terms = [FieldTerm(lopsided(9 + 4 * n, rng), *POWERS[n]) for n in range(count)]
        found = FieldEngine(kernel, terms, (u, v), (48, 45), threads=2).apply(scene)
        assert np.abs(found - plain_sum(kernel, terms, u, v, scene)).max() < 1e-6, count


def test_a_periodic_field_continues_with_its_opposite_side() -> None:
    rng = np.random.default_rng(2)
    term, scene = FieldTerm(lopsided(21, rng), 1, 0), rng.random((48, 64))
    u, v = Place.of_detector(64, 48).coordinates((48, 64))
    found = FieldEngine(gaussian(21, 2.0), [term], (u, v), (48, 64), span=PERIODIC).apply(scene)
    nine = direct(np.tile(scene, (3, 3)), gaussian(21, 2.0))
    nine += direct(np.tile(scene * u, (3, 3)), term.kernel)
    assert np.abs(found - nine[48:96, 64:128]).max() < 1e-6


def test_one_filter_is_refused_where_terms_would_be_left_out() -> None:
    term = FieldTerm(lopsided(9, np.random.default_rng(3)), 1, 0)
    u, v = Place.of_detector(32, 32).coordinates((32, 32))
    with pytest.raises(TypeError, match="without terms"):
        FieldEngine(gaussian(9, 2.0), [term], (u, v), (32, 32)).transform_columns()


@settings(deadline=None, max_examples=40)
@given(
    ny=st.integers(1, 90),
    nx=st.integers(1, 90),
    powers=st.lists(st.sampled_from(POWERS), min_size=1, max_size=4, unique=True),
    symmetric=st.booleans(),
    threads=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_adjoint_is_the_adjoint(
    ny: int, nx: int, powers: list[tuple[int, int]], symmetric: bool, threads: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    terms = [FieldTerm(lopsided(int(rng.integers(1, 40)), rng), *power) for power in powers]
    if symmetric:
        terms = [FieldTerm(term.kernel + term.kernel[::-1, ::-1], *powers[n]) for n, term in enumerate(terms)]
    u, v = Place.of_detector(50, 70).coordinates((ny, nx))
    engine = FieldEngine(gaussian(31, 2.0), terms, (u, v), (ny, nx), threads=threads)
    x, y = rng.random((2, ny, nx))
    sent, seen = np.vdot(engine.apply(x).astype(float), y), np.vdot(x, engine.adjoint(y).astype(float))
    assert abs(sent - seen) <= 1e-6 * np.linalg.norm(x) * np.linalg.norm(y)
    plain = Convolver(gaussian(31, 2.0), (ny, nx), dtype=np.float64).apply(x)
    for term in terms:
        weighted = x * u**term.x_power * v[:, None] ** term.y_power
        plain += Convolver(term.kernel, (ny, nx), dtype=np.float64).apply(weighted)
    assert np.abs(engine.apply(x) - plain).max() < 3e-6
    assert np.array_equal(engine.apply(x), engine.twin().apply(x)), "threads change nothing"
