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
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.effect_fits import fit_effects
from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.search import displaced
from psfcore.gap.library.optics import (
    _copy,
)
from psfcore.gap.verdict import correction
from psfcore.gap.verdict.correction import Corrected, _with_noise_of, add_to_model, images_without
from psfcore.gap.view import View
from psfcore.scatter.inversion import invert
from psfcore.transit.transit import Transit
from tests.psfcore.gap.small_transits import clean, effect


def test_a_round_that_leaves_more_than_the_previous_one_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """An offset of 1 DN; the second round also subtracts light that was never added."""
    offset = effect("dark_offset")
    frames = tuple(
        replace(frame, pixels=frame.pixels + np.float32(1.0 / frame.exposure_s)) for frame in clean().frames
    )
    found = invert(replace(clean(), frames=frames))
    model = LinearModel(gather(found, [offset]), FLOOR)
    taken_out: list[float] = []
    as_it_is = correction.images_without

    def spoiled(
        transit: Transit, view: View, effects: Sequence[Effect], theta: NDArray[np.float64]
    ) -> Transit:
        taken_out.append(float(theta[0]))
        again = as_it_is(transit, view, effects, theta)
        if len(taken_out) == 1:
            return again
        light = np.linspace(0.0, 40.0, again.shape[1], dtype=np.float32)
        return replace(again, frames=tuple(replace(f, pixels=f.pixels + light) for f in again.frames))

    monkeypatch.setattr(correction, "images_without", spoiled)
    monkeypatch.setattr(correction, "SETTLED", 0.0)
    added = add_to_model(found, [offset], fit_effects(model, [offset]), model)
    value, sigma, _ = added.values["offset"]
    assert len(taken_out) == 2 and added.rounds == 1
    assert value == pytest.approx(1.0, abs=4 * sigma)
    assert added.parameters("dark_offset") == {"offset": (value, sigma)}
    assert added.subtracted["dark_offset"] == pytest.approx((1.0,), abs=4 * sigma)


def test_a_refit_of_several_rounds_computes_the_jacobian_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plane of light; the model at the refit is that of a new linear model of the images without this plane."""
    plane = effect("intensity_gradient")
    x = np.indices(clean().shape)[1] / clean().shape[1] - 0.5
    frames = tuple(
        replace(frame, pixels=(frame.pixels + 4.0 + 8.0 * x).astype(np.float32)) for frame in clean().frames
    )
    found = invert(replace(clean(), frames=frames))
    model = LinearModel(gather(found, [plane]), FLOOR)
    gathered: list[Evidence] = []

    def counted(*given: Any, **named: Any) -> Evidence:
        gathered.append(gather(*given, **named))
        return gathered[-1]

    monkeypatch.setattr(correction, "gather", counted)
    monkeypatch.setattr(correction, "SETTLED", 0.0)
    offset = effect("dark_offset")
    added = add_to_model(found, [plane], fit_effects(model, [plane]), model, beside=[offset])
    assert added.rounds > 1 and len(gathered) == 1
    for name, true in (("level", 4.0), ("slope_x", 8.0), ("slope_y", 0.0)):
        value, sigma, _ = added.values[name]
        assert value == pytest.approx(true, abs=4 * sigma)
    assert added.beside is not None
    assert [e.name for e in added.beside.evidence.effects] == ["intensity_gradient", "dark_offset"]
    alone = gather(added.solution, added.effects)
    assert added.evidence.columns == alone.columns and added.evidence.size == alone.size
    for made, again in zip(added.evidence.discs, alone.discs, strict=True):
        assert made.residual == pytest.approx(again.residual)
        assert made.jacobian == pytest.approx(again.jacobian)


def test_a_refit_gives_the_parameters_of_each_effect() -> None:
    """The names of the parameters, without the name of the effect that precedes them if several effects are fitted together."""

    def refit(names: Sequence[str], values: dict[str, tuple[float, float, str]]) -> Corrected:
        kept: Any = None  # not read
        return Corrected(tuple(effect(name) for name in names), kept, kept, kept, values, {}, 1)

    alone = refit(["ghost"], {"share": (0.1, 0.01, "")})
    assert alone.parameters("ghost") == {"share": (0.1, 0.01)} and alone.label == "ghost"
    both = refit(
        ["ghost", "column_smear"],
        {"ghost.share": (0.1, 0.01, ""), "column_smear.share_below": (0.2, 0.02, "")},
    )
    assert both.parameters("ghost") == {"share": (0.1, 0.01)}
    assert both.parameters("column_smear") == {"share_below": (0.2, 0.02)}
    assert both.parameters("dark_offset") == {}
    assert both.label == "ghost + column_smear"


def test_a_share_of_light_cannot_be_negative() -> None:
    """Images that lost a share of their columns' light: a smear that adds light must not explain them."""
    smear = effect("column_smear")
    frames = tuple(
        replace(frame, pixels=frame.pixels - np.float32(0.03) * frame.pixels.mean(axis=0))
        for frame in clean().frames
    )
    found = invert(replace(clean(), frames=frames))
    model = LinearModel(gather(found, [smear]), FLOOR)
    below = fit_effects(model, [smear], any_sign=True)
    assert all(value < 0 for value, _, _ in below.values.values())
    with pytest.raises(DataError, match="expected column_smear to add light") as caught:
        add_to_model(found, [smear], below, model)
    assert caught.value.code == "effect-unseen"


def test_a_subtracted_effect_scales_with_the_brightness_of_the_image() -> None:
    """A copy in every image, and brightness that varies by 2 %: after subtraction the images of a pointing agree as well."""
    rng = np.random.default_rng(4)
    frames = tuple(
        replace(
            frame,
            pixels=(
                (frame.pixels + 0.4 * displaced(gaussian_filter(frame.pixels, 12.0), 40, -30))
                * (1 + 0.02 * rng.standard_normal())
            ).astype(np.float32),
        )
        for frame in clean().frames
    )
    found = invert(replace(clean(), frames=frames))
    view, copy = View(found), replace(effect("ghost"), changes=lambda view: _copy(12.0, 40, -30), held=None)
    before = gather(found, [copy], view=view)
    without = invert(images_without(found.transit, view, [copy], np.array([0.4])))
    after = _with_noise_of(before, gather(without, [copy]))
    assert after.all_unocculted.chi2 < before.all_unocculted.chi2 * 1.02
