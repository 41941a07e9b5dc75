"""How a command names a field of a request. `service.cli.fields` makes the option from this and from the field itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Option:
    """The option of a field, as metadata of its annotation.

    name: such as "--saturation"; None: the name of the field. metavar: the placeholder of the value. check: raises DataError
    for a text that is no value.
    """

    name: str | None = None
    metavar: str | None = None
    check: Callable[[str], object] | None = None
