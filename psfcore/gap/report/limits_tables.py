"""Tables of the limits: what the data of a transit could have shown, and which effects they cannot tell apart."""

from __future__ import annotations

from psfcore.drawing.page import Details, Part, Table
from psfcore.gap.report.report import words
from psfcore.gap.verdict.limits import ALIKE, EffectLimits, Limits

NOT_FOUND = "not found"
STATED = (
    "Detected: an effect of this strength would be found with a probability of 90 %; the answer then contains the effect and "
    "excludes “no gap”. Excluded: the true strength is larger than this value with a probability of at most 5 %, if the effect "
    "acts as the library describes it. The strength is the value of the parameter while the other parameters of the effect are 0."
)
DISTANCE = (
    "The distance of two effects, in sigma: the first effect acts with the strength that would be found, and the second effect is "
    "fitted to its change of the images. The distance is the square root of the remaining chi2. "
    f"Below {ALIKE:g} sigma the images cannot tell the two effects apart."
)


def limits_parts(found: Limits) -> list[Part]:
    """The section of a diagnosis: the limits of all effects, and the effects that are alike."""
    rows = [_row(name, one) for name, one in found.effects.items()]
    return [
        Table(["effect", "parameter", "detected (90 %)", "excluded (95 %)", "unit"], rows, STATED),
        *alike_parts(found),
    ]


def _row(name: str, one: EffectLimits) -> list[str]:
    leading = one.leading
    strength = NOT_FOUND if leading.found_90 is None else f"{leading.found_90:.3g}"
    excluded = "" if leading.excluded_95 is None else f"{leading.excluded_95:.3g}"
    return [words(name), words(leading.name), strength, excluded, leading.unit]


def alike_parts(found: Limits) -> list[Part]:
    """The pairs of effects that the data cannot tell apart, and the distances of all pairs."""
    if not found.alike:
        return [f"No two effects are closer than {ALIKE:g} sigma.", _matrix(found)]
    rows = [
        [f"{words(one.pair[0])} and {words(one.pair[1])}", f"{one.distance:.2f}", one.would_separate]
        for one in found.alike
    ]
    header = ["effects", "distance (sigma)", "an observation that would tell them apart"]
    return [Table(header, rows, DISTANCE), _matrix(found)]


def _matrix(found: Limits) -> Details:
    """A table of the distances of all pairs. The rows number the effects; the columns have the same numbers."""
    names, distances = list(found.effects), found.distances
    rows = []
    for k, name in enumerate(names):
        known = [distances.get((other, name)) for other in names[:k]]
        cells = ["" if distance is None else f"{distance:.1f}" for distance in known]
        rows.append([f"{k + 1} {words(name)}", *cells, *[""] * (len(names) - k)])
    header = ["effect", *(f"{k + 1}" for k in range(len(names)))]
    return Details("The distances of all pairs", [Table(header, rows, DISTANCE)])
