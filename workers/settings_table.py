"""Writes the table of all settings: ``python -m workers.settings_table docs/settings.md``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic.fields import FieldInfo

from workers.settings import Settings

PREFIX = "HELIOPSF_"
_BOUNDS = {Ge: ("≥", "ge"), Gt: (">", "gt"), Le: ("≤", "le"), Lt: ("<", "lt")}
_INTRODUCTION = """# Settings

Each setting is an environment variable. All settings are optional: without them, `heliopsf serve` keeps all data in
one folder of the user and needs no other server. Set the same variables for servers, workers and operator commands.
Scientific choices are never settings; they are parameters of a job.

This page is generated from the class `workers.settings.Settings` by `make settings`; a test compares the two.

| variable | type | default | meaning |
|---|---|---|---|
"""
_CLIENT = """
Commands and the Python client read two more variables:

| variable | meaning |
|---|---|
| `HELIOPSF_SERVER` | Address of the service, for example `http://127.0.0.1:8765`. |
| `HELIOPSF_KEY` | Access key that the commands and the Python client send. |

Commands with `--local` and the Python functions keep built PSFs in a cache, which `heliopsf cache` lists and clears:

| variable | meaning |
|---|---|
| `HELIOPSF_CACHE_DIR` | Folder of the cache; default: the user's cache folder, on Linux `~/.cache/heliopsf`. \
Compiled kernels are kept in it, if they cannot be kept beside the package or in `NUMBA_CACHE_DIR`. |
| `HELIOPSF_CACHE_MIB` | Largest size of the cache, MiB; default: 2048; 0: PSFs are not kept. |
"""


def settings_table() -> str:
    """The page as Markdown."""
    rows = (_row(name, field) for name, field in Settings.model_fields.items())
    return _INTRODUCTION + "\n".join(rows) + "\n" + _CLIENT


def _row(name: str, field: FieldInfo) -> str:
    cells = (f"`{PREFIX}{name.upper()}`", _type(field), _default(field), field.description or "")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _type(field: FieldInfo) -> str:
    annotation = field.annotation
    choices = [one for one in (get_args(annotation) or (annotation,)) if one is not NoneType]
    name = (
        " or ".join(_name(one) for one in choices)
        if get_origin(annotation) is not Literal
        else _name(annotation)
    )
    bounds = [
        f"{sign} {getattr(one, attribute):,}"
        for one in field.metadata
        for kind, (sign, attribute) in _BOUNDS.items()
        if isinstance(one, kind)
    ]
    return f"{name}, {', '.join(bounds)}" if bounds else name


def _name(annotation: Any) -> str:
    if get_origin(annotation) is Literal:
        return " or ".join(f"`{one}`" for one in get_args(annotation))
    if annotation is bool:
        return "`true` or `false`"
    return {"str": "text", "int": "integer", "float": "number", "Path": "path"}[annotation.__name__]


def _default(field: FieldInfo) -> str:
    if field.default_factory is not None:
        return "see the meaning"  # the value depends on the user or the machine
    value = field.default
    told = str(value).lower() if isinstance(value, bool) else value
    return "not set" if value is None or value == "" else f"`{told}`"


def main(arguments: Sequence[str]) -> None:
    """Write the page to the file whose path is the first argument."""
    (target,) = arguments
    Path(target).write_text(settings_table(), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
