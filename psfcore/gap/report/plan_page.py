"""The page of a plan, and its text: which effects would be found at which strength, and which could not be told apart."""

from __future__ import annotations

from psfcore.drawing.page import Bullets, Page, Part, Section, Table
from psfcore.gap.evidence.linear_model import UNLIKELY
from psfcore.gap.planning import Planned
from psfcore.gap.report.limits_tables import NOT_FOUND, alike_parts
from psfcore.gap.report.report import words
from psfcore.gap.verdict.limits import ALIKE, EffectLimits

SEARCHED = "*"
STRENGTH = (
    "An effect of this strength would be found with a probability of 90 %: the answer of the diagnosis then contains the effect "
    "and excludes “no effect”. The strength is the value of the named parameter while the other parameters of the effect are 0. "
    "The simulated Sun does not change; a Sun that changes during the transit hides stronger effects."
)
OF_SEARCH = (
    f"{SEARCHED} The effect searches for its position or form; the strength holds for the position or form that the search "
    "found in the simulated images."
)


def plan_page(found: Planned) -> Page:
    """The page of a plan."""
    sections = [
        Section("Strengths that would be found", _strengths(found)),
        Section("Effects that could not be told apart", alike_parts(found.limits)),
        Section("The plan", [_plan(found)]),
    ]
    if found.limits.untestable:
        items = [f"{words(name)}: {why}" for name, why in found.limits.untestable.items()]
        sections.append(Section("Effects that could not be tested", [Bullets(items)]))
    if found.left_out:
        items = [f"{name}: {why}" for name, why in found.left_out.items()]
        sections.append(Section("Images that the fit could not use", [Bullets(items)]))
    return Page("What a planned transit would show", sentence(found), sections)


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
        marked = name + (SEARCHED if name in found.searched else "")
        out.append(f"{marked:<28}{_strength(one):<34}{_likely(one):<14}{_remark(one)}".rstrip())
    out += ["", f"could not be told apart (distance below {ALIKE:g} sigma):"]
    out += [
        f"  {one.distance:.2f}  {' and '.join(one.pair)}: take {one.would_separate}"
        for one in found.limits.alike
    ]
    out += [] if found.limits.alike else ["  none"]
    out += [f"not testable: {name} ({why})" for name, why in found.limits.untestable.items()]
    out += [f"image not usable: {name} ({why})" for name, why in found.left_out.items()]
    return [*out, *([OF_SEARCH] if found.searched else [])]


def _strengths(found: Planned) -> list[Part]:
    header = ["effect", "parameter", "found at (90 %)", "unit", "likely size", "remark", "confirmed by"]
    rows = []
    for name, one in found.limits.effects.items():
        leading = one.leading
        strength = NOT_FOUND if leading.found_90 is None else f"{leading.found_90:.3g}"
        marked = words(name) + (SEARCHED if name in found.searched else "")
        rows.append(
            [
                marked,
                words(leading.name),
                strength,
                leading.unit,
                f"{leading.likely:.3g}",
                _remark(one),
                found.settled_by[name],
            ]
        )
    parts: list[Part] = [Table(header, rows, STRENGTH)]
    return [*parts, OF_SEARCH] if found.searched else parts


def _plan(found: Planned) -> Table:
    plan = found.plan
    rows = [
        [
            f"{one['pointing']}",
            words(one["view"]),
            f"{one['images']}",
            ", ".join(f"{exposure:g}" for exposure in one["exposures_s"]),
        ]
        for one in found.pointings
    ]
    caption = (
        f"{len(plan.shots)} images of {plan.size_px} x {plan.size_px} px; photon gain {plan.noise.photon_gain_dn:g} DN, read noise "
        f"{plan.noise.read_noise_dn:g} DN."
    )
    return Table(["pointing", "shows", "images", "exposure times (s)"], rows, caption)


def _is_credible(one: EffectLimits) -> bool:
    leading = one.leading
    return leading.found_90 is not None and leading.found_90 <= leading.likely


def _strength(one: EffectLimits) -> str:
    leading = one.leading
    if leading.found_90 is None:
        return f"{leading.name}: {NOT_FOUND}"
    return f"{leading.name} {leading.found_90:.3g} {leading.unit}".rstrip()


def _likely(one: EffectLimits) -> str:
    return f"{one.leading.likely:.3g} {one.leading.unit}".rstrip()


def _remark(one: EffectLimits) -> str:
    leading = one.leading
    if leading.found_90 is None or leading.found_90 > UNLIKELY * leading.likely:
        return "hidden at every plausible size"
    return "" if _is_credible(one) else "hidden at its likely size"
