"""A complete fit: curves with errors, overdispersion, limits, free shells, progress, and the PSF file."""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.psf import REACH_GRID_PX, cumulative_curve
from psfcore.scatter import fit as fit_module
from psfcore.scatter.fit import (
    RADII_PX,
    TransitFit,
    fit_transit,
    fitted_psf,
    overdispersion,
)
from psfcore.scatter.inversion import Solution, invert
from psfcore.scatter.report import fit_json
from psfcore.scatter.shapes import SHAPES
from psfcore.simulate.transit import observed_transit
from tests.psfcore.conftest import LIMITS
from tests.psfcore.small_transits import (
    DIFFRACTION,
    IMAGES,
    fitted,
    noise_free,
    sky,
    solved,
    true_curve,
)


def fit_of(patch: pytest.MonkeyPatch, solution: Solution, **asked: Any) -> TransitFit:
    """A fit with a known inversion, without the slow fits of free shells and other shapes."""
    patch.setattr(fit_module, "_free_shells", lambda *_: fitted().free)
    patch.setattr(fit_module, "compare_shapes", lambda *_, **__: ())
    return fit_transit(solution.transit, solution=lambda *_, **__: solution, **asked)


def with_inversion(solution: Solution, **changes: Any) -> Solution:
    return dataclasses.replace(solution, inversion=dataclasses.replace(solution.inversion, **changes))


def stretched(solution: Solution) -> Solution:
    """The solution as if it had been fitted with a stretch, with a result of 5 % along x."""
    inversion = solution.inversion
    covariance = np.zeros((4, 4))
    covariance[:3, :3], covariance[3, 3] = inversion.covariance, 0.01**2
    return with_inversion(
        solution,
        shape=SHAPES["stretched-along-x"],
        coordinates=np.append(inversion.coordinates, math.log(1.05)),
        covariance=covariance,
    )


def test_curves_agree_with_the_truth_within_their_errors() -> None:
    fit = fitted()
    assert fit.curve.radii_px.tolist() == list(RADII_PX)
    pull = (fit.curve.pct - true_curve(RADII_PX)) / fit.curve.sigma
    assert np.abs(pull).max() < 4
    np.testing.assert_allclose(fit.curve.pct[:7], fit.inversion.curve_pct, atol=0.01)
    np.testing.assert_allclose(fit.curve.sigma[:7], fit.inversion.curve_sigma, rtol=0.02)


def test_kernels_sum_to_1_and_the_diffuse_part_is_the_shape() -> None:
    fit = fitted()
    assert fit.kernel.shape == fit.scatter.shape == (REACH_GRID_PX, REACH_GRID_PX)
    assert fit.kernel.sum() == pytest.approx(1, abs=1e-4)
    assert fit.scatter.sum() == pytest.approx(1, abs=1e-12)
    assert fit.kernel.min() >= 0
    np.testing.assert_allclose(fit.curve.pct, cumulative_curve(fit.kernel, RADII_PX))
    total, sigma = fit.inversion.values["total"], fit.inversion.value_sigma["total"]
    assert (fit.diffuse_curve.pct[0], fit.diffuse_curve.sigma[0]) == pytest.approx((100 * total, 100 * sigma))


def test_noise_alone_is_no_overdispersion() -> None:
    fit = fitted()
    assert fit.overdispersion == 1
    np.testing.assert_array_equal(fit.covariance, fit.inversion.covariance)
    assert fit.value_sigma == fit.inversion.value_sigma
    assert not [line for line in fit.limits if "scatter" in line and "noise" in line]


def test_overdispersion_is_the_chi2_of_the_means_unless_chance_explains_it() -> None:
    """With nine degrees of freedom, chance explains factors up to 1 + 2 sqrt(2 / 9)."""
    inversion = solved().inversion
    edge = 1 + 2 * math.sqrt(2 / 9)
    for factor, expected in ((0.98 * edge, 1.0), (1.02 * edge, 1.02 * edge), (25.0, 25.0)):
        off = math.sqrt(9 * factor / IMAGES)
        frames = tuple(
            dataclasses.replace(f, expected=f.observed + (-1) ** n * off * f.noise)
            for n, f in enumerate(inversion.frames)
        )
        found = overdispersion(dataclasses.replace(inversion, frames=frames))
        assert found == pytest.approx(expected, rel=1e-9)
    few = dataclasses.replace(inversion, frames=inversion.frames[:3])
    assert overdispersion(few) == 1.0


@cache
def with_an_offset() -> Solution:
    """A transit with all pixels 15 DN too bright, an effect that the model lacks."""
    of = sky()
    shifted = dataclasses.replace(of, plan=dataclasses.replace(of.plan, dark_offset_dn=15.0))
    return invert(observed_transit(shifted, 3).transit)


