"""Immutable classes for the content of files that people write by hand. An object checks its values when it is made.

A subclass of `Checked` lists its keys like a dataclass. The annotation of a key says which values the key accepts:

| annotation | value |
|---|---|
| float, int | a number (not true or false); a float must be finite |
| str, Literal | a text, one of the listed texts |
| tuple[X, ...], tuple[X, X] | a list |
| dict[str, X] | a table with keys of any name |
| dict[Literal[...], X] | a table with some of the listed keys |
| X, a subclass of `Checked` | a table with the keys of X |
| X | None | the same as X; the value is None if the key is left out |
| X | Y, a text and a number | a text as X accepts it, or a number as Y accepts it |
| Annotated[X, Limit(...)] | the same as X, within limits |

The module needs only the standard library, so that the core installs few packages.
"""

from __future__ import annotations

import math
import re
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields
from decimal import Decimal
from functools import cache
from typing import Any, Literal, NamedTuple, Self, dataclass_transform


@dataclass(frozen=True)
class Limit:
    """Limits of a number (gt, ge, le, lt); limits of the number of entries or characters; a pattern for the whole
    text."""

    gt: float | None = None
    ge: float | None = None
    le: float | None = None
    lt: float | None = None
    min_length: int | None = None
    max_length: int | None = None
    pattern: str | None = None


class Fault(NamedTuple):
    """A value that is not accepted: its position in the file, such as ("meshes", 0, "wire_um"), the expected value, and
    the given value."""

    key: tuple[str | int, ...]
    expected: str
    got: Any


class BadValues(ValueError):
    """Values that are not accepted: in each table unknown keys first, then the others in the order of the keys of the class."""

    def __init__(self, faults: list[Fault]) -> None:
        super().__init__("; ".join(f"{'.'.join(map(str, fault.key))}: {fault.expected}" for fault in faults))
        self.faults = faults


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Checked:
    """Base of classes whose values are checked. Subclasses become frozen dataclasses with keyword arguments."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    def __post_init__(self) -> None:
        """Check and convert all values. Raises BadValues."""
        faults: list[Fault] = []
        for name, annotation in annotations_of(type(self)).items():
            try:
                value = _accepted(annotation, getattr(self, name), (name,))
            except BadValues as error:
                faults += error.faults
            else:
                object.__setattr__(self, name, value)
        if faults:
            raise BadValues(faults)
        together = self.check()
        if together is not None:
            raise BadValues([Fault((), together, None)])

    def check(self) -> str | None:
        """Check values together after each of them was accepted. Returns None, or a sentence with expected and given
        values.

        May raise BadValues instead, to name the keys.
        """
        return None

    @classmethod
    def read(cls, table: Mapping[str, Any]) -> Self:
        """An object from the keys and values of a table. Raises BadValues, also for unknown and missing keys."""
        annotations = annotations_of(cls)
        # Unknown keys come first: a misspelt key is often the reason why another key is missing.
        faults = [
            Fault((name,), f"expected one of the keys {', '.join(annotations)}", table[name])
            for name in table
            if name not in annotations
        ]
        values: dict[str, Any] = {}
        required = {field.name for field in fields(cls) if _is_required(field)}  # type: ignore[arg-type]
        for name, annotation in annotations.items():
            if name in table:
                try:
                    values[name] = _accepted(annotation, table[name], (name,))
                except BadValues as error:
                    faults += error.faults
            elif name in required:
                faults.append(Fault((name,), "expected this key", None))
        if faults:
            raise BadValues(faults)
        return cls(**values)


def _is_required(field: Any) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


@cache
def _annotations_of(cls: Any) -> dict[str, Any]:
    return typing.get_type_hints(cls, include_extras=True)


def annotations_of(cls: type[Checked]) -> dict[str, Any]:
    """The type annotations of a class, by key. They include the limits of the values."""
    known: Any = cls  # for mypy, the classes of a dataclass_transform are not hashable
    return _annotations_of(known)


def _accepted(annotation: Any, value: Any, key: tuple[str | int, ...]) -> Any:
    """Check a value against its type annotation, and convert it to this type. Raises BadValues."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        for limit in arguments[1:]:
            _check_length(limit, value, key)
        accepted = _accepted(arguments[0], value, key)
        for limit in arguments[1:]:
            _check_limit(limit, accepted, key)
        return accepted
    if origin in (types.UnionType, typing.Union):
        if value is None and types.NoneType in arguments:
            return None
        return _accepted(_fitting(arguments, value, key), value, key)
    if origin is Literal:
        if value not in arguments:
            _refuse(key, f"expected one of {', '.join(map(repr, arguments))}", value)
        return value
    if origin is tuple:
        return _tuple(arguments, value, key)
    if origin is dict:
        return _dict(arguments, value, key)
    if isinstance(annotation, type) and issubclass(annotation, Checked):
        return _table(annotation, value, key)
    return _plain(annotation, value, key)


