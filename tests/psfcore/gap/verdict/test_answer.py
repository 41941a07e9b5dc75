"""The answer: causes from probabilities made by hand; verdicts; answers to data with a known cause."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from psfcore.gap.evidence.closed_form import SUNS, ClosedForm, Form, Variant
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import Evidence
from psfcore.gap.evidence.tree import FAMILIES, SUN, Field
from psfcore.gap.verdict import answer as answers
from psfcore.gap.verdict.answer import (
    AND_SUN,
    IDLE,
    LEAST_IMAGES,
    Alternative,
    Cause,
    Label,
    answer_of,
    causes_of,
    prior_of,
    smallest_group,
)
from tests.psfcore.gap.linear_models import LIGHT, drawn, sigma_of, use_fields, with_sun

# Labels: effects of the detector, of the optics and of the scene, and other forms of their families.
DARK, GLOW, HALO, MESH, BLUR = (
    ("offset_place", "dark_offset"),
    ("light_place", None),
    ("psf", "wide_halo"),
    ("psf", "mesh_pitch"),
    ("core", "core_blur"),
)
LEAK, PSF, EDGE, THE_SUN = ("light_place", "intensity_gradient"), ("psf", None), ("edge", None), ("sun", SUN)
Shares = dict[tuple[Label, ...], float]


def told(shares: Shares, level: float = 0.9) -> list[list[Label]]:
    causes = causes_of({frozenset(labels): share for labels, share in shares.items()}, level)
    return [[(one.family.name, one.effect) for one in cause.alternatives] for cause in causes]


def sorted_labels(labels: Sequence[Label]) -> list[str]:
    return sorted(map(str, labels))


def test_causes_of_hand_made_probabilities() -> None:
    rows: list[tuple[Shares, list[list[Label]]]] = [
        # Something is 20 times as probable as nothing, or it is not told.
        ({(): 0.047, (DARK,): 0.953}, [[DARK]]),
        ({(): 0.049, (DARK,): 0.951}, []),
        # The smallest group of which one acts with the probability that was asked for.
        ({(DARK,): 0.89, (HALO,): 0.06, (BLUR,): 0.05}, [[DARK, HALO]]),
        ({(DARK,): 0.4, (HALO,): 0.35, (BLUR,): 0.25}, [[DARK, HALO, BLUR]]),
        ({(DARK, HALO): 0.5, (DARK, BLUR): 0.45, (EDGE,): 0.05}, [[DARK], [HALO, BLUR]]),
        # A name against the other forms of its family.
        ({(LEAK,): 0.55, (GLOW,): 0.45}, [[LEAK]]),
        ({(LEAK,): 0.09, (GLOW,): 0.91}, [[GLOW]]),
        ({(LEAK,): 0.3, (GLOW,): 0.7}, [[GLOW, LEAK]]),
        ({(HALO,): 0.4, (MESH,): 0.32, (PSF,): 0.28}, [[HALO, MESH]]),
        # A second cause must pay, and a third one too.
        ({(DARK, HALO): 0.76, (DARK,): 0.24}, [[DARK], [HALO]]),
        ({(DARK, HALO): 0.74, (DARK,): 0.26}, [[DARK]]),
        ({(DARK, HALO, THE_SUN): 0.91, (DARK, HALO): 0.09}, [[DARK], [HALO], [THE_SUN]]),
        ({(DARK, HALO, THE_SUN): 0.89, (DARK, HALO): 0.11}, [[DARK], [HALO]]),
        ({(HALO, MESH): 1.0}, [[HALO], [MESH]]),
        ({(): 1.0}, []),
    ]
    for shares, causes in rows:
        found = told(shares)
        assert sorted(map(sorted_labels, found)) == sorted(map(sorted_labels, causes)), shares
    (cause,) = causes_of({frozenset([LEAK]): 0.55, frozenset([GLOW]): 0.44, frozenset(): 0.01}, 0.9)
    assert cause.alternatives[0].probability == pytest.approx(1.0), (
        "it has the probability of the other forms"
    )
    sizes = [len(told({(DARK,): 0.5, (HALO,): 0.3, (BLUR,): 0.2}, level)[0]) for level in (0.4, 0.7, 0.9)]
    assert sizes == [1, 2, 3]
    assert smallest_group({frozenset([DARK, HALO]): 0.6, frozenset([HALO]): 0.4}, 0.9) == [HALO]


def cause_of(*labels: Label) -> Cause:
    return Cause(tuple(Alternative(FAMILIES[family], effect, 0.5) for family, effect in labels))


def few_discs(evidence: Evidence, count: int) -> Evidence:
    return replace(evidence, discs=evidence.discs[:count])


def test_alternatives_are_told_the_most_probable_first() -> None:
    """The group finds MESH before BLUR, which is more probable, but mostly beside DARK."""
    shares = {(DARK,): 0.3, (DARK, BLUR): 0.31, (MESH,): 0.25, (BLUR,): 0.14}
    assert smallest_group({frozenset(labels): share for labels, share in shares.items()}, 0.92) == [
        DARK,
        MESH,
        BLUR,
    ]
    causes = causes_of({frozenset(labels): share for labels, share in shares.items()}, 0.92)
    assert [one.effect for one in causes[0].alternatives] == ["dark_offset", "core_blur", "mesh_pitch"]
    assert [one.probability for one in causes[0].alternatives] == pytest.approx([0.61, 0.45, 0.25])


def test_levels_and_verdicts(evidence: Evidence, monkeypatch: pytest.MonkeyPatch) -> None:
    levels = [
        ("name", (DARK,)),
        ("family", (GLOW,)),
        ("family", (HALO, MESH)),
        ("family", (GLOW, LEAK)),
        ("stage", (DARK, GLOW)),
        ("open", (DARK, HALO)),
    ]
    assert [cause_of(*labels).level for _, labels in levels] == [level for level, _ in levels]
    rows: list[tuple[Sequence[Sequence[Label]], str, tuple[str, ...]]] = [
        ([], "none", ()),
        ([[DARK]], "attributed", ("dark_offset",)),
        ([[DARK], [HALO]], "attributed", ("dark_offset", "wide_halo")),
        ([[DARK], [GLOW]], "attributed", ("dark_offset", "unknown")),
        ([[GLOW]], "unknown", ()),
        ([[GLOW], [EDGE]], "unknown", ()),
        ([[DARK, HALO]], "tie", ("dark_offset", "wide_halo")),
        ([[DARK], [HALO, BLUR]], "tie", ("dark_offset", "wide_halo", "core_blur")),
        ([[GLOW, LEAK]], "inconclusive", ("intensity_gradient",)),
        ([[GLOW, EDGE]], "inconclusive", ()),
        ([[DARK, BLUR], [GLOW]], "inconclusive", ("dark_offset",)),
    ]
    use_fields(monkeypatch)
    for labels, verdict, named in rows:
        causes = tuple(cause_of(*one) for one in labels)
        monkeypatch.setattr(answers, "causes_of", lambda *given, causes=causes: causes)
        found = answer_of(LinearModel(evidence, FLOOR), 0.9)
        assert (found.verdict, found.named, found.causes) == (verdict, named, causes), labels
        few = answer_of(LinearModel(few_discs(evidence, LEAST_IMAGES - 1), FLOOR), 0.9)
        assert few.verdict == ("inconclusive" if verdict == "none" else verdict)


def test_families_are_equally_likely_and_half_of_each_is_its_effects(evidence: Evidence) -> None:
    forms = ClosedForm(LinearModel(with_sun(evidence), FLOOR)).forms
    prior = prior_of(forms)
    families = {form.family for form in forms}
    for family in families:
        own = [form for form in forms if form.family == family]
        for kind in ([f for f in own if f.field is None], [f for f in own if f.field is not None]):
            if kind:
                assert sum(prior[form] for form in kind) == pytest.approx(0.5 / len(families)), family


def test_noise_one_effect_and_two_effects_are_told(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_fields(monkeypatch)
    plain = LinearModel(evidence, FLOOR)
    sigma = sigma_of(evidence, "column_smear")
    rows: list[tuple[dict[tuple[str, int], float], set[str]]] = [
        ({}, set()),
        ({("dark_offset", 0): 2.0}, {"dark_offset"}),
        ({("dark_offset", 0): 2.0, ("column_smear", 0): 30 * sigma}, {"dark_offset", "column_smear"}),
    ]
    for planted, names in rows:
        found = answer_of(drawn(plain, planted, 2), 0.9)
        assert set(found.named) == names and found.verdict == ("attributed" if names else "none")
        assert (found.none > 0.5) is not names and (found.none < 1e-3) is bool(names)
        assert sum(found.hypotheses.values()) == pytest.approx(1.0)
        assert list(found.hypotheses.values()) == sorted(found.hypotheses.values(), reverse=True)
        # A further cause that the data do not show is not listed.
        for labels, share in found.hypotheses.items():
            parts = [part for part in found.hypotheses if part and part < labels]
            assert all(share > IDLE * found.hypotheses[part] for part in parts)
        assert found.labels[DARK] == pytest.approx(sum(p for s, p in found.hypotheses.items() if DARK in s))
    # A strong cause is told although no form has its exact shape, and the noise is raised to what it leaves.
    wrong = drawn(plain, {("dark_offset", 0): 2.0}, 2).evidence
    noisy = tuple(replace(disc, residual=2 * disc.residual) for disc in wrong.discs)
    found = answer_of(LinearModel(replace(wrong, discs=noisy), FLOOR), 0.9)
    assert found.closed.misfit[0] == pytest.approx(4.0, rel=0.3) and found.named[:1] == ("dark_offset",)


class Weights:
    """A closed form with given ln E of an offset, a gain that changes with time, the Sun, and some of them together."""

    misfit = (1.0, 1.0)

    def __init__(self, alone: dict[str, float], together: dict[frozenset[str], float]) -> None:
        self.alone, self.given = alone, together
        nothing, one = np.zeros(0), np.ones(1)
        self.forms = (
            Form("offset_place", "dark_offset", None, np.zeros(1, np.intp), one, np.zeros(1, np.bool_)),
            Form("gain_time", None, LIGHT, np.zeros(1, np.intp), one, np.zeros(1, np.bool_)),
            Form("sun", SUN, None, nothing.astype(np.intp), nothing, nothing.astype(np.bool_)),
        )

    def of_form(self, form: Form) -> tuple[np.ndarray, Variant | None]:
        variant = None if form.is_sun else Variant(form, np.zeros(1, np.intp), 1.0, 0.0)
        return np.array([self.alone[form.family]]), variant

    def together(self, variants: Sequence[Variant], suns: Sequence[object] = (None,)) -> np.ndarray:
        acting = frozenset(one.form.family for one in variants) | ({"sun"} if None not in suns else set())
        one_sun = "sun" in acting and len(suns) == 1  # which has all of the probability
        return np.array([self.given.get(acting, 0.0) + (math.log(len(SUNS)) if one_sun else 0.0)])

    def fitted(self, variants: Sequence[Variant], sun: object) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(len(variants)), np.zeros((len(variants),) * 2)

    def normal(self, columns: np.ndarray) -> np.ndarray:
        return np.zeros((columns.size,) * 2)

    def chi2_left(self, variants: Sequence[Variant], sun: object) -> tuple[float, float]:
        return 1.0, 1.0

    def forget_suns(self) -> None: ...


def test_hypotheses_are_the_same_in_any_order_of_their_causes(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gain of large areas beside the offset and the Sun belongs to the Sun, whichever of both is likelier alone."""
    offset, gain, sun = "offset_place", "gain_time", "sun"
    together = {
        frozenset([offset, sun]): 60.0,
        frozenset([offset, gain]): 62.0,
        frozenset([gain, sun]): 21.0,
        frozenset([offset, gain, sun]): 62.0,
    }
    shares = []
    for alone in (20.0 - 1e-9, 20.0 + 1e-9):
        weights = Weights({offset: alone, gain: 15.0, sun: 20.0}, together)
        monkeypatch.setattr(answers, "ClosedForm", lambda *given, weights=weights, **how: weights)
        shares.append(answer_of(LinearModel(evidence, FLOOR), 0.9).hypotheses)
    assert shares[0] == pytest.approx(shares[1])
    # In units of the weight of the offset and the Sun; in the second prior, the gain beside them belongs to the Sun.
    gained = math.exp(62.0 - 60.0)
    first, second = 1 / (1 + (1 + AND_SUN) * gained), (1 + gained) / (1 + 2 * gained)
    assert shares[0][frozenset([DARK, THE_SUN])] == pytest.approx((first + second) / 2)


