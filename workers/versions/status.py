"""The status of a PSF, its allowed changes, and version numbers. This module uses no database.

    draft ----------> certified ----------> deprecated
                      |      ^              |        ^
                      +------+              +--------+
                  another range         a successor named

A draft is used only by requests that name it. A certified PSF is used for images of its series if a request names no PSF:
it has a version of its own, and a range of times of observation that overlaps with no other certified PSF of its series.
A deprecated PSF stays available by name. Its successor cannot change once it is named.
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
    """Raise ``DataError`` "wrong-transition" if the status may not change in this way."""
    if after not in MAY_BECOME[before]:
        allowed = " or ".join(sorted(MAY_BECOME[before]))
        raise DataError("wrong-transition", f"expected status {allowed} for a {before} PSF; got {after}")


def next_version(released: Iterable[str]) -> str:
    """The version after the highest one given: its second number plus one; without any, FIRST_VERSION."""
    highest = max((_numbers(version) for version in released), default=None)
    return FIRST_VERSION if highest is None else f"{highest[0]}.{highest[1] + 1}.0"


def check_version(version: str | None, released: Iterable[str]) -> str:
    """Return the version if it is valid and not among the ``released`` versions of the series.

    Raises ``DataError`` "version-missing", "bad-version" or "version-taken"; the messages name a free version.
    """
    others = list(released)
    free = f"the next free version is {next_version(others)}"
    if version is None:
        raise DataError("version-missing", f"expected a version such as 1.2.0, got none; {free}")
    if not _VERSION.fullmatch(version):
        raise DataError(
            "bad-version",
            f"expected a version of three numbers such as 1.2.0, got {ascii(version)[:60]}; {free}",
        )
    if version in others:
        raise DataError(
            "version-taken", f"expected a version that is new in the series, got {version}; {free}"
        )
    return version


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in version.split("."))
