"""What the data of a transit could have shown, and which effects they cannot tell apart; and the page and text of a
plan.
"""

from __future__ import annotations

import sys

from psfcore.drawing.page import render
from psfcore.gap.evidence.linear_model import UNLIKELY
from psfcore.gap.planning import Planned
from psfcore.gap.report.report import unit_words, words
from psfcore.gap.verdict.limits import ALIKE, Limits, ParameterLimits

Row = list[str]
NOT_FOUND = "not found"
SEARCHED = "*"
OF_SEARCH = (
    f"{SEARCHED} The effect searches for its position or form; the strength holds for the position or form that the "
    "search found in the simulated images."
)


def limit_rows(limits: Limits) -> list[Row]:
    """The strength of each effect that would be detected, and the strength that is excluded."""
    return [
        [
            words(name),
            words(one.name),
            strength,
            "" if one.excluded_95 is None else f"{one.excluded_95:.3g}",
            unit_words(one.unit),
        ]
        for name, one, strength in _strengths(limits)
    ]


def _strengths(limits: Limits) -> list[tuple[str, ParameterLimits, str]]:
    """For each effect: its name, the limits of its leading parameter, and the strength that would be found, as text."""
    leading = {name: one.leading for name, one in limits.effects.items()}
    return [
        (name, one, NOT_FOUND if one.found_90 is None else f"{one.found_90:.3g}")
        for name, one in leading.items()
    ]


def pair_rows(limits: Limits) -> list[Row]:
    """The pairs of effects that the data cannot tell apart."""
    return [
        [" and ".join(map(words, one.pair)), f"{one.distance:.2f}", one.would_separate]
        for one in limits.alike
    ]


def distance_table(limits: Limits) -> tuple[Row, list[Row]]:
    """The table of the distances between the effects, in pairs. The rows number the effects; the columns have the same
    numbers.
    """
    names, rows = list(limits.effects), []
    for k, name in enumerate(names, 1):
        cells = [
            f"{distance:.1f}" if (distance := limits.distances.get((other, name))) is not None else ""
            for other in names
        ]
        rows.append([f"{k} {words(name)}", *cells])
    return ["effect", *map(str, range(1, len(names) + 1))], rows


# --- a plan -----------------------------------------------------------------------------------------------


def plan_page(found: Planned) -> str:
    """The page of a plan."""
    return render(
        "gap/report/plan.html",
        title="What a planned transit would show",
        lead=sentence(found),
        footer="",
        found=found,
        tables=sys.modules[__name__],
    ).html


def sentence(found: Planned) -> str:
    """The summary sentence of the page."""
    limits, pairs = found.limits, len(found.limits.alike)
    visible = sum(not _remark(one) for _, one, _ in _strengths(limits))
    alike = f"{pairs} pair{'s' if pairs > 1 else ''} of effects could not be told apart"
    return (
        f"The images of this plan would show {visible} of {len(limits.effects)} effects at their likely size; "
        f"{alike if pairs else 'no pair of the effects that would be found looks alike'}."
    )


def lines(found: Planned) -> list[str]:
    """The page as lines of text."""
    limits = found.limits
    out = [sentence(found), "", f"{'effect':<28}{'found at (90 %)':<34}{'likely size':<14}"]
    for name, one, strength in _strengths(limits):
        at = (
            f"{one.name}: {strength}"
            if one.found_90 is None
            else f"{one.name} {strength} {one.unit}".rstrip()
        )
        likely = f"{one.likely:.3g} {one.unit}".rstrip()
        out.append(f"{_marked(name, name, found):<28}{at:<34}{likely:<14}{_remark(one)}".rstrip())
    out += ["", f"could not be told apart (distance below {ALIKE:g} sigma):"]
    out += [
        f"  {one.distance:.2f}  {' and '.join(one.pair)}{one.would_separate and f': take {one.would_separate}'}"
        for one in limits.alike
    ]
    out += [] if limits.alike else ["  none"]
    out += [f"not testable: {name} ({why})" for name, why in limits.untestable.items()]
    out += [f"image not usable: {name} ({why})" for name, why in found.left_out.items()]
    return [*out, *([OF_SEARCH] if found.searched else [])]


def strength_rows(found: Planned) -> list[Row]:
    """The strength at which each effect would be found, and how it would be confirmed."""
    return [
        [
            _marked(name, words(name), found),
            words(one.name),
            strength,
            unit_words(one.unit),
            f"{one.likely:.3g}",
            _remark(one),
            found.settled_by[name],
        ]
        for name, one, strength in _strengths(found.limits)
    ]


def _marked(name: str, text: str, found: Planned) -> str:
    return text + (SEARCHED if name in found.searched else "")


def pointing_rows(found: Planned) -> list[Row]:
    """The pointings of the plan, with their images and exposure times."""
    return [
        [
            str(one["pointing"]),
            words(one["view"]),
            str(one["images"]),
            ", ".join(f"{s:g}" for s in one["exposures_s"]),
        ]
        for one in found.pointings
    ]


def _remark(one: ParameterLimits) -> str:
    """What hides an effect; empty if it would be found at its likely size."""
    if one.found_90 is None or one.found_90 > UNLIKELY * one.likely:
        return "hidden at every plausible size"
    return "hidden at its likely size" if one.found_90 > one.likely else ""
