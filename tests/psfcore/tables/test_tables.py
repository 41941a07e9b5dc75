"""Numbers read from the tables equal those computed from the pixels, within the stated interpolation error."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.psf import FittedShape, Psf, cumulative_curve, encircled_energy, radial_profile
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from psfcore.tables import lookup as psf_lookup
from psfcore.tables.lookup import EXACT_TO_PX, SCHEMA
from psfcore.tables.make import table_radii, tables_of
from tests.psfcore.conftest import delta, gaussian, make_psf

SIZE = 256
AT = SOFTENED_POWER_LAW.coordinates({"b_px": 6.15, "c": 2.53, "total": 0.41})


def scattering() -> np.ndarray:
    return SOFTENED_POWER_LAW.kernel(AT, SIZE)


def spiked(share: float = 0.02) -> Psf:
    """A scatter kernel with two orders just beyond 57 px and two at 200 px along x."""
    kernel = (1 - share) * SOFTENED_POWER_LAW.kernel(AT, 512)
    for y, x in ((1, 57), (-1, -57), (0, 201), (0, -201)):
        kernel[256 + y, 256 + x] += share / 4
    return make_psf(kernel)


def fitted(covariance: np.ndarray) -> Psf:
    shape = FittedShape(
        SOFTENED_POWER_LAW.name, SOFTENED_POWER_LAW.names, tuple(AT), tuple(map(tuple, covariance))
    )
    parts = {"DIFFRACTION": delta(SIZE), "SCATTER": scattering()}
    return make_psf(scattering(), components=parts, fitted=shape)


def test_the_tables_have_their_fields_and_the_same_radii_for_every_psf() -> None:
    large, small = table_radii(1448.2), table_radii(90.5)
    assert (np.diff(large) > 0).all() and large[-1] == 1448.2 and small[-1] == 90.5
    assert set(small[:-1]) <= set(large) and set(range(101)) <= set(large) and set(range(91)) <= set(small)
    assert (
        math.sqrt(2) in large and math.sqrt(EXACT_TO_PX**2 - 1) not in large
    )  # 2499 is no sum of two squares
    beyond = large[large > 100]
    assert (beyond[1:] / beyond[:-1]).max() < 1.03
    assert table_radii(0.0).tolist() == [0.0]
    tables = tables_of(make_psf(delta(9)))
    names = "schema name version shape sum central_weight reach_px plate_scale_arcsec radii_px exact_to_px"
    assert list(tables) == [
        *names.split(),
        "interpolation_error",
        "encircled",
        "encircled_changes",
        "profile",
    ]
    assert tables["schema"] == SCHEMA == psf_lookup.SCHEMA


@pytest.mark.parametrize("kernel", [scattering(), gaussian(65, 2.0), delta(9), gaussian(33, 1.0)[:, 4:-4]])
def test_the_tables_are_exact_near_the_centre_and_at_their_radii(kernel: np.ndarray) -> None:
    psf = make_psf(kernel)
    tables = json.loads(json.dumps(tables_of(psf), allow_nan=False))
    rng = np.random.default_rng(1)
    radii = rng.uniform(0, min(EXACT_TO_PX, psf.reach_px), 300)
    said = psf_lookup.curve(tables, radii.tolist())["light_beyond_pct"]["TOTAL"]
    assert said == pytest.approx(cumulative_curve(kernel, radii), abs=1e-7)
    whole = psf_lookup.curve(tables)
    assert whole["radii_px"] == pytest.approx(table_radii(psf.reach_px), rel=1e-9)
    wanted = cumulative_curve(kernel, table_radii(psf.reach_px))
    assert whole["light_beyond_pct"]["TOTAL"] == pytest.approx(wanted, abs=1e-7)
    # Radii with more digits than the tables keep, and with fewer.
    for root in (2.0**0.5, 1.4142135624, 10**0.5):
        if root < psf.reach_px:
            assert psf_lookup.encircled(tables, root)["light_within"]["TOTAL"] == pytest.approx(
                float(encircled_energy(kernel, root * (1 + 1e-9))), abs=1e-9
            )


def test_the_stated_interpolation_error_covers_the_true_one() -> None:
    psf = spiked()
    tables = tables_of(psf)
    radii = np.random.default_rng(2).uniform(EXACT_TO_PX, psf.reach_px, 3000)
    within = [psf_lookup.encircled(tables, r)["light_within"]["TOTAL"] for r in radii]
    off = np.abs(np.array(within) - encircled_energy(psf.kernel, radii)).max()
    said = tables["interpolation_error"]["TOTAL"]
    assert 0.003 < said <= 0.01  # two orders of 0.005, in one interval or in two
    assert off < 1.3 * said
    assert f"{100 * said:.2f} points" in psf_lookup.curve(tables)["resolution"]
    smooth = tables_of(make_psf(scattering()))
    assert smooth["interpolation_error"]["TOTAL"] < 1e-3
    kernel = np.pad(gaussian(2048, 3.0), 50)
    kernel[0, 0] = 5e-4  # farther than 1448 px
    said = psf_lookup.curve(tables_of(make_psf(kernel)))["light_beyond_pct"]["TOTAL"]
    assert said[-1] == 0 and min(said) == 0


def test_errors_follow_the_covariance_and_its_correlations() -> None:
    """If only the total is uncertain, all scattered light changes by the same factor, in an annulus too."""
    sigma = 0.05
    tables = tables_of(fitted(np.diag([0.0, 0.0, sigma**2])))
    total = 0.41
    moved = sigma * total * (1 - total)  # change of the total for a step of sigma in its logit
    found = psf_lookup.annulus(tables, 5, 60)
    light = encircled_energy(scattering(), [5, 60])
    wanted = moved * (light[1] - light[0]) / total
    assert found["sigma"] == {k: pytest.approx(wanted, rel=1e-3) for k in ("TOTAL", "SCATTER")}
    curve = psf_lookup.curve(tables, [5, 60])["sigma_points"]["TOTAL"]
    assert math.hypot(*curve) / 100 > 1.15 * wanted  # the error if both were independent
    covariance = np.array([[0.0025, 0.0009, 0.0], [0.0009, 0.0016, -0.0004], [0.0, -0.0004, 0.0009]])
    radii = np.array([1.0, 10.0, 57.0, 100.0])
    slopes = []
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-4
        ahead, behind = (SOFTENED_POWER_LAW.kernel(AT + s * step, SIZE) for s in (1, -1))
        slopes.append(-100 * encircled_energy((ahead - behind) / 2e-4, radii))
    wanted = np.sqrt(np.einsum("kr,kl,lr->r", slopes, covariance, slopes))
    tables = tables_of(fitted(covariance))
    assert psf_lookup.curve(tables, radii.tolist())["sigma_points"]["TOTAL"] == pytest.approx(
        wanted, rel=0.03
    )
    assert set(tables["profile"]["sigma"]) == {"TOTAL", "SCATTER"}
    assert max(tables["profile"]["sigma"]["TOTAL"][1:5]) > 0
    assert psf_lookup.curve(tables_of(make_psf(scattering())))["sigma_points"] == {}


def test_the_profile_holds_all_light_and_shows_arms() -> None:
    psf = make_psf(scattering())
    round_one, armed = tables_of(psf)["profile"], tables_of(spiked())["profile"]
    mean = np.array(round_one["mean_weight"]["TOTAL"])
    assert (mean * round_one["pixels"]).sum() == pytest.approx(psf.kernel.sum(), rel=1e-8)
    assert mean == pytest.approx(radial_profile(psf.kernel)[1], rel=1e-8)
    ring = round_one["radius_px"].index(57)
    assert round_one["azimuthal_rms_over_mean"][ring] < 0.05 < 5 < armed["azimuthal_rms_over_mean"][ring]


def test_two_psfs_are_compared_at_their_common_radii() -> None:
    less = SOFTENED_POWER_LAW.kernel(AT + np.array([0, 0, -0.1]), 128)
    one, other = tables_of(make_psf(scattering())), tables_of(make_psf(less))
    found = psf_lookup.compare(one, other)
    radii = np.array(found["radii_px"])
    assert radii.max() <= other["reach_px"] and set(range(91)) <= set(radii)
    # Radii are rounded to ten digits: a rounded root must still include its pixels.
    wanted = np.subtract(*(cumulative_curve(kernel, radii * (1 + 1e-9)) for kernel in (less, scattering())))
    assert found["difference_points"]["TOTAL"] == pytest.approx(wanted, abs=1e-6)
    assert found["largest_points"]["TOTAL"] == pytest.approx(wanted[np.abs(wanted).argmax()], abs=1e-6)
    assert found["difference_of_sums"] == pytest.approx(less.sum() - scattering().sum())
    assert found["difference_of_central_weights"] > 0
    assert psf_lookup.compare(one, one)["largest_points"]["TOTAL"] == 0
    tables = tables_of(make_psf(scattering(), plate_scale_arcsec=0.5))
    other = tables_of(make_psf(scattering(), plate_scale_arcsec=0.6))
    cases = [
        ("bad-radius", lambda: psf_lookup.encircled(tables, -1.0)),
        ("bad-radius", lambda: psf_lookup.curve(tables, [math.nan])),
        ("bad-radius", lambda: psf_lookup.curve(tables, [math.inf])),
        ("bad-radius", lambda: psf_lookup.curve(tables, [])),
        ("radius-beyond-reach", lambda: psf_lookup.encircled(tables, 182.0)),
        ("bad-annulus", lambda: psf_lookup.annulus(tables, 20.0, 20.0)),
        ("plate-scale-mismatch", lambda: psf_lookup.compare(tables, other)),
    ]
    for code, ask in cases:
        with pytest.raises(DataError, match=r"expected .*; got") as caught:
            ask()
        assert caught.value.code == code
