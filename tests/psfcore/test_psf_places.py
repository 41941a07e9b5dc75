"""The terms of a PSF that changes over the field, from PSFs at places."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.psf_field import Place
from psfcore.psf_places import PlacedPsf, fit_places, read_array_psf
from tests.psfcore.conftest import gaussian, make_psf
from tests.psfcore.test_psf_field import changing

DETECTOR = (48, 40)


def at_places(*places: tuple[float, float]) -> list[PlacedPsf]:
    truth, place = changing(), Place.of_detector(*DETECTOR)
    found = []
    for x, y in places:
        (u,), (v,) = place.from_pixel(x, y).coordinates((1, 1))
        found.append(PlacedPsf(make_psf(truth.at(u, v)), x, y))
    return found


def test_terms_that_are_there_are_found_again() -> None:
    rng = np.random.default_rng(1)
    places = [
        (float(x), float(y)) for x, y in zip(rng.uniform(0, 47, 14), rng.uniform(0, 39, 14), strict=True)
    ]
    fit, truth = fit_places(at_places(*places), DETECTOR, order=3), changing()
    assert max(fit.misplaced) < 1e-9 and not fit.left_out
    for u, v in ((-1, -1), (0.3, 0.7), (1, 1)):
        np.testing.assert_allclose(fit.psf.at(u, v), truth.at(u, v), atol=1e-9)
    linear = fit_places(at_places(*places), DETECTOR)
    assert {(term.x_power, term.y_power) for term in linear.psf.field_terms} == {(1, 0), (0, 1)}
    assert 1e-4 < max(linear.misplaced) < 0.1, "the residual is told"


def test_powers_that_the_places_do_not_determine_are_left_out() -> None:
    along_x = fit_places(at_places((0, 10), (20, 10), (47, 10)), DETECTOR, order=2)
    assert [(term.x_power, term.y_power) for term in along_x.psf.field_terms] == [(1, 0), (2, 0)]
    assert along_x.left_out == ((0, 1), (1, 1), (0, 2))
    for places, detector, order, code in (
        (((3, 3),), DETECTOR, 1, "too-few-places"),
        (((3, 3), (3, 3)), DETECTOR, 1, "too-few-places"),
        (((3, 3), (30, 30)), (20, 20), 1, "place-outside"),
        (((3, 3), (30, 30)), DETECTOR, 5, "bad-order"),
    ):
        with pytest.raises(DataError, match=f"^{code}:"):
            fit_places(at_places(*places), detector, order=order)
    scales = [PlacedPsf(make_psf(gaussian(33, 2.0), plate_scale_arcsec=one), one, 1) for one in (0.5, 0.6)]
    with pytest.raises(DataError, match="psfs-differ"):
        fit_places(scales, DETECTOR)


def test_weights_that_would_fall_below_0_beyond_the_places_are_raised() -> None:
    narrow, wide = gaussian(33, 1.5), gaussian(33, 2.0)
    given = [PlacedPsf(make_psf(narrow), 10, 20), PlacedPsf(make_psf(wide), 35, 20)]
    fit = fit_places(given, DETECTOR)
    assert 0.01 < fit.clipped < 0.1
    for u in (-1, 0, 1):
        kernel = fit.psf.at(u, 0)
        assert kernel.min() >= -1e-12 and kernel.sum() == pytest.approx(1)
    with pytest.raises(DataError, match="places-too-close"):
        fit_places([replace(one, x_px=20 + n) for n, one in enumerate(given)], DETECTOR)


def test_an_array_psf_of_regularizepsf_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Patches are named by the row and column of their first pixel."""
    with pytest.raises(DataError, match="missing-package"):
        monkeypatch.setitem(sys.modules, "regularizepsf", None)
        read_array_psf(tmp_path / "a.h5")
    values = np.array([gaussian(16, 1.5), 3 * gaussian(16, 1.5)])
    values[1, 0, 0] = -0.1
    package = ModuleType("regularizepsf")
    loaded = SimpleNamespace(coordinates=[(0, 8), (-8, 24)], values=values)
    package.ArrayPSF = SimpleNamespace(load=lambda path: loaded)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "regularizepsf", package)
    one, other = read_array_psf(tmp_path / "a.h5")
    assert (one.x_px, one.y_px, other.x_px, other.y_px) == (16, 8, 32, 0)
    assert other.psf.total == pytest.approx(1.0)
