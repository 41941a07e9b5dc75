"""The parts of a gap report, schema gap/3, as they stand in its JSON."""

from __future__ import annotations

from typing import Any, NotRequired, TypedDict


class IntervalJson(TypedDict):
    """A value with its 90 % interval."""

    value: float
    ci90: list[float]


class NumberJson(TypedDict):
    """A fitted number with its standard error."""

    value: float
    sigma: float


class ParameterJson(NumberJson):
    """A fitted parameter."""

    unit: str


class AlternativeJson(TypedDict):
    """One alternative of a cause.

    Attributes
    ----------
    effect
        The name of the effect; None for another form of the family.
    """

    stage: str
    family: str
    effect: str | None
    probability: float
    words: str


class FieldJson(TypedDict):
    """The field of a family. It has a map: x_px, y_px, and value and sigma in rows of y; or a curve: first
    the abscissa by its name, then value and sigma.
    """

    words: str
    unit: str
    strength: NumberJson
    map: NotRequired[dict[str, list[float] | list[list[float]]]]
    curve: NotRequired[dict[str, list[float]]]


class CauseJson(TypedDict):
    """One cause of the answer."""

    level: str
    words: str
    alternatives: list[AlternativeJson]
    field: FieldJson | None
    closure: IntervalJson | None


class FitJson(TypedDict):
    """The fit of one or several effects."""

    name: str
    words: str
    probability: float
    parameters: dict[str, ParameterJson]
    p_value: float
    delta_chi2: float
    delta_chi2_held_out: float | None
    closure: IntervalJson | None
    closure_by_pointing: IntervalJson | None
    refitted: bool
    cause: str


class AxisJson(TypedDict):
    """The share of an axis in the gap."""

    axis: str
    share: float
    p_value: float
    at: dict[str, list[int] | list[float]]
    of_best: bool


class ParameterLimitsJson(TypedDict):
    """The limits of one parameter. Only data exclude a strength."""

    unit: str
    found_90: float | None
    excluded_95: NotRequired[float | None]


class EffectLimitsJson(ParameterLimitsJson):
    """The limits of the leading parameter of an effect, and of all parameters if there are several."""

    parameter: str
    parameters: NotRequired[dict[str, ParameterLimitsJson]]


class LimitsJson(TypedDict):
    """What the data could have shown."""

    limits: dict[str, EffectLimitsJson]
    alike: list[dict[str, object]]
    untestable: list[dict[str, str]]


class PointingJson(TypedDict):
    """A pointing of a plan: its number, its view (the part of the Sun), its images, and their exposure times, s."""

    pointing: int
    view: str
    images: int
    exposures_s: list[float]


class LabelJson(TypedDict):
    """A cause of a hypothesis.

    Attributes
    ----------
    effect
        The name of the effect; None for another form of the family.
    """

    family: str
    effect: str | None


class HypothesisJson(TypedDict):
    """A set of causes, with its probability."""

    causes: list[LabelJson]
    probability: float


class PsfJson(TypedDict):
    """The parameters of the PSF: refitted without the named effects, and with them. If the corrected PSF changes over
    the field: the gap in held-out images that were deconvolved with one kernel, and with its terms.
    """

    shape: str
    refitted: dict[str, ParameterJson]
    with_answer: dict[str, ParameterJson] | None
    held_out_with_terms: NotRequired[dict[str, object]]


class GapReport(TypedDict):
    """A gap report. An image is a row of numbers by their names; None for a number that could not be measured."""

    schema: str
    lines: list[str]
    sentence: str
    gap: dict[str, object]
    where: list[AxisJson]
    unocculted: dict[str, object]
    verdict: str
    answer: list[str]
    level: float
    causes: list[CauseJson]
    closure: IntervalJson | None
    would_separate: str
    would_confirm: str
    hypotheses: list[HypothesisJson]
    probabilities: dict[str, float]
    limits: dict[str, EffectLimitsJson]
    alike: list[dict[str, object]]
    calibration: dict[str, object]
    effects: list[FitJson]
    together: list[FitJson]
    untestable: list[dict[str, str]]
    cautions: list[str]
    expected: dict[str, float]
    psf: PsfJson
    shape: list[int]
    images: list[dict[str, Any]]
    inputs_sha256: dict[str, str]
    provenance: NotRequired[dict[str, object]]
