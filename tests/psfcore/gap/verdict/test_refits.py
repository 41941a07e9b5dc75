"""The full refits of a diagnosis: their evidence, failures by name, and that each is made only once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.gap.evidence.fields import LIKELY, Field, fields_of
from psfcore.gap.verdict import refits as refitting
from psfcore.gap.verdict.posterior import Form, posterior, without_idle
from psfcore.gap.verdict.refits import Refits
from psfcore.gap.view import View
from studies import gap_calibration
from tests.psfcore.gap.small_gaps import OFFSET_DN, found

OFFSET, BOTH, BLUR = (
    Form(names) for names in (("dark_offset",), ("dark_offset", "core_blur"), ("core_blur",))
)


@pytest.fixture(autouse=True, scope="module")
def _found_before() -> None:
    """Make the diagnosis that all files share before a test replaces a part of it."""
    found()


def refits_of_found() -> Refits:
    return Refits(View(found().solution), found().model)


def test_a_refit_weighs_its_effect_all_pairs_with_it_and_the_triples_of_the_best_pair(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = refits_of_found()
    at_refit = made.weighed(OFFSET)
    assert at_refit is not None
    weighed, model = at_refit
    others = {e.name for e in found().evidence.effects} - {"dark_offset"}
    of_library = {form.effects: one for form, one in weighed.items() if form.field is None}
    pairs = {frozenset(("dark_offset", name)) for name in others}
    best = max((n for n in of_library if len(n) == 2), key=lambda names: of_library[names].log_evidence)
    triples = {frozenset((*best, name)) for name in others - set(best)}
    assert {frozenset(names) for names in of_library} == {
        frozenset(("dark_offset",)),
        *pairs,
        *triples,
    } and triples
    assert {form.field for form in weighed} == {None, *fields_of(model.evidence)}, (
        "every field beside the offset"
    )
    before = posterior(found().model)
    assert {form.names(before.order) for form in weighed} <= set(
        before.log_weights
    )  # the names keep their order
    (fit,) = made.made.values()
    value, sigma = fit.parameters("dark_offset")["offset"]
    assert value == pytest.approx(OFFSET_DN, abs=4 * sigma)
    # An offset is linear, so that the refit leaves the hypothesis as probable as it is in the linear model.
    settled = before.with_evidence(weighed, model)
    assert next(iter(without_idle(settled.probabilities()))) == ("dark_offset",)
    # The offset changes the cells by less than their noise, which hides how far the refit departs from first order.
    assert gap_calibration.departures_of(made) == ()
    monkeypatch.setattr(gap_calibration, "VISIBLE_SIGMA", 0.5)
    (departure,) = gap_calibration.departures_of(made)
    assert 0 < departure < 0.5

    # A refit is made once, and rivals are not refitted for the report.
    def again(*given: Any, **named: Any) -> None:
        raise AssertionError("a refit was repeated")

    monkeypatch.setattr(refitting, "add_to_model", again)
    assert made.of([OFFSET, BOTH]) == (fit,) and made.made == {OFFSET: fit}
    assert made.failures == []


def test_a_refit_whose_first_order_is_not_exact_enough_counts_for_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (fit,) = found().corrected
    monkeypatch.setattr(refitting, "add_to_model", lambda *given, **named: fit)
    refits = refits_of_found()
    at_refit = refits.weighed(OFFSET, most_visible=-1.0)
    assert at_refit is not None and at_refit[0] == {}
    assert refits.made == {} and refits.of([OFFSET]) == ()
    (failure,) = refits.failures
    assert "dark_offset in the model did not settle" in failure


def test_a_failed_refit_is_named_once_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def cannot(solution: Any, effects: Sequence[Any], *given: Any, **named: Any) -> None:
        asked.append([one.name for one in effects])
        raise DataError("effect-unseen", "expected dark_offset to add light")

    monkeypatch.setattr(refitting, "add_to_model", cannot)
    refits = refits_of_found()
    assert refits.weighed(OFFSET) is None and refits.weighed(OFFSET) is None
    # After two failed refits no third one is tried for the report.
    assert refits.of([OFFSET, BOTH, BLUR]) == ()
    assert asked == [["dark_offset"], ["dark_offset", "core_blur"]]
    assert refits.made == {}
    first, second = refits.failures
    assert "dark_offset in the model failed: " in first and "expected dark_offset to add light" in first
    assert "dark_offset + core_blur" in second


def test_a_field_is_refitted_as_an_effect() -> None:
    """The fit with a field in the model subtracts it from the images; the size of its coefficients follows from the data."""
    field = Field("detector", "dark", 0.8)
    refits = refits_of_found()
    at_refit = refits.weighed(Form((), field))
    assert at_refit is not None
    evidence = at_refit[0][Form((), field)].log_evidence
    assert evidence > posterior(found().model).forms[Form()].log_evidence
    (fit,) = refits.made.values()
    assert [effect.name for effect in fit.effects] == ["unknown"]
    model = refits.model_with(Form((), field))
    likely = model.evidence.prior.likely[list(model.evidence.columns["unknown"])]
    assert np.all((likely >= LIKELY) & (likely <= 10 * LIKELY)) and np.ptp(likely) == 0
