"""The full refits of a diagnosis: their evidence, failures by name, and that each is made only once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.gap.evidence.evidence import gather
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.verdict import refits as refitting
from psfcore.gap.verdict.posterior import posterior, without_idle
from psfcore.gap.verdict.refits import Refits
from psfcore.gap.verdict.settled import settled_posterior
from psfcore.gap.view import View
from psfcore.scatter.inversion import invert
from tests.psfcore.gap.small_gaps import OFFSET_DN, found
from tests.psfcore.gap.small_transits import clean, effect

OFFSET = ("dark_offset",)


@pytest.fixture(scope="module")
def made() -> Refits:
    return Refits(View(found().solution), found().model)


def test_a_refit_weighs_its_effect_all_pairs_with_it_and_the_triples_of_the_best_pair(made: Refits) -> None:
    weighed = made.weighed(OFFSET)
    assert weighed is not None
    others = {e.name for e in found().evidence.effects} - set(OFFSET)
    pairs = {frozenset((*OFFSET, name)) for name in others}
    best = max((names for names in weighed if len(names) == 2), key=lambda names: weighed[names].log_evidence)
    triples = {frozenset((*best, name)) for name in others - set(best)}
    assert {frozenset(names) for names in weighed} == {frozenset(OFFSET), *pairs, *triples} and triples
    assert set(weighed) <= set(posterior(found().model).log_weights)  # the names keep their order
    (fit,) = made.made
    value, sigma = fit.parameters("dark_offset")["offset"]
    assert value == pytest.approx(OFFSET_DN, abs=4 * sigma)
    # An offset is linear, so that the refit leaves the hypothesis as probable as it is in the linear model.
    settled = posterior(found().model).with_evidence(weighed, len(others) + 1)
    assert next(iter(without_idle(settled.probabilities()))) == OFFSET


def test_a_refit_is_made_once_and_rivals_are_not_refitted_for_the_report(
    made: Refits, monkeypatch: pytest.MonkeyPatch
) -> None:
    (fit,) = made.of([OFFSET])

    def again(*given: Any, **named: Any) -> None:
        raise AssertionError("a refit was repeated")

    monkeypatch.setattr(refitting, "add_to_model", again)
    assert made.of([OFFSET, ("dark_offset", "core_blur")]) == (fit,) and made.made == (fit,)
    assert made.failures == []


def test_how_far_a_refit_departs_from_first_order_is_measured_where_noise_does_not_hide_it(
    made: Refits, monkeypatch: pytest.MonkeyPatch
) -> None:
    made.weighed(OFFSET)
    assert made.departures == {}  # the offset changes the cells by less than their noise
    monkeypatch.setattr(refitting, "VISIBLE_SIGMA", 0.5)
    assert 0 < made.departures[OFFSET] < 0.5


def test_a_refit_whose_first_order_is_not_exact_enough_counts_for_nothing() -> None:
    refits = Refits(View(found().solution), found().model)
    assert refits.weighed(OFFSET, most_visible=-1.0) == {}
    assert refits.made == () and refits.of([OFFSET]) == ()
    assert refits.failures == [
        "The full refit with dark_offset in the model did not settle; the linear model was used instead."
    ]


def test_a_failed_refit_is_named_once_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def cannot(solution: Any, effects: Sequence[Any], *given: Any, **named: Any) -> None:
        asked.append([one.name for one in effects])
        raise DataError("effect-unseen", "expected dark_offset to add light")

    monkeypatch.setattr(refitting, "add_to_model", cannot)
    refits = Refits(View(found().solution), found().model)
    assert refits.weighed(OFFSET) is None and refits.weighed(OFFSET) is None
    # After two failed refits no third one is tried for the report.
    assert refits.of([OFFSET, ("dark_offset", "core_blur"), ("core_blur",)]) == ()
    assert asked == [["dark_offset"], ["dark_offset", "core_blur"]]
    assert refits.made == () and refits.departures == {}
    assert len(refits.failures) == 2
    assert refits.failures[0].startswith("The full refit with dark_offset in the model failed: ")
    assert "expected dark_offset to add light" in refits.failures[0]
    assert "dark_offset + core_blur" in refits.failures[1]


@pytest.mark.slow  # test_settled.py has the fast case of a second effect
def test_a_second_effect_is_found_in_the_discs_beside_one_of_the_unocculted_field() -> None:
    """A gain mismatch, which the discs do not show, and a light leak, which only the discs show."""
    transit = clean()
    x = np.indices(transit.shape)[1] / 128 - 0.5
    frames = tuple(
        replace(
            frame,
            pixels=(
                (frame.pixels + 6.0 + 20.0 * x) * (1.1 if (frame.gain_mode or "") == "combined" else 1.0)
            ).astype(np.float32),
        )
        for frame in transit.frames
    )
    solution = invert(replace(transit, frames=frames))
    view = View(solution)
    library = [effect(name) for name in ("gain_mismatch", "intensity_gradient", "dark_offset", "core_blur")]
    model = replace(LinearModel(gather(solution, library, view=view), FLOOR), scale_error=0.1)
    settled, failed = settled_posterior(model, Refits(view, model).weighed)
    shares = without_idle(settled.probabilities())
    best = next(iter(shares))
    assert set(best) == {"gain_mismatch", "intensity_gradient"} and shares[best] > 0.9
    assert best not in failed
