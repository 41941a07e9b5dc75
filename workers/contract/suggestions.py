"""Messages for a request with an unknown name: which names exist, and which name the client probably meant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from types import UnionType
from typing import Annotated, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from psfcore.errors import did_you_mean as did_you_mean

SHOWN = 60


def explained(errors: Iterable[ErrorDetails], model: object) -> Iterator[tuple[ErrorDetails, str]]:
    """Each validation error with its message. The message of an error about an unknown name lists the known names.

    Parameters
    ----------
    model
        The type that was validated. The locations of the errors are relative to it.
    """
    for error in errors:
        yield error, _message(error, model)


def _message(error: ErrorDetails, model: object) -> str:
    if error["type"] == "extra_forbidden":
        name, known = str(error["loc"][-1]), _fields(_at(model, error["loc"][:-1]))
        return f"there is no such field; expected one of {', '.join(known)}{did_you_mean(name, known)}"
    if error["type"] == "union_tag_invalid":
        tag, key = str(error["ctx"]["tag"]), str(error["ctx"]["discriminator"]).strip("'")
        tags = _tags(_at(model, error["loc"]), key)
        said = ascii(tag)[:SHOWN]
        return f"expected {key} to be one of {', '.join(tags)}; got {said}{did_you_mean(tag, tags)}"
    if error["type"] == "union_tag_not_found":
        key = str(error["ctx"]["discriminator"]).strip("'")
        return f"expected {key}, one of {', '.join(_tags(_at(model, error['loc']), key))}; got none"
    return error["msg"]


def _members(kind: object) -> list[type[BaseModel]]:
    """The models that a type allows."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return [kind]
    if get_origin(kind) in (Annotated, list):
        return _members(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType):
        return [model for one in get_args(kind) for model in _members(one)]
    return []


def _at(kind: object, location: Iterable[str | int]) -> object:
    """The type at a location. A location consists of field names, list indices, and the tags that select a member of a
    union.
    """
    for step in location:
        if isinstance(step, int):  # an index of a list
            continue
        members = _members(kind)
        field = next((m.model_fields[step] for m in members if step in m.model_fields), None)
        if field is not None:
            kind = field.annotation
        else:
            chosen = [m for m in members if any(step in _literals(m, name) for name in m.model_fields)]
            kind = chosen[0] if chosen else kind
    return kind


def _literals(model: type[BaseModel], name: str) -> tuple[object, ...]:
    kind = model.model_fields[name].annotation if name in model.model_fields else None
    return get_args(kind) if get_origin(kind) is Literal else ()


def _fields(kind: object) -> list[str]:
    return list(dict.fromkeys(name for model in _members(kind) for name in model.model_fields))


def _tags(kind: object, key: str) -> list[str]:
    return [str(tag) for model in _members(kind) for tag in _literals(model, key)]
