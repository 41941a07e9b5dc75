"""What the data of a transit could have shown, and which effects they cannot tell apart; and the page and text of a plan."""

from __future__ import annotations

from psfcore.drawing.page import render
from psfcore.gap.evidence.linear_model import UNLIKELY
from psfcore.gap.planning import Planned
from psfcore.gap.report.report import words
from psfcore.gap.verdict.limits import ALIKE, EffectLimits, Limits

Row = list[str]
NOT_FOUND = "not found"
SEARCHED = "*"
OF_SEARCH = (
    f"{SEARCHED} The effect searches for its position or form; the strength holds for the position or form that the search "
    "found in the simulated images."
)


def limit_rows(limits: Limits) -> list[Row]:
    """The strength of each effect that would be detected, and the strength that is excluded."""
    rows = []
    for name, one in limits.effects.items():
        leading = one.leading
        excluded = "" if leading.excluded_95 is None else f"{leading.excluded_95:.3g}"
        rows.append([words(name), words(leading.name), _strength(one), excluded, leading.unit])
    return rows


def _strength(one: EffectLimits) -> str:
    return NOT_FOUND if one.leading.found_90 is None else f"{one.leading.found_90:.3g}"


def pair_rows(limits: Limits) -> list[Row]:
    """The pairs of effects that the data cannot tell apart."""
    return [
        [" and ".join(map(words, one.pair)), f"{one.distance:.2f}", one.would_separate]
        for one in limits.alike
    ]


def distance_table(limits: Limits) -> tuple[Row, list[Row]]:
    """The distances of all pairs. The rows number the effects; the columns have the same numbers."""
    names, rows = list(limits.effects), []
    for k, name in enumerate(names):
        known = [limits.distances.get((other, name)) for other in names[:k]]
        cells = ["" if distance is None else f"{distance:.1f}" for distance in known]
        rows.append([f"{k + 1} {words(name)}", *cells, *[""] * (len(names) - k)])
    return ["effect", *(f"{k + 1}" for k in range(len(names)))], rows


PAIRS = {"ALIKE": ALIKE, "pair_rows": pair_rows, "distance_table": distance_table}  # for `limits.html`

# --- a plan -----------------------------------------------------------------------------------------------


def plan_page(found: Planned) -> str:
    """The page of a plan."""
    return render(
        "gap/report/plan.html",
        title="What a planned transit would show",
        lead=sentence(found),
        footer="",
        found=found,
        OF_SEARCH=OF_SEARCH,
        words=words,
        strength_rows=strength_rows,
        pointing_rows=pointing_rows,
        **PAIRS,
    )


def sentence(found: Planned) -> str:
    """The summary sentence of the page."""
    limits = found.limits
    visible = sum(_is_credible(one) for one in limits.effects.values())
    pairs = len(limits.alike)
    alike = (
        "all of them could be told apart"
        if pairs == 0
        else f"{pairs} pair{'s' if pairs > 1 else ''} of effects could not be told apart"
    )
    return f"The images of this plan would show {visible} of {len(limits.effects)} effects at their likely size; {alike}."


def lines(found: Planned) -> list[str]:
    """The page as lines of text."""
    out = [sentence(found), "", f"{'effect':<28}{'found at (90 %)':<34}{'likely size':<14}"]
    for name, one in found.limits.effects.items():
        leading = one.leading
        strength = f"{leading.name}: {NOT_FOUND}"
        if leading.found_90 is not None:
            strength = f"{leading.name} {leading.found_90:.3g} {leading.unit}".rstrip()
        likely = f"{leading.likely:.3g} {leading.unit}".rstrip()
        out.append(f"{_marked(name, name, found):<28}{strength:<34}{likely:<14}{_remark(one)}".rstrip())
    out += ["", f"could not be told apart (distance below {ALIKE:g} sigma):"]
    out += [
        f"  {one.distance:.2f}  {' and '.join(one.pair)}: take {one.would_separate}"
        for one in found.limits.alike
    ]
    out += [] if found.limits.alike else ["  none"]
    out += [f"not testable: {name} ({why})" for name, why in found.limits.untestable.items()]
    out += [f"image not usable: {name} ({why})" for name, why in found.left_out.items()]
    return [*out, *([OF_SEARCH] if found.searched else [])]


def strength_rows(found: Planned) -> list[Row]:
    """The strength at which each effect would be found, and how it would be confirmed."""
    return [
        [
            _marked(name, words(name), found),
            words(one.leading.name),
            _strength(one),
            one.leading.unit,
            f"{one.leading.likely:.3g}",
            _remark(one),
            found.settled_by[name],
        ]
        for name, one in found.limits.effects.items()
    ]


def _marked(name: str, text: str, found: Planned) -> str:
    return text + (SEARCHED if name in found.searched else "")


def pointing_rows(found: Planned) -> list[Row]:
    """The pointings of the plan, with their images and exposure times."""
    return [
        [
            f"{one['pointing']}",
            words(one["view"]),
            f"{one['images']}",
            ", ".join(f"{exposure:g}" for exposure in one["exposures_s"]),
        ]
        for one in found.pointings
    ]


def _is_credible(one: EffectLimits) -> bool:
    leading = one.leading
    return leading.found_90 is not None and leading.found_90 <= leading.likely


def _remark(one: EffectLimits) -> str:
    leading = one.leading
    if leading.found_90 is None or leading.found_90 > UNLIKELY * leading.likely:
        return "hidden at every plausible size"
    return "" if _is_credible(one) else "hidden at its likely size"
