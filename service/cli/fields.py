"""Options of commands, made from the fields of the requests: name, type, limits, default and help text.

A command names the fields that it offers and passes their values on as they are. A new field therefore needs no further
declaration: `workers.contract.requests` describes it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import annotated_types
import click
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from psfcore.errors import DataError
from psfcore.noise import NoiseFigures
from workers.contract.requests import METHOD_MODELS, METHODS, Option, RichardsonLucy

Command = TypeVar("Command", bound=Callable[..., Any])
_NULL = re.compile(r"; null: (.*?)(?=\. |$)")
_QUOTED = re.compile(r"`([^`]*)`")
_FALSE = re.compile(r"; false: .*$")


def options_of(model: type[BaseModel], *names: str) -> Callable[[Command], Command]:
    """The options of these fields of a request. "method", "steps" and other parameters of a method are known too.

    A command gets the values by the names of the fields. None: not given, so that the service uses its default.
    """

    def with_options(command: Command) -> Command:
        for name in reversed(names):
            command = _option(model, name)(command)
        return command

    return with_options


def methods_help() -> str:
    """When to use which method, for the end of a help text."""
    rows = (
        f"  {name:<33}{(model.__doc__ or '').split('. ')[0].rstrip('.')}"
        for name, model in zip(METHODS, METHOD_MODELS, strict=True)
    )
    return "\b\nMethods:\n" + "\n".join(rows)


def _field(model: type[BaseModel], name: str) -> FieldInfo:
    return model.model_fields.get(name) or RichardsonLucy.model_fields[name]


def _option(model: type[BaseModel], name: str) -> Callable[[Command], Command]:
    if name == "method":
        return click.option(
            "--method",
            type=click.Choice(METHODS),
            metavar="NAME",
            default=METHODS[0],
            help="Method; `heliopsf deconvolve -h` says which for what",
        )
    field = _field(model, name)
    kind, about, text = _kind(field), _about(field), _help(model, field)
    names = (_name(model, name), name)
    if kind is bool:
        switch = f"{names[0]}/--no-{names[0][2:]}" if field.default else names[0]
        return click.option(
            switch, name, is_flag=True, default=bool(field.default), show_default=False, help=text
        )
    if kind is NoiseFigures:
        return click.option("--noise", nargs=2, type=float, metavar="GAIN READ", help=text)
    # The default of a parameter of a method depends on the method.
    default = None if name in RichardsonLucy.model_fields else field.default
    return click.option(
        *names,
        type=_type(kind, field),
        metavar=about.metavar,
        default=default,
        show_default=bool(default),
        callback=None if about.check is None else _checked_by(about.check),
        help=text,
    )


def _about(field: FieldInfo) -> Option:
    return next((one for one in field.metadata if isinstance(one, Option)), Option())


def _name(model: type[BaseModel], name: str) -> str:
    """The name of the option of a field."""
    return _about(_field(model, name)).name or f"--{name.replace('_', '-')}"


def _kind(field: FieldInfo) -> Any:
    """The type of a value that is given."""
    kind = field.annotation
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (one for one in get_args(kind) if one is not NoneType)
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _type(kind: Any, field: FieldInfo) -> click.ParamType:
    if get_origin(kind) is Literal:
        return click.Choice([str(one) for one in get_args(kind)])
    if kind not in (int, float):
        return click.STRING
    limits: dict[str, Any] = {}
    for one in field.metadata:
        match one:
            case annotated_types.Ge():
                limits["min"] = one.ge
            case annotated_types.Gt():
                limits |= {"min": one.gt, "min_open": True}
            case annotated_types.Le():
                limits["max"] = one.le
            case annotated_types.Lt():
                limits |= {"max": one.lt, "max_open": True}
    return click.IntRange(**limits) if kind is int else click.FloatRange(**limits)


def _checked_by(check: Callable[[str], object]) -> Callable[..., str | None]:
    def checked(context: click.Context, parameter: click.Parameter, text: str | None) -> str | None:
        if text is not None:
            try:
                check(text)
            except DataError as error:
                raise click.BadParameter(error.message, context, parameter) from error
        return text

    return checked


def _help(model: type[BaseModel], field: FieldInfo) -> str:
    """The description of the field with the names of options; what null means is the default."""
    fields = model.model_fields.keys() | RichardsonLucy.model_fields.keys()
    text = _FALSE.sub("", field.description or "")
    begins_with_value = text.startswith("`")
    text = _QUOTED.sub(lambda word: _name(model, word[1]) if word[1] in fields else word[1], text)
    default = _NULL.search(text)
    if default is not None:
        text = f"{_NULL.sub('', text, count=1)} [default: {default[1]}]"
    return text if begins_with_value else text[:1].upper() + text[1:]
