"""The rows of the table that judge the set of hypotheses in reports.

"Covers", "right and alone" and the members of a set are explained in `scoring`. "Noncentrality" and "rival" are numbers
of the ideal observer (`bounds.Known`): the chi2 of the gap that remains in noise-free images after the PSF is refitted,
and the distance of the nearest hypothesis that is not true. Rows that need these numbers count only cases for which
they were computed.

| row | cases | counted |
|---|---|---|
| set covers the truth: all, clean, single, pair, not in the library | all, or of one kind | a member covers the truth |
| mean number of members | all; cases with a noncentrality of SEEN or more | number of members of the set |
| right and alone / ideal observer | cases with an ideal observer, and clean cases | the number of sets that are right and alone, divided by the number expected of the ideal observer (the sum of `bounds.Known.alone`) |
| right verdict / ideal observer | the same | the number of verdicts that are right, divided by the same number |
| clean data: set without [] | clean | no member is [] |
| one wrong effect alone in the set | all | the only member names effects, none of which is true |
| not in the library: unknown in the set | effects that are not in the library; one row counts cases with a noncentrality of SEEN or more, the next row cases with a rival of SEEN or more | a member is ["unknown"] |
| strong effects | cases with STRONG_PCT left or more | a member covers the truth |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import mean

from psfcore.blind.cases import CLEAN, FOREIGN, PAIR, SINGLE
from psfcore.blind.rows import Row, of_values, share, share_of_expected
from psfcore.blind.scoring import (
    NOTHING,
    Judged,
    has_only_wrong_effects,
    is_right_and_alone,
    set_covers_truth,
    verdict_is_right,
)

SEEN = (
    30.0  # chi2; an effect with this noncentrality is found among eighteen effects with a probability of 0.99
)
STRONG_PCT = 10.0
KIND_WORDS = {CLEAN: "clean", SINGLE: "one effect", PAIR: "two effects", FOREIGN: "not in the library"}


def set_rows(judged: Sequence[Judged]) -> tuple[Row, ...]:
    """The rows."""
    seen = [case for case in judged if case.noncentrality >= SEEN]
    foreign = [case for case in judged if case.kind == FOREIGN]
    return (
        share("set covers the truth", judged, set_covers_truth, "0.86 - 0.94", lambda p: 0.86 <= p <= 0.94),
        *(
            share(
                f"the same, {words}",
                [case for case in judged if case.kind == kind],
                set_covers_truth,
                ">= 0.80",
                lambda p: p >= 0.8,
            )
            for kind, words in KIND_WORDS.items()
        ),
        of_values(
            "mean number of members of the set",
            [_size(case) for case in judged],
            mean,
            "<= 3",
            lambda value: value <= 3,
        ),
        of_values(
            "the same, noncentrality >= 30",
            [_size(case) for case in seen],
            mean,
            "<= 1.5",
            lambda value: value <= 1.5,
        ),
        _against_ideal("right and alone / ideal observer", judged, is_right_and_alone),
        _against_ideal(
            "the same, without clean data",
            [case for case in judged if case.kind != CLEAN],
            is_right_and_alone,
        ),
        _against_ideal("right verdict / ideal observer", judged, verdict_is_right),
        share(
            "clean data: set without []",
            [case for case in judged if case.kind == CLEAN],
            lambda case: NOTHING not in case.members,
            "<= 0.01",
            lambda p: p <= 0.01,
        ),
        share(
            "one wrong effect alone in the set",
            judged,
            has_only_wrong_effects,
            "<= 0.02",
            lambda p: p <= 0.02,
        ),
        share(
            "not in the library, noncentrality >= 30: unknown in set",
            [case for case in foreign if case.noncentrality >= SEEN],
            set_covers_truth,
            ">= 0.85",
            lambda p: p >= 0.85,
        ),
        share(
            "the same, nearest rival >= 30",
            [case for case in foreign if case.known is not None and (case.known.rival or 0.0) >= SEEN],
            set_covers_truth,
        ),
        share(
            "set covers the truth, >= 10 % left",
            [case for case in judged if case.left_pct >= STRONG_PCT],
            set_covers_truth,
            ">= 0.95",
            lambda p: p >= 0.95,
        ),
    )


def _size(case: Judged) -> float:
    return float(len(case.members))


def _against_ideal(figure: str, cases: Sequence[Judged], holds: Callable[[Judged], bool]) -> Row:
    return share_of_expected(
        figure,
        [case for case in cases if case.known is not None],
        holds,
        lambda case: 0.0 if case.known is None else case.known.alone,
        ">= 0.85",
        lambda ratio: ratio >= 0.85,
    )
