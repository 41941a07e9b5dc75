"""Errors in the user's data."""

from __future__ import annotations


class DataError(ValueError):
    """The user's data cannot be used.

    code: a stable word in kebab-case for programs, such as "all-nan". message: a sentence for people; it says what was
    expected and what was found.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message

    def __reduce__(self) -> tuple[type[DataError], tuple[str, str]]:
        return type(self), (self.code, self.message)


class HeaderError(DataError):
    """The headers of a file show that the file cannot be used. No pixel was read."""
