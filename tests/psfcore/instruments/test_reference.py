"""docs/instruments.md lists every key of an instrument file, with its default and limits, and no other key."""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from psfcore.instruments.model import Instrument, parse_instrument

REFERENCE = (Path(__file__).parents[3] / "docs" / "instruments.md").read_text("utf-8")
# How the reference writes defaults that are not numbers.
UNSET = {"": "none", "detector.gain_modes.MODE.": "unknown"}


def documented() -> dict[str, dict[str, str]]:
    """The rows of the reference's tables by key; cells by the name of their column."""
    rows: dict[str, dict[str, str]] = {}
    for line in REFERENCE.splitlines():
        if not line.startswith("| `"):
            continue
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        names = ("key", "type", "unit", "default", "limits", "meaning")
        row = dict(zip(names, cells, strict=True))
        key = row["key"].strip("` ")
        assert key not in rows, f"{key} is documented twice"
        rows[key] = row
    return rows


class Key(NamedTuple):
    """What the model says of a key."""

    annotation: Any
    default: Any  # MISSING: the key is required


def inner(annotation: Any) -> Any:
    """The annotation without its limits and without None."""
    if typing.get_origin(annotation) is Annotated:
        return inner(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        return inner(next(one for one in typing.get_args(annotation) if one is not types.NoneType))
    return annotation


def models(annotation: Any) -> Iterator[tuple[str, Any]]:
    """The models inside an annotation, with how a key below them is written."""
    annotation = inner(annotation)
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if is_dataclass(annotation):
        yield ".", annotation
    elif origin is tuple and is_dataclass(arguments[0]):
        yield "[].", arguments[0]
    elif origin is dict and is_dataclass(arguments[1]):
        yield ".MODE.", arguments[1]


def accepted(model: Any = Instrument, before: str = "") -> Iterator[tuple[str, Key]]:
    """Every key that the model accepts, as the reference writes it."""
    annotations = typing.get_type_hints(model, include_extras=True)
    for field in fields(model):
        key, annotation = before + field.name, annotations[field.name]
        default = field.default if field.default_factory is MISSING else field.default_factory()
        yield key, Key(annotation, default)
        for join, below in models(annotation):
            yield from accepted(below, key + join)


KEYS = dict(accepted())


def test_the_reference_lists_every_key_and_no_other_with_its_default() -> None:
    assert set(documented()) - {"match.KEYWORD"} == set(KEYS)
    assert len(KEYS) > 60
    for key, field in KEYS.items():
        stated = documented()[key]["default"]
        if field.default is MISSING:
            assert stated == "required", key
        elif field.default is None:
            assert stated in UNSET.values(), key
        elif field.default in ((), {}):
            assert stated == "empty", key
        else:
            assert stated.strip("`") == f"{field.default}".removesuffix(".0"), key


def test_the_example_is_a_complete_instrument_file() -> None:
    (example,) = re.findall(r"```toml\n(.*?)```", REFERENCE, flags=re.DOTALL)
    instrument = parse_instrument(example, "docs/instruments.md")
    assert instrument.name == "small_telescope"
    assert instrument.scatter is not None and instrument.mount is not None
    assert instrument.mesh_distance_mm(instrument.meshes[0]) == instrument.focal_length_mm
