"""Parameters with units, and what a user is told about a value that does not fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
import sunpy.map
from astropy.time import Time

import heliopsf
from tests.heliopsf.test_forms import a_map, pixels


def test_a_quantity_counts_as_the_number_in_the_documented_unit(psf: heliopsf.Psf, small_toml: Path) -> None:
    plain = heliopsf.deconvolve(a_map(), psf, saturation_dn=100.0, noise=(2.0, 1.0), error_draws=2)
    for level in (100 * u.DN, 100 * u.adu, 50 * u.DN / u.s, 3000 * u.ct / u.min):  # the exposure takes 2 s
        for noise in ((2 * u.DN / u.ph, 1 * u.DN), (2 * u.ct / u.ph, 1.0), np.array([2.0, 1.0])):
            with_units = heliopsf.deconvolve(a_map(), psf, saturation_dn=level, noise=noise, error_draws=2)
            np.testing.assert_array_equal(with_units.mask, plain.mask)
            np.testing.assert_array_equal(with_units.uncertainty.array, plain.uncertainty.array)
    anonymous = psf.kernel
    for scale in (2.0, 2 * u.arcsec, 2 * u.arcsec / u.pix, u.Quantity(2 / 3600, "deg")):
        heliopsf.deconvolve(a_map(), anonymous, plate_scale_arcsec=scale)
    with pytest.raises(heliopsf.DataError, match="plate-scale-mismatch"):
        heliopsf.deconvolve(a_map(), anonymous, plate_scale_arcsec=2 * u.arcmin)
    beyond = psf.light_beyond([1, 10])
    for radii in ([1, 10] * u.pix, [2, 20] * u.arcsec, [2 / 60, 20 / 60] * u.arcmin):
        np.testing.assert_allclose(psf.light_beyond(radii), beyond)
    with pytest.raises(heliopsf.DataError, match="bad-quantity"):
        heliopsf.Psf(kernel=psf.kernel, name="p", version="1", instrument=None, status="user").light_beyond(
            [2, 20] * u.arcsec
        )
    for radius in (-3, np.nan, [1, np.inf], -1 * u.arcsec):
        with pytest.raises(heliopsf.DataError, match=r"expected .*got") as refused:
            psf.light_beyond(radius)
        assert refused.value.code == "bad-radius", radius
    np.testing.assert_array_equal(heliopsf.build_psf(small_toml, size=64 * u.pix).kernel, psf.kernel)
    before, time, after = (Time(f"{year}-03-01T12:00:00") for year in (2023, 2024, 2025))
    with pytest.raises(heliopsf.DataError, match="psf-not-fitted"):
        heliopsf.interpolate_psf(psf, psf, before_time=before, after_time=after, time=time)


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"noise": 5}, "bad-noise"),
    ({"noise": (1 * u.m, 2)}, "bad-quantity"),
    ({"noise": ("much", 2)}, "bad-quantity"),
    ({"saturation_dn": 5 * u.m}, "bad-quantity"),
    ({"saturation_dn": [1, 2]}, "bad-quantity"),
    ({"smap": pixels() * u.DN, "saturation_dn": 5 * u.DN / u.s}, "no-exposure"),
    ({"plate_scale_arcsec": 2 * u.kg}, "bad-quantity"),
    ({"iterations": 2.5}, "bad-steps"),
    ({"error_draws": "8"}, "bad-draws"),
    ({"threads": "two"}, "bad-threads"),
    ({"method": "richardson_lucy"}, "unknown-method"),
    ({"order": 2}, "unknown-parameter"),
    ({"regoin": "0:32,0:32"}, "unknown-parameter"),
    ({"psf": "no.fits"}, "no-such-file"),
    ({"psf": {"kernel": 1}}, "bad-input"),
    ({"smap": "no.fits"}, "no-such-file"),
    ({"smap": 7}, "bad-input"),
]


def test_a_value_that_does_not_fit_is_a_data_error_with_its_code(psf: heliopsf.Psf) -> None:
    for wrong, code in WRONG:
        with pytest.raises(heliopsf.DataError) as caught:
            heliopsf.deconvolve(**{"smap": a_map(), "psf": psf, **wrong})
        assert caught.value.code == code, wrong
        assert "expected" in caught.value.message, wrong
    for call, code in (
        (lambda: heliopsf.build_psf(171 * u.angstrom), "unknown-instrument"),  # type: ignore[arg-type]
        (lambda: heliopsf.build_psf("aia171"), "unknown-instrument"),
        (lambda: heliopsf.read_psf("hri_evu"), "no-such-file"),
        (lambda: heliopsf.psf_for("no.fits"), "no-such-file"),
        (lambda: psf.rebinned(1.5), "bad-binning"),  # type: ignore[arg-type]
        (lambda: heliopsf.fit_scatter("here", noise=5), "bad-noise"),  # type: ignore[arg-type]
    ):
        with pytest.raises(heliopsf.DataError) as caught:
            call()
        assert caught.value.code == code
    for read in (heliopsf.build_psf, heliopsf.read_psf):
        with pytest.raises(heliopsf.DataError, match="'aia_171'"):  # the instrument that is meant
            read("aia171")


def test_a_psf_may_be_named_by_its_instrument(small_toml: Path, psf: heliopsf.Psf) -> None:
    image = pixels()
    small = heliopsf.deconvolve(image, small_toml, full=True, steps=2)
    assert small.psf.name == "small" and small.psf.kernel.shape == (2048, 2048)
    np.testing.assert_array_equal(
        heliopsf.deconvolve(image, str(small_toml), steps=2), heliopsf.deconvolve(image, small.psf, steps=2)
    )


def test_results_show_themselves_in_two_lines_and_with_a_picture(psf: heliopsf.Psf) -> None:
    result = heliopsf.deconvolve(a_map(), psf, full=True, steps=2)
    for shown, words in (
        (psf, ("small", "draft", "171 angstrom", "64 x 64 px", "diffraction", "scattered light stays")),
        (result, ("SMALL_1 2024-03-01", "PSF small", "scattered light stays", "128 x 96 px", "2 steps")),
    ):
        text = repr(shown)
        assert len(text.splitlines()) == 2 and len(text) < 400
        assert all(word in text for word in words), text
        assert 'src="data:image/png;base64,' in shown._repr_html_()
    warned = heliopsf.deconvolve(sunpy.map.Map(pixels(), a_map().meta), psf.kernel, full=True, steps=2)
    assert set(warned.warnings) and all(code in repr(warned) for code in warned.warnings)
