"""Full refits with effects in the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from psfcore.errors import DataError
from psfcore.gap.effect import Change, Effect
from psfcore.gap.evidence.effect_fits import fit_effects
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import Evidence, gather
from psfcore.gap.evidence.search import displaced
from psfcore.gap.verdict import correction
from psfcore.gap.verdict.correction import add_to_model, images_without
from psfcore.gap.view import View
from psfcore.scatter.reconstruction import Solution
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Frame, Transit
from tests.psfcore.gap.small_gaps import changed, clean, effect, fit
from tests.transit_files import TRUTH, diffraction


def fit_of(change: Any, effects: Sequence[Effect]) -> tuple[Solution, LinearModel]:
    """The fit to twelve images that were changed, and its linear model."""
    solution = fit(changed(clean(), change))
    return solution, LinearModel(gather(solution, effects), FLOOR)


def test_a_round_that_leaves_more_than_the_previous_one_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """An offset of 1 DN; the second round also subtracts light that was never added."""
    offset = effect("dark_offset")
    solution, model = fit_of(lambda n, frame: frame.pixels + 1.0 / frame.exposure_s, [offset])
    taken_out: list[float] = []
    as_it_is = correction.images_without

    def spoiled(
        transit: Transit, view: View, effects: Sequence[Effect], theta: NDArray[np.float64]
    ) -> Transit:
        taken_out.append(float(theta[0]))
        again = as_it_is(transit, view, effects, theta)
        if len(taken_out) == 1:
            return again
        light = np.linspace(0.0, 40.0, again.shape[1])
        return changed(again, lambda n, frame: frame.pixels + light)

    monkeypatch.setattr(correction, "images_without", spoiled)
    monkeypatch.setattr(correction, "SETTLED", 0.0)
    added = add_to_model(solution, [offset], fit_effects(model, [offset]), model)
    value, sigma, _ = added.values["offset"]
    assert len(taken_out) == 2 and added.rounds == 1
    assert value == pytest.approx(1.0, abs=4 * sigma)
    assert added.parameters("dark_offset") == {"offset": (value, sigma)}
    # Noise and reference level are those of the images before the subtraction.
    for before, after in zip(model.evidence.discs, added.model.evidence.discs, strict=True):
        assert after.level == before.level
        np.testing.assert_array_equal(after.covariance, before.covariance)
    np.testing.assert_array_equal(
        added.model.evidence.unocculted.variance, model.evidence.unocculted.variance
    )


def test_a_refit_of_several_rounds_computes_the_jacobian_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plane of light; the model at the refit is that of a new linear model of the images without this plane."""
    plane = effect("intensity_gradient")
    x = np.indices(clean().shape)[1] / clean().shape[1] - 0.5
    solution, model = fit_of(lambda n, frame: frame.pixels + 4.0 + 8.0 * x, [plane])
    gathered: list[Evidence] = []

    def counted(*given: Any, **named: Any) -> Evidence:
        gathered.append(gather(*given, **named))
        return gathered[-1]

    monkeypatch.setattr(correction, "gather", counted)
    monkeypatch.setattr(correction, "SETTLED", 0.0)
    added = add_to_model(solution, [plane], fit_effects(model, [plane]), model)
    assert added.rounds > 1 and len(gathered) == 1
    for name, true in (("level", 4.0), ("slope_x", 8.0), ("slope_y", 0.0)):
        value, sigma, _ = added.values[name]
        assert value == pytest.approx(true, abs=4 * sigma), name
    alone = gather(added.solution, added.effects)
    assert added.model.evidence.columns == alone.columns and added.model.evidence.size == alone.size
    for made, again in zip(added.model.evidence.discs, alone.discs, strict=True):
        assert made.residual == pytest.approx(again.residual)
        assert made.jacobian == pytest.approx(again.jacobian)


def test_a_share_of_light_cannot_be_negative() -> None:
    """Images that lost a share of their columns' light: a smear that adds light must not explain them."""
    smear = effect("column_smear")
    solution, model = fit_of(lambda n, frame: frame.pixels - 0.03 * frame.pixels.mean(axis=0), [smear])
    below = fit_effects(model, [smear], any_sign=True)
    assert all(value < 0 for value, _, _ in below.values.values())
    with pytest.raises(DataError, match="expected column_smear to add light") as refusal:
        add_to_model(solution, [smear], below, model)
    assert refusal.value.code == "effect-unseen"


def test_a_subtracted_effect_scales_with_the_brightness_of_the_image() -> None:
    """A copy in every image, and brightness that varies by 2 %: after subtraction the images agree as well."""
    rng = np.random.default_rng(4)

    def copied(n: int, images: Sequence[Any]) -> Any:
        return displaced(gaussian_filter(images[n], 12.0), 40, -30)

    def with_copy(n: int, frame: Frame) -> np.ndarray:
        return (frame.pixels + 0.4 * copied(0, [frame.pixels])) * (1 + 0.02 * rng.standard_normal())

    copy = replace(effect("ghost"), changes=lambda view: [Change(copied, unocculted=False)], held=None)
    plan = default_plan(12, 128, oversampling=1, brightness=8.0)
    view = View(fit(changed(simulate(plan, TRUTH, diffraction(), seed=3).transit, with_copy)))
    before = gather(view.solution, [copy], view=view)
    after = gather(fit(images_without(view.solution.transit, view, [copy], np.array([0.4]))), [copy])
    blocks = replace(after.unocculted, variance=before.unocculted.variance)
    assert replace(after, unocculted=blocks).all_unocculted.chi2 < before.all_unocculted.chi2 * 1.02
