"""What can be wrong with the data a user brings."""

from __future__ import annotations


class DataError(ValueError):
    """The user's data cannot be used as it is.

    `code` is stable kebab-case for programs ("all-nan"); `message` is for people and says what was
    expected and what was found.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message

    def __reduce__(self) -> tuple[type[DataError], tuple[str, str]]:
        return type(self), (self.code, self.message)


class HeaderError(DataError):
    """A file is refused for what its headers show; no pixel was read."""
