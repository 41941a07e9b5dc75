"""The whole fit of a transit: its curves and errors, free shells, compared shapes, limits, PSF, report and picture."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from psfcore.fits.psfs import read_psf, write_psf
from psfcore.psf import REACH_GRID_PX, cumulative_curve
from psfcore.scatter import fit as fit_module
from psfcore.scatter.as_published import AS_PUBLISHED, CORRECTED_ALONE, Choices, Published
from psfcore.scatter.fit import (
    ALONE_SUBSETS,
    BIAS_OF_BROAD_CORES_POINTS,
    RADII_PX,
    TransitFit,
    fit_json,
    fit_sentence,
    fit_transit,
    fitted_psf,
    overdispersion,
)
from psfcore.scatter.inversion import invert
from psfcore.scatter.plots import fit_png
from psfcore.scatter.reconstruction import Inversion, Solution
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.simulate.plan import default_plan
from psfcore.simulate.sky import true_sky
from psfcore.transit.transit import Transit
from tests.psfcore.conftest import LIMITS, gaussian
from tests.psfcore.small_transits import (
    BRIGHTNESS,
    DIFFRACTION,
    IMAGES,
    SCATTER,
    SIZE_PX,
    fitted,
    fitted_with_progress,
    observed,
    recipe,
    sky,
    solved,
    true_curve,
)


def fit_of(patch: pytest.MonkeyPatch, solution: Solution, **asked: Any) -> TransitFit:
    """A fit with a known inversion, on 512 px, without the slow fits of free shells and other shapes."""
    patch.setattr(fit_module, "REACH_GRID_PX", 512)
    patch.setattr(fit_module, "_free_shells", lambda *_: fitted().free)
    patch.setattr(fit_module, "compare_shapes", lambda *_, **__: ())
    return fit_transit(solution.transit, solution=lambda *_, **__: solution, **asked)


def with_inversion(solution: Solution, **changes: Any) -> Solution:
    return dataclasses.replace(solution, inversion=dataclasses.replace(solution.inversion, **changes))


def with_chi2(inversion: Inversion, factor: float) -> Inversion:
    """The inversion of twelve images as if chi2 of the disc means were this factor times its degrees of freedom."""
    off = math.sqrt(9 * factor / IMAGES)
    frames = tuple(
        dataclasses.replace(f, expected=f.observed + (-1) ** n * off * f.noise)
        for n, f in enumerate(inversion.frames)
    )
    return dataclasses.replace(inversion, frames=frames)


def test_curves_and_kernels_agree_with_the_truth_and_the_shape() -> None:
    fit = fitted()
    pull = (fit.curve.pct - true_curve(RADII_PX)) / fit.curve.sigma
    assert np.abs(pull).max() < 4
    np.testing.assert_allclose(fit.curve.pct[:7], fit.inversion.curve_pct, atol=0.01)
    np.testing.assert_allclose(fit.curve.sigma[:7], fit.inversion.curve_sigma, rtol=0.02)
    np.testing.assert_allclose(fit.curve.pct, cumulative_curve(fit.kernel, RADII_PX))
    assert fit.kernel.shape == fit.scatter.shape == (REACH_GRID_PX, REACH_GRID_PX)
    assert fit.kernel.sum() == pytest.approx(1, abs=1e-4) and fit.kernel.min() >= 0
    assert fit.scatter.sum() == pytest.approx(1, abs=1e-12)
    total, sigma = fit.inversion.values["total"], fit.inversion.value_sigma["total"]
    assert (fit.diffuse_curve.pct[0], fit.diffuse_curve.sigma[0]) == pytest.approx((100 * total, 100 * sigma))


def test_overdispersion_is_the_chi2_of_the_means_unless_chance_explains_it() -> None:
    """With nine degrees of freedom, chance explains factors up to 1 + 2 sqrt(2 / 9)."""
    fit, inversion = fitted(), solved().inversion
    assert fit.overdispersion == 1, "noise alone is no overdispersion"
    np.testing.assert_array_equal(fit.covariance, fit.inversion.covariance)
    assert fit.value_sigma == fit.inversion.value_sigma
    edge = 1 + 2 * math.sqrt(2 / 9)
    for factor, expected in ((0.98 * edge, 1.0), (1.02 * edge, 1.02 * edge), (25.0, 25.0)):
        assert overdispersion(with_chi2(inversion, factor)) == pytest.approx(expected, rel=1e-9)
    assert overdispersion(dataclasses.replace(inversion, frames=inversion.frames[:3])) == 1.0


def test_an_effect_that_the_model_lacks_enlarges_all_errors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    inversion = with_chi2(solved().inversion, 25.0)
    fit = fit_of(monkeypatch, dataclasses.replace(solved(), inversion=inversion))
    assert "vary 5.0 times as much as noise explains" in "; ".join(fit.limits)
    np.testing.assert_allclose(fit.covariance, 25 * inversion.covariance)
    assert fit.value_sigma["c"] == pytest.approx(5 * inversion.value_sigma["c"])
    np.testing.assert_allclose(fit.curve.sigma[:7], 5 * inversion.curve_sigma, rtol=0.02)
    assert fit_json(fit)["overdispersion"] == pytest.approx(25.0)
    assert [line for line in fitted().limits if "field is 128 px" in line]
    transit, inversion = solved().transit, solved().inversion
    one_pointing = [dataclasses.replace(f, pointing=2) for f in transit.frames]
    frames = [dataclasses.replace(f, pointing=2, chi2=3 * f.chi2) for f in inversion.frames]
    frames[4] = dataclasses.replace(frames[4], found=dataclasses.replace(frames[4].found, settled=False))
    unsure = with_inversion(
        dataclasses.replace(solved(), transit=dataclasses.replace(transit, frames=tuple(one_pointing))),
        converged=False,
        covariance=200 * inversion.covariance,
        left_out={"007.fits": "found no occulter", "000.fits": "too dark"},
        frames=tuple(frames),
    )
    words = "; ".join(fit_of(monkeypatch, unsure).limits)
    for part in (
        f"did not converge in {len(inversion.rounds)} rounds",
        "2 images: 000.fits (too dark); 007.fits (found no occulter)",
        "with 1 pointing",
        "more than 3 percentage points",
        "does not describe the occulted pixels",
        "did not converge in 1 image",
    ):
        assert part in words


def test_a_fit_with_a_broad_diffraction_psf_is_near_the_truth_and_says_its_bias(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert "finest structures" not in "; ".join(fitted().limits)
    plan = default_plan(IMAGES, SIZE_PX, oversampling=1, brightness=BRIGHTNESS)
    of = true_sky(plan, SCATTER, gaussian(31, 1.0), 3)
    fit = fit_of(monkeypatch, invert(observed(of).transit))
    assert fit.inversion.converged
    assert abs(100 * (fit.inversion.values["total"] - SCATTER.total)) < BIAS_OF_BROAD_CORES_POINTS
    assert "do not contain the finest structures" in "; ".join(fit.limits)


def test_free_shells_agree_with_the_truth_within_the_field() -> None:
    free = fitted().free
    assert free is not None
    truth = free.segments.mean_of_map(fitted().scatter)
    low, median, high = free.weights_pct((2.275, 50.0, 97.725))
    assert (low <= median).all() and (median <= high).all()
    edges = np.array(free.segments.edges_px)
    told = (edges[:-1] > 12) & (edges[:-1] < 100)
    light, expected = ((weight * free.segments.counts)[told].sum() for weight in (median, truth))
    assert light == pytest.approx(expected, rel=0.1)
    beyond = free.beyond_pct((50.0,))[0]
    assert (np.diff(beyond) <= 1e-9).all()
    assert beyond[0] == pytest.approx(fitted().diffuse_curve.pct[0], abs=3)
    unconstrained = edges[:-1] > 2 * 128  # no two pixels of the field are that far apart
    weights = free.weights[:, unconstrained]
    assert weights.shape[0] == 14
    np.testing.assert_allclose(weights, np.broadcast_to(truth[unconstrained], weights.shape), rtol=0.2)


def test_no_shape_gains_on_a_softened_power_law() -> None:
    compared = fitted().shapes
    assert [shape.name for shape in compared] == [name for name in SHAPES if name != SOFTENED_POWER_LAW.name]
    for shape in compared:
        assert set(shape.added) == set(SHAPES[shape.name].names) - set(SOFTENED_POWER_LAW.names)
        assert all(abs(value) < 4 * sigma for value, sigma in shape.added.values())
        assert 0 <= shape.gain < 16
        assert shape.held_out_gain is not None and shape.held_out_gain < 16


def test_progress_of_the_whole_fit_increases_to_its_end() -> None:
    """Every call increases the step, and no step exceeds the total (fit without the published recipe)."""
    _, seen = fitted_with_progress()
    steps = [step for _, step, _ in seen]
    assert steps == sorted(set(steps))
    assert all(0 < step <= of for _, step, of in seen) and steps[-1] > 0.95 * seen[-1][2]
    stages = list(dict.fromkeys(stage.rstrip(" 0123456789") for stage, _, _ in seen))
    assert stages == ["reconstructing", "round", "errors", "free shells", "comparing shapes"]


def test_a_fitted_psf_is_written_and_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fit = fit_of(monkeypatch, solved())
    psf = fitted_psf(fit, name="test", version="1.0.0", provenance={"images": IMAGES})
    middle = slice(256 - 15, 256 + 16)
    np.testing.assert_array_equal(psf.components["DIFFRACTION"][middle, middle], DIFFRACTION)
    write_psf(tmp_path / "psf.fits", psf)
    read = read_psf(tmp_path / "psf.fits", LIMITS)
    np.testing.assert_allclose(read.kernel, fit.kernel, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(read.components["SCATTER"], fit.scatter, rtol=1e-6, atol=1e-15)
    for name in ("name", "version", "status", "instrument", "plate_scale_arcsec", "fitted"):
        assert getattr(read, name) == getattr(psf, name), name
    assert psf.fitted is not None and psf.fitted.shape == "softened-power-law"
    np.testing.assert_array_equal(psf.fitted.coordinates, fit.inversion.coordinates)
    np.testing.assert_array_equal(psf.fitted.covariance, fit.covariance)


# --- report and plot --------------------------------------------------------------------------------------


def as_json(fit: TransitFit) -> dict[str, Any]:
    """The report after a round trip through JSON. It fails for nan and infinity."""
    content: dict[str, Any] = json.loads(json.dumps(fit_json(fit), allow_nan=False))
    return content


def test_report_and_sentence_have_the_values_of_the_fit() -> None:
    fit, content = fitted(), as_json(fitted())
    assert (content["schema"], content["shape"]) == ("psf-fit/1", "softened-power-law")
    assert content["curve"]["light_beyond_pct"] == fit.curve.pct.tolist()
    assert content["curve"]["sigma"] == fit.curve.sigma.tolist()
    assert content["diffuse_curve"]["radii_px"] == list(RADII_PX)
    for name, said in content["parameters"].items():
        assert (said["value"], said["sigma"]) == (fit.inversion.values[name], fit.value_sigma[name])
    assert content["parameters"]["b_px"]["unit"] == "px"
    assert content["coordinates"]["covariance"] == fit.covariance.tolist()
    assert content["coordinates"]["scales"] == ["log", "linear", "logit"]
    assert [r["moved_points"] for r in content["rounds"]] == [r.moved_points for r in fit.inversion.rounds]
    assert [f["file"] for f in content["frames"]] == [f"{n:03d}.fits" for n in range(IMAGES)]
    one = content["frames"][5]
    assert one["x"] == pytest.approx(sky().plan.place(5).x_px, abs=0.1)
    assert one["residual_pct"] == pytest.approx(100 * (one["expected_dn_s"] / one["observed_dn_s"] - 1))
    assert one["dark_pixels"] == fit.inversion.frames[5].dark[0].size
    assert content["limits"] == list(fit.limits)
    assert content["shapes"][0]["added"]["stretch_p"]["sigma"] > 0
    assert len(content["free_shells"]["weight"]["median"]) == 50
    assert content["first_guess"]["best_fov"] == fit.first_guess.best_pointing
    assert "stretch" not in content and "as_published" not in content
    fit, words = fitted(), fit_sentence(fitted())
    at = {r: (p, s) for r, p, s in zip(RADII_PX, fit.curve.pct, fit.curve.sigma, strict=True)}
    found = [float(number) for number in re.findall(r"\d+\.\d+", words)]
    total, sigma = fit.inversion.values["total"], fit.value_sigma["total"]
    expected = [100 * total, 100 * sigma, *at[0.5], *at[10.0], *at[100.0]]
    assert found[:8] == pytest.approx(expected, abs=0.00501)
    assert found[8] == pytest.approx(fit.inversion.chi2_per_pixel, abs=0.000501)
    assert f"{IMAGES} images" in words and as_json(fit)["sentence"] == words


def test_a_stretch_is_reported_and_free_shells_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The solution as if it had been fitted with a stretch, with a result of 5 % along x."""
    covariance = np.zeros((4, 4))
    covariance[:3, :3], covariance[3, 3] = solved().inversion.covariance, 0.01**2
    stretched = with_inversion(
        solved(),
        shape=SHAPES["stretched-along-x"],
        coordinates=np.append(solved().inversion.coordinates, math.log(1.05)),
        covariance=covariance,
    )
    content = as_json(fit_of(monkeypatch, stretched, shape="stretched-along-x"))
    assert content["stretch"] == pytest.approx({"stretch": 0.05, "angle_deg": 0.0})
    assert content["shape"] == "stretched-along-x"
    assert "free_shells" not in content and content["shapes"] == []


