"""What a PSF may become, and how its versions are numbered; nothing here knows of a database.

    draft ----------> certified ----------> deprecated
                      |      ^              |        ^
                      +------+              +--------+
                  another range         a successor named

A draft may be used by whoever names it. A certified PSF is what images of its series get where none is named: it has a
version of its own, and a range of times of observation that no other certified PSF of its series shares. A deprecated one
stays for those who ask for it; its successor, once named, stays.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import StrEnum

from psfcore.errors import DataError

FIRST_VERSION = "1.0.0"
VERSION = r"^(0|[1-9]\d{0,5})\.(0|[1-9]\d{0,5})\.(0|[1-9]\d{0,5})$"
_VERSION = re.compile(VERSION, re.ASCII)


class PsfStatus(StrEnum):
    """How far a PSF may be trusted."""

    DRAFT = "draft"
    CERTIFIED = "certified"
    DEPRECATED = "deprecated"


MAY_BECOME = {
    PsfStatus.DRAFT: frozenset({PsfStatus.CERTIFIED}),
    PsfStatus.CERTIFIED: frozenset({PsfStatus.CERTIFIED, PsfStatus.DEPRECATED}),
    PsfStatus.DEPRECATED: frozenset({PsfStatus.DEPRECATED}),
}


def check_transition(before: PsfStatus, after: PsfStatus) -> None:
    """Raises ``DataError`` "wrong-transition" where a PSF may not go from one to the other."""
    if after not in MAY_BECOME[before]:
        allowed = " or ".join(sorted(MAY_BECOME[before]))
        raise DataError("wrong-transition", f"a {before} PSF may become {allowed}; got {after}")


def next_version(released: Iterable[str]) -> str:
    """The version after the highest of those given: its second number one higher, or the first version of all."""
    highest = max((_numbers(version) for version in released), default=None)
    return FIRST_VERSION if highest is None else f"{highest[0]}.{highest[1] + 1}.0"


def check_version(version: str | None, released: Iterable[str]) -> str:
    """The version, where it may be given to a PSF of a series whose others are ``released``.

    Raises ``DataError`` "version-missing", "bad-version" or "version-taken", which say which could be given.
    """
    others = list(released)
    free = f"the next one free is {next_version(others)}"
    if version is None:
        raise DataError("version-missing", f"expected a version as 1.2.0, got none; {free}")
    if not _VERSION.fullmatch(version):
        raise DataError(
            "bad-version", f"expected a version as 1.2.0 (three numbers), got {ascii(version)[:60]}; {free}"
        )
    if version in others:
        raise DataError(
            "version-taken", f"expected a version that the series has not had, got {version}; {free}"
        )
    return version


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in version.split("."))