def test_a_gain_in_time_is_the_instrument_or_the_sun(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks that change on their own are the Sun; a gain of large areas beside them may be the Sun as well."""
    plain = drawn(LinearModel(with_sun(evidence), FLOOR), {}, 4)
    blocks, rng = plain.evidence.unocculted, np.random.default_rng(1)
    times = np.linspace(-1, 1, len(blocks.levels))
    own = 0.1 * rng.normal(size=(3, blocks.levels.shape[1]))[blocks.pointing - 1] * times[:, None]
    gain = 0.04 * np.sin(4 * times[:, None]) * np.linspace(-1, 1, blocks.levels.shape[1])
    use_fields(monkeypatch, LIGHT, Field("gain_time", "gain", "time", 0.2))
    rows = ((own, [[THE_SUN]]), (own + gain, [[THE_SUN]]), (gain, [[("gain_time", None)]]))
    for change, causes in rows:
        seen = replace(blocks, levels=blocks.levels * (1 + change), given_gain_width=blocks.gain_width)
        found = answer_of(replace(plain, evidence=replace(plain.evidence, unocculted=seen)), 0.9)
        labels = [[(one.family.name, one.effect) for one in cause.alternatives] for cause in found.causes]
        assert labels == causes
        # With the second prior of the Sun, the gain belongs to it; with the first one it is a cause of its own.
        alone = found.hypotheses.get(frozenset([THE_SUN]), 0.0)
        assert alone == pytest.approx(
            1.0 if change is own else 0.5 if causes == [[THE_SUN]] else 0.0, abs=1e-3
        )