def test_the_report_contains_the_published_recipe_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Choices, int]] = []

    def published_recipe(transit: Transit, choices: Choices, *, subsets: int = 100, **_: Any) -> Published:
        asked.append((choices, subsets))
        found = recipe(AS_PUBLISHED)[0]
        (*first, (name, curve)) = found.rounds
        return dataclasses.replace(found, rounds=(*first, (name, curve + len(asked) - 1)))

    monkeypatch.setattr(fit_module, "invert_as_published", published_recipe)
    fit = fit_of(monkeypatch, solved(), as_published=True)
    assert asked == [(AS_PUBLISHED, 100), *((choices, ALONE_SUBSETS) for choices in CORRECTED_ALONE.values())]
    content = as_json(fit)["as_published"]
    whole, alone = content["whole"], content["one_bias_mended"]
    minus = np.array(whole["light_beyond_pct"]) - fit.curve.pct[:6]
    np.testing.assert_allclose(whole["minus_default_points"], minus)
    assert set(whole["spread_of_draws"]) == {"a", "b_px", "c"} and len(whole["rounds"]) == 6
    assert list(alone) == list(CORRECTED_ALONE)
    for n, one in enumerate(alone.values(), start=1):
        assert one["minus_published_points"] == pytest.approx([n] * 6)


def test_a_fit_is_drawn(tmp_path: Path) -> None:
    """A fit with all results; and one with a negative disc mean, without free shells, and with one round."""
    whole = dataclasses.replace(fitted(), published=recipe(AS_PUBLISHED)[0])
    image = solved().inversion.frames[4]
    odd = (dataclasses.replace(image, observed=-0.1 * image.observed),)
    one_round = with_inversion(solved(), frames=odd, rounds=solved().inversion.rounds[:1], converged=False)
    red = []
    for fit in (whole, dataclasses.replace(fitted(), free=None, solution=one_round)):
        fit_png(fit, tmp_path / "fit.png")
        picture = imread(tmp_path / "fit.png")[..., :3]
        np.testing.assert_allclose(
            picture.shape[:2], (1020, 1560), atol=1
        )  # matplotlib 3.9 cuts, 3.10 rounds
        assert 0.05 < picture.std() < 0.4
        red.append(int((np.abs(picture - np.array([179, 38, 30]) / 255).max(axis=-1) < 0.02).sum()))
    assert red[0] > red[1] + 300  # the curves of the published recipe
