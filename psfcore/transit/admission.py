"""The rules for accepting the members of an archive: their names, their number, their sizes.

The rules are the same for a .zip and a .tar. This module imports no numerical library, so that the web process can apply
the rules.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from psfcore.errors import DataError
from psfcore.transit.manifest import is_plain_name

RATIO_FLOOR_BYTES = 64 * 2**20  # an archive may always unpack to this number of bytes, whatever its ratio
_HIDDEN = ("__MACOSX", "PaxHeader", "PaxHeaders", "Thumbs.db", "desktop.ini")


@dataclass(frozen=True)
class ArchiveLimits:
    """Bounds on what an archive may contain.

    max_files: members of any kind, including hidden files. max_bytes: unpacked bytes of all members.
    max_member_bytes: unpacked bytes of one member. max_ratio: unpacked bytes divided by the bytes of the archive. This
    bound applies only above RATIO_FLOOR_BYTES.
    """

    max_files: int = 16_384
    max_bytes: int = 8 * 2**30
    max_ratio: float = 200.0
    max_member_bytes: int = 2**30

    def budget_bytes(self, archive_bytes: int) -> int:
        """The most bytes that an archive of this size may unpack to."""
        return min(self.max_bytes, max(RATIO_FLOOR_BYTES, int(self.max_ratio * archive_bytes)))


class Gate:
    """Checks every member of one archive: its name, its number, its size, and the bytes unpacked so far."""

    def __init__(self, limits: ArchiveLimits, archive_bytes: int) -> None:
        self.limits = limits
        self._budget = limits.budget_bytes(archive_bytes)
        self._declared = self._unpacked = self._members = 0
        self._top: str | None = None
        self._names: set[str] = set()

    def count_members(self, count: int = 1) -> None:
        """Add members of any kind to the count. Raises DataError "archive-too-large"."""
        self._members += count
        if self._members > self.limits.max_files:
            message = f"expected at most {self.limits.max_files} members; got more"
            raise DataError("archive-too-large", message)

    def count_unpacked(self, count: int) -> None:
        """Add unpacked bytes to the count. Raises DataError "archive-too-large"."""
        self._unpacked += count
        self._check(self._unpacked)

    def admit(self, raw_name: str, size: int) -> str | None:
        """Check a file; return its plain name, or None if the file is hidden and must be skipped.

        Raises DataError "archive-climbs", "archive-not-plain", "archive-too-large".
        """
        parts = _parts(raw_name)
        if not parts:
            raise not_plain(raw_name, "expected the name of a file")
        if _is_hidden(parts):
            return None
        if len(parts) > 2:
            raise not_plain(raw_name, "expected files at the top level or in one folder")
        top = parts[0] if len(parts) == 2 else ""
        if self._top is not None and top != self._top:
            raise not_plain(raw_name, "expected all files in the same folder")
        self._top = top
        name = parts[-1]
        if not is_plain_name(name):
            raise not_plain(raw_name, "expected a plain file name")
        if name in self._names:
            raise not_plain(raw_name, "expected each file name only once")
        self._names.add(name)
        if size > self.limits.max_member_bytes:
            most = self.limits.max_member_bytes
            message = f"{shown(raw_name)}: expected at most {most} bytes; got {size}"
            raise DataError("archive-too-large", message)
        self._declared += size
        self._check(self._declared)
        return name

    def check_folder(self, raw_name: str) -> None:
        """Check the entry of a folder; the folder is not created. Raises DataError "archive-climbs", "archive-not-plain"."""
        parts = _parts(raw_name)
        if len(parts) > 1 and not _is_hidden(parts):
            raise not_plain(raw_name, "expected files at the top level or in one folder")

    def _check(self, count: int) -> None:
        if count > self._budget:
            message = f"expected an archive that unpacks to at most {self._budget} bytes; got more"
            raise DataError("archive-too-large", message)


def not_plain(raw_name: str, message: str) -> DataError:
    """The error for a member that is not a plain file with a plain name."""
    return DataError("archive-not-plain", f"{message}; got {shown(raw_name)}")


def shown(raw_name: str) -> str:
    """A member's name for a message: in ASCII, at most 80 characters of the name."""
    return ascii(raw_name[:80])


def _parts(raw_name: str) -> list[str]:
    """The folders and the file of a member's name. Raises DataError "archive-climbs"."""
    parts = [part for part in raw_name.split("/") if part not in ("", ".")]
    climbs = raw_name.startswith("/") or "\\" in raw_name or ".." in parts
    if climbs or any(re.match(r"[A-Za-z]:", part) for part in parts):
        message = f"expected names inside the archive's own folder; got {shown(raw_name)}"
        raise DataError("archive-climbs", message)
    return parts


def _is_hidden(parts: list[str]) -> bool:
    return any(part.startswith(".") or part.split(".")[0] in _HIDDEN or part in _HIDDEN for part in parts)
