"""Errors in the user's data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class DataError(ValueError):
    """The user's data cannot be used.

    code: a stable word in kebab-case for programs, such as "all-nan". message: a sentence for people; it says what was
    expected and what was found. fields: further facts for programs, as JSON values.
    """

    def __init__(self, code: str, message: str, fields: Mapping[str, Any] | None = None) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message
        self.fields = dict(fields or {})

    def __reduce__(self) -> tuple[type[DataError], tuple[str, str, dict[str, Any]]]:
        return type(self), (self.code, self.message, self.fields)


class HeaderError(DataError):
    """The headers of a file show that the file cannot be used. No pixel was read."""
