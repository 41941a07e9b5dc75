"""The JSON report of a fit, and its sentence."""

from __future__ import annotations

import dataclasses
import json
import re
from typing import Any

import numpy as np
import pytest

from psfcore.scatter import fit as fit_module
from psfcore.scatter.as_published.published import AS_PUBLISHED, CORRECTED_ALONE, Choices, Published
from psfcore.scatter.fit import (
    ALONE_SUBSETS,
    RADII_PX,
    TransitFit,
)
from psfcore.scatter.report import fit_json, fit_sentence
from psfcore.transit.transit import Transit
from tests.psfcore.scatter.test_fit import fit_of, stretched
from tests.psfcore.small_transits import (
    IMAGES,
    fitted,
    observed,
    recipe,
    sky,
    solved,
)


def as_json(fit: TransitFit) -> dict[str, Any]:
    """The report after a round trip through JSON. It fails for nan and infinity."""
    content = json.loads(json.dumps(fit_json(fit), allow_nan=False))
    assert isinstance(content, dict)
    return content


def test_a_report_is_json_with_the_values_of_the_fit() -> None:
    fit, content = fitted(), as_json(fitted())
    assert content["schema"] == "psf-fit/1"
    assert content["shape"] == "softened-power-law"
    assert content["curve"]["light_beyond_pct"] == fit.curve.pct.tolist()
    assert content["curve"]["sigma"] == fit.curve.sigma.tolist()
    assert content["diffuse_curve"]["radii_px"] == list(RADII_PX)
    for name, said in content["parameters"].items():
        assert (said["value"], said["sigma"]) == (fit.inversion.values[name], fit.value_sigma[name])
    assert content["parameters"]["b_px"]["unit"] == "px"
    assert content["coordinates"]["covariance"] == fit.covariance.tolist()
    assert content["coordinates"]["scales"] == ["log", "linear", "logit"]
    assert content["converged"] is True
    assert [r["moved_points"] for r in content["rounds"]] == [r.moved_points for r in fit.inversion.rounds]
    assert [f["file"] for f in content["frames"]] == [f"{n:03d}.fits" for n in range(IMAGES)]
    one = content["frames"][5]
    assert one["x"] == pytest.approx(observed(sky()).truth.places[5].x_px, abs=0.1)
    assert one["residual_pct"] == pytest.approx(100 * (one["expected_dn_s"] / one["observed_dn_s"] - 1))
    assert one["dark_pixels"] == fit.inversion.frames[5].dark[0].size
    assert content["limits"] == list(fit.limits)
    assert [s["name"] for s in content["shapes"]] == [s.name for s in fit.shapes]
    assert content["shapes"][0]["added"]["stretch_p"]["sigma"] > 0
    assert len(content["free_shells"]["weight"]["median"]) == 50
    assert content["first_guess"]["best_fov"] == fit.first_guess.best_pointing
    assert "stretch" not in content and "as_published" not in content


def test_the_sentence_has_the_curves_numbers() -> None:
    fit, words = fitted(), fit_sentence(fitted())
    at = {r: (p, s) for r, p, s in zip(RADII_PX, fit.curve.pct, fit.curve.sigma, strict=True)}
    found = [float(number) for number in re.findall(r"\d+\.\d+", words)]
    total, sigma = fit.inversion.values["total"], fit.value_sigma["total"]
    expected = [100 * total, 100 * sigma, *at[0.5], *at[10.0], *at[100.0]]
    assert found[:8] == pytest.approx(expected, abs=0.00501)
    assert found[8] == pytest.approx(fit.inversion.chi2_per_pixel, abs=0.000501)
    assert f"{IMAGES} images" in words
    assert as_json(fit)["sentence"] == words


def test_a_stretch_is_reported_and_free_shells_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = fit_of(monkeypatch, stretched(solved()), shape="stretched-along-x")
    assert fit.free is None and fit.shapes == ()
    content = as_json(fit)
    assert content["stretch"] == pytest.approx({"stretch": 0.05, "angle_deg": 0.0})
    assert content["shape"] == "stretched-along-x"
    assert "free_shells" not in content and content["shapes"] == []
    assert len(content["coordinates"]["covariance"]) == 4


def test_the_report_contains_the_published_recipe_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Choices, int]] = []

    def published(transit: Transit, choices: Choices, *, subsets: int = 100, **_: Any) -> Published:
        asked.append((choices, subsets))
        found = recipe(AS_PUBLISHED)[0]
        return dataclasses.replace(found, curve_pct=found.curve_pct + len(asked) - 1)

    monkeypatch.setattr(fit_module, "invert_as_published", published)
    fit = fit_of(monkeypatch, solved(), as_published=True)
    assert asked == [(AS_PUBLISHED, 100), *((choices, ALONE_SUBSETS) for choices in CORRECTED_ALONE.values())]
    content = as_json(fit)["as_published"]
    whole = content["whole"]
    assert whole["radii_px"] == [0.5, 2, 5, 10, 20, 50]
    np.testing.assert_allclose(
        whole["minus_default_points"], np.array(whole["light_beyond_pct"]) - fit.curve.pct[:6]
    )
    assert set(whole["spread_of_draws"]) == {"a", "b_px", "c"}
    assert [r["fit"] for r in whole["rounds"]] == ["free shells"] * 3 + ["softened power law"] * 3
    alone = content["one_bias_mended"]
    assert list(alone) == list(CORRECTED_ALONE)
    for n, one in enumerate(alone.values(), start=1):
        assert one["minus_published_points"] == pytest.approx([n] * 6)
