"""Classes that check their values: what is accepted, what is converted, and what the error says."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, field, replace
from typing import Annotated, Any, Literal

import pytest

from psfcore.instruments.checked import BadValues, Checked, Limit


class Part(Checked):
    """A part with a length and a width."""

    length: Annotated[float, Limit(gt=0)]
    width: float = 1.0

    def check(self) -> str | None:
        """The part is longer than wide."""
        return None if self.length > self.width else f"expected length above width; got {self.length}"


class Whole(Checked):
    """A table with one key of each type."""

    name: Annotated[str, Limit(pattern=r"[a-z]+$", max_length=5)]
    count: Annotated[int, Limit(ge=1, le=9)] = 1
    kind: Literal["round", "square"] = "round"
    parts: Annotated[tuple[Part, ...], Limit(max_length=2)] = ()
    corner: tuple[float, float] | None = None
    modes: dict[str, Part] = field(default_factory=dict)
    match: dict[
        Literal["NAME", "SIZE"], Annotated[str, Limit(max_length=3)] | Annotated[float, Limit(gt=0)]
    ] = field(default_factory=dict)


def faults(**table: Any) -> list[tuple[str, str]]:
    with pytest.raises(BadValues) as caught:
        Whole.read({"name": "ab", **table})
    return [(".".join(map(str, fault.key)), fault.expected) for fault in caught.value.faults]


def test_values_are_converted_to_their_types() -> None:
    whole = Whole.read(
        {
            "name": "ab",
            "count": 2.0,
            "parts": [{"length": 2}],
            "corner": [1, 2],
            "modes": {"A": {"length": 3.0}},
        }
    )
    assert whole == Whole(
        name="ab", count=2, parts=(Part(length=2.0),), corner=(1.0, 2.0), modes={"A": Part(length=3.0)}
    )
    either = Whole.read({"name": "ab", "match": {"NAME": "abc", "SIZE": 2}}).match
    assert either == {"NAME": "abc", "SIZE": 2.0} and type(either["SIZE"]) is float
    assert type(whole.count) is int and type(whole.parts[0].length) is float
    assert Whole(name="ab").modes == {} and Whole(name="ab").corner is None


FAULTS = [
    ({"name": "ab\n"}, "name", "expected a text of the form"),
    ({"name": "abcdef"}, "name", "expected at most 5 characters"),
    ({"name": 3}, "name", "expected a text"),
    ({"count": 0}, "count", "expected a number of at least 1"),
    ({"count": 10}, "count", "expected a number of at most 9"),
    ({"count": 1.5}, "count", "expected a whole number"),
    ({"count": True}, "count", "expected a whole number"),
    ({"count": float("inf")}, "count", "expected a whole number"),
    ({"kind": "flat"}, "kind", "expected one of 'round', 'square'"),
    ({"parts": {"length": 1}}, "parts", "expected a list"),
    ({"parts": [{"length": 2}] * 3}, "parts", "expected at most 2 entries"),
    ({"parts": [2]}, "parts.0", "expected a table"),
    ({"parts": [{"length": "2"}]}, "parts.0.length", "expected a finite number"),
    ({"parts": [{"length": float("nan")}]}, "parts.0.length", "expected a finite number"),
    ({"parts": [{"length": 0}]}, "parts.0.length", "expected a number above 0"),
    ({"parts": [{"length": 0.5}]}, "parts.0", "expected length above width; got 0.5"),
    ({"parts": [{}]}, "parts.0.length", "expected this key"),
    ({"corner": [1]}, "corner", "expected 2 entries"),
    ({"modes": {"A": {"depth": 1, "length": 2}}}, "modes.A.depth", "expected one of the keys length, width"),
    ({"modes": [1]}, "modes", "expected a table"),
    ({"match": {"COLOUR": "red"}}, "match.COLOUR", "expected one of 'NAME', 'SIZE'"),
    ({"match": {"NAME": "abcd"}}, "match.NAME", "expected at most 3 characters"),
    ({"match": {"SIZE": 0}}, "match.SIZE", "expected a number above 0"),
    ({"match": {"SIZE": float("inf")}}, "match.SIZE", "expected a finite number"),
    ({"match": {"SIZE": True}}, "match.SIZE", "expected a text or a number"),
    ({"match": {"SIZE": [1]}}, "match.SIZE", "expected a text or a number"),
]


def test_the_fault_names_the_key_and_what_was_expected() -> None:
    for values, key, expected in FAULTS:
        ((found, said),) = faults(**values)
        assert found == key and said.startswith(expected), values


def test_all_faults_are_told_unknown_keys_first_then_in_the_order_of_the_keys() -> None:
    assert [key for key, _ in faults(other=1, kind="flat", count=0)] == ["other", "count", "kind"]
    # A misspelt key is told before the key that is missing.
    assert [key for key, _ in faults(parts=[{"lenght": 1.0}])] == ["parts.0.lenght", "parts.0.length"]


def test_objects_do_not_change_and_a_changed_copy_is_checked() -> None:
    part = Part(length=2.0)
    with pytest.raises(FrozenInstanceError):
        part.length = 3.0  # type: ignore[misc]
    assert replace(part, width=1.5).width == 1.5
    with pytest.raises(BadValues, match="above width"):
        replace(part, width=2.5)