def _fitting(arguments: tuple[Any, ...], value: Any, key: tuple[str | int, ...]) -> Any:
    """The member of a union that fits the type of the value.

    Raises BadValues if the value is neither text nor number.
    """
    inner = [argument for argument in arguments if argument is not types.NoneType]
    if len(inner) == 1:
        return inner[0]
    text, number = sorted(inner, key=lambda one: _without_limits(one) is not str)
    assert _without_limits(text) is str and _without_limits(number) in (int, float), inner
    if isinstance(value, str):
        return text
    if isinstance(value, bool) or not isinstance(value, int | float):
        _refuse(key, "expected a text or a number", value)
    return number


def _without_limits(annotation: Any) -> Any:
    return typing.get_args(annotation)[0] if typing.get_origin(annotation) is typing.Annotated else annotation


def _plain(annotation: Any, value: Any, key: tuple[str | int, ...]) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if annotation is float:
        if not number or not math.isfinite(value):
            _refuse(key, "expected a finite number", value)
        return float(value)
    if annotation is int:
        if not number or not math.isfinite(value) or value != int(value):
            _refuse(key, "expected a whole number", value)
        return int(value)
    assert annotation is str, annotation
    if not isinstance(value, str):
        _refuse(key, "expected a text", value)
    return value


def _tuple(arguments: tuple[Any, ...], value: Any, key: tuple[str | int, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        _refuse(key, "expected a list", value)
    if arguments[-1] is not Ellipsis and len(value) != len(arguments):
        _refuse(key, f"expected {len(arguments)} entries", value)
    each = arguments if arguments[-1] is not Ellipsis else (arguments[0],) * len(value)
    return tuple(
        _collect((one, entry, (*key, n)) for n, (one, entry) in enumerate(zip(each, value, strict=True)))
    )


def _dict(arguments: tuple[Any, ...], value: Any, key: tuple[str | int, ...]) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        _refuse(key, "expected a table", value)
    names = _collect((arguments[0], name, (*key, name)) for name in value)
    return dict(
        zip(names, _collect((arguments[1], one, (*key, name)) for name, one in value.items()), strict=True)
    )


def _table(cls: type[Checked], value: Any, key: tuple[str | int, ...]) -> Checked:
    if isinstance(value, cls):
        return value
    if not isinstance(value, Mapping):
        _refuse(key, "expected a table", value)
    try:
        return cls.read(value)
    except BadValues as error:
        # If a fault has no key, it concerns the whole table.
        told = [Fault((*key, *one.key), one.expected, one.got if one.key else value) for one in error.faults]
        raise BadValues(told) from None


def _collect(parts: Iterator[tuple[Any, Any, tuple[str | int, ...]]]) -> list[Any]:
    accepted, faults = [], []
    for annotation, value, key in parts:
        try:
            accepted.append(_accepted(annotation, value, key))
        except BadValues as error:
            faults += error.faults
    if faults:
        raise BadValues(faults)
    return accepted


def _check_length(limit: Limit, value: Any, key: tuple[str | int, ...]) -> None:
    """Check the length before the entries are checked, so that a very long list costs no time."""
    if not isinstance(value, str | list | tuple | Mapping):
        return
    parts = "characters" if isinstance(value, str) else "entries"
    if limit.min_length is not None and len(value) < limit.min_length:
        _refuse(key, f"expected at least {limit.min_length} {parts}", value)
    if limit.max_length is not None and len(value) > limit.max_length:
        _refuse(key, f"expected at most {limit.max_length} {parts}", value)


def _check_limit(limit: Limit, value: Any, key: tuple[str | int, ...]) -> None:
    if limit.pattern is not None and re.fullmatch(limit.pattern, value) is None:
        _refuse(key, f"expected a text of the form {limit.pattern}", value)
    for said, bound, kept in (
        ("above", limit.gt, lambda bound: value > bound),
        ("of at least", limit.ge, lambda bound: value >= bound),
        ("of at most", limit.le, lambda bound: value <= bound),
        ("below", limit.lt, lambda bound: value < bound),
    ):
        if bound is not None and not kept(bound):
            _refuse(key, f"expected a number {said} {Decimal(repr(bound)):f}", value)


def _refuse(key: tuple[str | int, ...], expected: str, got: Any) -> typing.NoReturn:
    raise BadValues([Fault(key, expected, got)])
