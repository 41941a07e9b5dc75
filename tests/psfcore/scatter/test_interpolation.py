"""An interpolated PSF against the truth of simulated epochs, its stated errors, and the pairs that are refused."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.psf import CURVE_RADII_PX, FittedShape, Psf, crop_or_pad, cumulative_curve
from psfcore.scatter.interpolation import (
    Epoch,
    curve_sigma,
    interpolated_psf,
    interpolated_shape,
    parameters_of,
    weight_at,
)
from psfcore.scatter.inversion import invert
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import possible_psfs
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from tests.psfcore.conftest import LIMITS
from tests.psfcore.small_transits import DIFFRACTION, observed, sky, solved

T0, T1 = datetime(2022, 3, 1, tzinfo=UTC), datetime(2023, 3, 1, tzinfo=UTC)
MIDDLE = T0 + (T1 - T0) / 2
# Two states of a mirror: the second scatters more light, over shorter distances.
EARLY, LATE = ScatterTruth(6.15, 2.53, 0.411), ScatterTruth(5.2, 2.62, 0.455)
RADII = np.array(CURVE_RADII_PX)
SIZE, SMALL = 768, 256  # px; the largest radius is 300 px


def between(weight: float) -> ScatterTruth:
    """The truth of a steady change: each parameter changes linearly in time."""
    values = (
        (1 - weight) * getattr(EARLY, name) + weight * getattr(LATE, name) for name in ("b_px", "c", "total")
    )
    return ScatterTruth(*values)


def shape_of(truth: ScatterTruth, sigma: float = 0.0) -> FittedShape:
    """A fit that found the truth, with the same standard error for each coordinate."""
    coordinates = SOFTENED_POWER_LAW.coordinates({"b_px": truth.b_px, "c": truth.c, "total": truth.total})
    covariance = sigma**2 * np.eye(3)
    return FittedShape(
        "softened-power-law",
        SOFTENED_POWER_LAW.names,
        tuple(coordinates.tolist()),
        tuple(tuple(row) for row in covariance.tolist()),
    )


@cache
def psf_of(truth: ScatterTruth, sigma: float = 0.0, size: int = SIZE) -> Psf:
    """A fitted PSF whose kernel is that of the simulator, which shares no code with the shapes of the fit."""
    return Psf(
        kernel=np.maximum(total_kernel(truth, DIFFRACTION, size), 0.0),
        name="simulated",
        version="1.0.0",
        instrument="hri_euv",
        status="draft",
        plate_scale_arcsec=0.492,
        components={"DIFFRACTION": crop_or_pad(DIFFRACTION, size)},
        fitted=shape_of(truth, sigma),
    )


def made(before: Psf, after: Psf, time: datetime = MIDDLE) -> Psf:
    return interpolated_psf(
        Epoch(before, T0),
        Epoch(after, T1),
        time,
        name="between",
        version="0.1.0",
        provenance={"why": "a test"},
    )


def curve(psf: Psf) -> NDArray[np.float64]:
    return cumulative_curve(psf.kernel, RADII)


def refused(code: str, change: Callable[[], object]) -> str:
    with pytest.raises(DataError) as caught:
        change()
    assert caught.value.code == code, caught.value.message
    return caught.value.message


def test_a_steady_change_is_found_within_a_tenth_of_a_point() -> None:
    """Only the coordinates, which are logarithms, change linearly; the truth changes linearly in its parameters."""
    before, after = psf_of(EARLY), psf_of(LATE)
    assert np.abs(curve(after) - curve(before)).max() > 3.0
    for weight in (0.25, 0.75):
        psf = made(before, after, T0 + weight * (T1 - T0))
        truth = cumulative_curve(total_kernel(between(weight), DIFFRACTION), RADII)
        assert np.abs(curve(psf) - truth).max() < 0.1, weight
        assert (psf.instrument, psf.plate_scale_arcsec, psf.status) == ("hri_euv", 0.492, "draft")


def fitted_at(truth: ScatterTruth, seed: int) -> Psf:
    """The PSF that the inversion of a noisy simulated transit finds."""
    inversion = solved().inversion if truth == EARLY else invert(observed(sky(truth), seed).transit).inversion
    at = inversion.coordinates
    values = dict(zip(("b_px", "c", "total"), inversion.shape.values(at).values(), strict=True))
    found = psf_of(ScatterTruth(**values))
    covariance = tuple(tuple(row) for row in inversion.covariance.tolist())
    assert found.fitted is not None
    return dataclasses.replace(found, fitted=dataclasses.replace(found.fitted, covariance=covariance))


def test_between_two_fitted_transits_the_curve_agrees_with_the_truth_within_its_error() -> None:
    """Two transits with noise are simulated with known scatter and fitted; the truth in the middle is that of a steady
    change."""
    before, after = fitted_at(EARLY, 3), fitted_at(LATE, 3)
    psf = made(before, after)
    truth = cumulative_curve(total_kernel(between(0.5), DIFFRACTION), RADII)
    off, sigma = np.abs(curve(psf) - truth), curve_sigma(psf, RADII)
    assert (off <= np.maximum(0.3, sigma)).all()
    assert sigma.max() < 3.0, "a stated error that says nothing would agree with every truth"


def test_the_stated_error_is_that_of_a_sudden_change() -> None:
    before, after = shape_of(EARLY), shape_of(LATE)
    q0, q1 = np.array(before.coordinates), np.array(after.coordinates)
    changed_at = (np.arange(10_000) + 0.5) / 10_000
    for weight in (0.1, 0.5, 0.8):
        found = interpolated_shape(before, after, weight)
        truths = np.where((changed_at < weight)[:, None], q1, q0)
        off = truths - np.array(found.coordinates)
        np.testing.assert_allclose(off.T @ off / changed_at.size, found.covariance, rtol=1e-9)
        np.testing.assert_allclose(off.mean(axis=0), 0, atol=1e-12)
    found = interpolated_shape(shape_of(EARLY, 0.02), shape_of(EARLY, 0.02), 0.5)
    np.testing.assert_allclose(np.array(found.covariance), 0.5 * 0.02**2 * np.eye(3), rtol=1e-12)
    found = interpolated_shape(shape_of(EARLY, 0.02), shape_of(LATE, 0.04), 0.25)
    d = np.array(shape_of(LATE).coordinates) - np.array(shape_of(EARLY).coordinates)
    expected = (0.75 * 0.02) ** 2 * np.eye(3) + (0.25 * 0.04) ** 2 * np.eye(3) + 0.1875 * np.outer(d, d)
    np.testing.assert_allclose(np.array(found.covariance), expected, rtol=1e-12)


def test_at_the_epochs_the_psf_is_that_of_the_fits_for_any_size() -> None:
    before, after = psf_of(EARLY, 0.01), psf_of(LATE, 0.03)
    for time, end in ((T0, before), (T1, after)):
        psf = made(before, after, time)
        assert psf.fitted == end.fitted
        np.testing.assert_allclose(psf.kernel, end.kernel, atol=1e-9)
    small, whole = (
        made(psf_of(EARLY, size=SMALL), psf_of(LATE, size=SMALL)),
        made(psf_of(EARLY), psf_of(LATE)),
    )
    np.testing.assert_allclose(small.kernel, crop_or_pad(whole.kernel, SMALL), rtol=1e-9, atol=1e-15)


def test_errors_of_parameters_and_of_a_curve_are_those_of_possible_psfs() -> None:
    said = parameters_of(shape_of(EARLY, 0.01))
    assert said["b_px"]["value"] == pytest.approx(6.15) and said["b_px"]["sigma"] == pytest.approx(0.0615)
    assert said["c"]["sigma"] == pytest.approx(0.01) and said["b_px"]["unit"] == "px"
    assert said["total"]["sigma"] == pytest.approx(0.01 * 0.411 * 0.589)
    # The sigma points have the covariance of the fit; for small errors their curves spread by the propagated error.
    psf = made(psf_of(EARLY, 0.004), psf_of(EARLY, 0.004))
    spread = np.std([curve(one) for one in possible_psfs(psf)], axis=0)
    np.testing.assert_allclose(curve_sigma(psf, RADII), spread, rtol=0.02)
    assert spread.max() > 0.05


def test_an_interpolated_psf_is_a_fitted_psf_that_is_written_and_read(tmp_path: Path) -> None:
    psf = made(psf_of(EARLY, 0.01), psf_of(LATE, 0.01), T0 + timedelta(days=73))
    assert set(psf.components) == {"DIFFRACTION", "SCATTER"}
    assert psf.provenance["why"] == "a test"
    ends = psf.provenance["interpolated_between"]
    assert [end["weight"] for end in ends] == pytest.approx([0.8, 0.2])
    assert [end["time"] for end in ends] == [T0.isoformat(), T1.isoformat()]
    write_psf(tmp_path / "p.fits", psf)
    again = read_psf(tmp_path / "p.fits", LIMITS)
    assert again.fitted == psf.fitted and len(possible_psfs(again)) == 6
    history = "".join(again.provenance["history"])
    assert "interpolated_at: 2022-05-13T00:00:00+00:00" in history and "simulated" in history
    other = made(again, psf_of(LATE, 0.01))
    assert other.fitted is not None, "the rounding of a file is no other diffraction"


def test_weights() -> None:
    assert weight_at(T0, T1, T0) == 0.0 and weight_at(T0, T1, T1) == 1.0
    assert weight_at(T0, T1, MIDDLE) == 0.5
    for time in (T0 - timedelta(seconds=1), T1 + timedelta(seconds=1)):
        message = refused("time-outside-epochs", lambda time=time: weight_at(T0, T1, time))
        assert "not extrapolated" in message and time.isoformat() in message
    refused("epochs-not-in-order", lambda: weight_at(T1, T0, MIDDLE))
    refused("epochs-not-in-order", lambda: weight_at(T0, T0, T0))


def without(psf: Psf, **changes: Any) -> Psf:
    return dataclasses.replace(psf, **changes)


def ghosted(psf: Psf) -> Psf:
    """The PSF with 0.1 % of the light in a ghost."""
    kernel = psf.kernel * 0.999
    kernel[40, 40] += 0.001 * psf.kernel.sum()
    return without(psf, kernel=kernel)


OTHER = SHAPES["knee"]
REFUSED: list[tuple[str, Callable[[Psf], Psf], str]] = [
    ("psf-not-fitted", lambda psf: without(psf, fitted=None), "heliopsf psf fit"),
    ("psf-not-fitted", lambda psf: without(psf, components={}), "diffraction"),
    ("psfs-differ", lambda psf: without(psf, instrument="aia_171"), "hri_euv and aia_171"),
    ("psfs-differ", lambda psf: without(psf, wavelength_angstrom=171.0), "None and 171.0"),
    ("psfs-differ", lambda psf: psf_of(LATE, size=SMALL + 2), "(256, 256) and (258, 258)"),
    (
        "shapes-differ",
        lambda psf: without(psf, fitted=FittedShape("knee", OTHER.names, (1.8, 2.5, -0.4, 0.0), ((0.0,) * 4,) * 4)),
        "softened-power-law (b_px, c, total) and knee",
    ),
    (
        "diffraction-differs",
        lambda psf: without(psf, components={"DIFFRACTION": np.roll(psf.components["DIFFRACTION"], 1)}),
        "same diffraction PSF",
    ),
    ("psf-not-of-its-shape", ghosted, "% of the light"),
]  # fmt: skip


def test_pairs_that_cannot_be_interpolated_are_refused() -> None:
    for (code, change, words), name in itertools.product(REFUSED, ("before", "after")):
        ends = {"before": psf_of(EARLY, size=SMALL), "after": psf_of(LATE, size=SMALL)}
        ends[name] = change(ends[name])
        message = refused(code, lambda ends=ends: made(**ends))
        assert words in message or name == "before"
        assert "expected" in message and "got" in message