def test_an_effect_that_the_model_lacks_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = fit_of(monkeypatch, with_an_offset())
    assert fit.overdispersion > 4
    words = "; ".join(fit.limits)
    assert f"vary {math.sqrt(fit.overdispersion):.1f} times as much as noise explains" in words
    np.testing.assert_allclose(fit.covariance, fit.overdispersion * fit.inversion.covariance)
    assert fit.value_sigma["c"] == pytest.approx(
        math.sqrt(fit.overdispersion) * fit.inversion.value_sigma["c"]
    )
    np.testing.assert_allclose(
        fit.curve.sigma[:7], math.sqrt(fit.overdispersion) * fit.inversion.curve_sigma, rtol=0.02
    )
    assert fit_json(fit)["overdispersion"] == fit.overdispersion


def test_limits_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [line for line in fitted().limits if "field is 128 px" in line]
    transit, inversion = solved().transit, solved().inversion
    one_pointing = dataclasses.replace(
        transit, frames=tuple(dataclasses.replace(f, pointing=2) for f in transit.frames)
    )
    frames = [dataclasses.replace(f, pointing=2) for f in inversion.frames]
    frames[4] = dataclasses.replace(frames[4], found=dataclasses.replace(frames[4].found, settled=False))
    unsure = with_inversion(
        dataclasses.replace(solved(), transit=one_pointing),
        converged=False,
        covariance=200 * inversion.covariance,
        left_out={"007.fits": "found no occulter", "000.fits": "too dark"},
        frames=tuple(dataclasses.replace(f, chi2=3 * f.chi2) for f in frames),
    )
    words = "; ".join(fit_of(monkeypatch, unsure).limits)
    for told in (
        f"did not converge in {len(inversion.rounds)} rounds",
        "did not use 2 images: 000.fits (too dark); 007.fits (found no occulter)",
        "with 1 pointing, the data hardly distinguish",
        "px has a standard error of more than 3 percentage points",
        "does not describe the occulted pixels",
        "position of the occulter did not converge in 1 image",
    ):
        assert told in words


def test_free_shells_agree_with_the_truth_within_the_field() -> None:
    free = fitted().free
    assert free is not None
    truth = free.segments.mean_of_map(fitted().scatter)
    low, median, high = free.weights_pct((2.275, 50.0, 97.725))
    assert (low <= median).all() and (median <= high).all()
    edges = np.array(free.segments.edges_px)
    told = (edges[:-1] > 12) & (edges[:-1] < 100)
    light = (median * free.segments.counts)[told].sum()
    assert light == pytest.approx((truth * free.segments.counts)[told].sum(), rel=0.1)
    beyond = free.beyond_pct((50.0,))[0]
    assert (np.diff(beyond) <= 1e-9).all()
    assert beyond[0] == pytest.approx(fitted().diffuse_curve.pct[0], abs=3)
    held = edges[:-1] > 2 * 128  # no two pixels of the field are that far apart
    of_held = free.fits.fits[:, held]
    assert of_held.shape[0] == 14
    np.testing.assert_allclose(of_held, np.broadcast_to(truth[held], of_held.shape), rtol=0.2)


def test_an_unknown_shape_is_refused() -> None:
    with pytest.raises(DataError, match="unknown-shape"):
        fit_transit(noise_free(sky()), shape="spiral")


def test_progress_of_the_whole_fit_increases_to_its_end() -> None:
    """Every call increases the step, and no step exceeds the total (fit without the published recipe)."""
    seen: list[tuple[str, int, int]] = []
    whole = fit_module._FitProgress(lambda *at: seen.append(at), 2, compared=True, published=0)
    stages = [
        "reconstructing",
        *[f"round {n}" for n in range(1, 9)],
        "errors",
        "free shells",
        "comparing shapes",
    ]
    for stage in stages:
        for step in range(2):
            whole(stage, step, 2)
    done = [step / of for _, step, of in seen]
    assert [stage for stage, _, _ in seen][::2] == stages
    assert all(0 < at <= 1 for at in done)
    steps = [step for _, step, _ in seen]
    assert steps == sorted(set(steps))
    assert done[-1] > 0.95


def test_a_fitted_psf_is_written_and_read(tmp_path: Path) -> None:
    fit = fitted()
    psf = fitted_psf(fit, name="test", version="1.0.0", provenance={"images": IMAGES})
    assert psf.total == pytest.approx(1, abs=1e-4)
    middle = slice(REACH_GRID_PX // 2 - 15, REACH_GRID_PX // 2 + 16)
    np.testing.assert_array_equal(psf.components["DIFFRACTION"][middle, middle], DIFFRACTION)
    assert psf.components["DIFFRACTION"].sum() == pytest.approx(1)
    write_psf(tmp_path / "psf.fits", psf)
    read = read_psf(tmp_path / "psf.fits", LIMITS)
    np.testing.assert_allclose(read.kernel, fit.kernel, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(read.components["SCATTER"], fit.scatter, rtol=1e-6, atol=1e-15)
    assert (read.name, read.version, read.status) == ("test", "1.0.0", "draft")
    assert read.instrument == fit.transit.instrument
    assert read.plate_scale_arcsec == fit.transit.plate_scale_arcsec
    assert read.fitted is not None
    assert read.fitted.shape == "softened-power-law"
    np.testing.assert_array_equal(read.fitted.coordinates, fit.inversion.coordinates)
    np.testing.assert_array_equal(read.fitted.covariance, fit.covariance)
