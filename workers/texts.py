"""Texts that people choose for others to read: names, labels, reasons, names of files.

A mark that reverses the direction of writing, or a control character, makes a text look like another one. So what
``str.isprintable`` does not accept is refused, and dropped from names that no person typed, as those of files and
headers.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field


def printable(text: str) -> str:
    """The printable characters of a text."""
    return "".join(filter(str.isprintable, text))


def check_line(text: str) -> str:
    """The text. Raises ValueError if it is no line of printable characters."""
    if not text.isprintable():
        raise ValueError(
            "expected printable characters on one line, without marks of the direction of writing; got "
            f"{text[:80]!a}: remove the characters that are shown with a backslash"
        )
    return text


def _check_lines(text: str) -> str:
    for line in text.replace("\t", "\n").split("\n"):
        check_line(line)
    return text


# The patterns are those of the description of the interface. They refuse the control characters of ASCII alone, because
# programs that read the description know no class of all characters that cannot be printed.
Line = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]*$"), AfterValidator(check_line)]
Name = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]+$"), AfterValidator(check_line)]
Lines = Annotated[str, Field(pattern=r"^[^\x00-\x08\x0b-\x1f\x7f]*$"), AfterValidator(_check_lines)]
