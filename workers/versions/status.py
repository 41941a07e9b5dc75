"""The status of a PSF, its allowed changes, and version numbers. This module does not use the database.

    draft ----------> certified ----------> deprecated
                      |      ^              |        ^
                      +------+              +--------+
                  another range         a successor named

If a request names no PSF, the certified PSF of the image's series is used; if the series has none, the PSF that is
built from the shipped instrument file. Every other draft is used only by requests that name it. A certified PSF has a
version that no other PSF of its series has. Its range of observation times does not overlap with the range of any other
certified PSF of its series. The service never chooses a deprecated PSF by itself; a request can still name one, and a
context can still pin one. Once the successor of a deprecated PSF is named, it cannot change.
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
    """The trust in a PSF."""

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
    """The next free version: the highest of the ``released`` versions, with its second number increased by 1.

    FIRST_VERSION if no version was released.
    """
    # An interpolated PSF is deprecated together with its ends; its version is not one of three numbers.
    certified = (version for version in released if _VERSION.fullmatch(version))
    highest = max((_numbers(version) for version in certified), default=None)
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
