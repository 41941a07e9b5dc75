"""The rules for accepting the members of an archive: their names, their number, their sizes.

The rules are the same for a .zip and a .tar. This module imports no other library: a process that reads an archive is
short.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from psfcore.errors import DataError

MANIFEST_NAME = "transit.json"
MAX_MANIFEST_BYTES = 4 * 2**20
RATIO_FLOOR_BYTES = 64 * 2**20  # up to this number of unpacked bytes, max_ratio is not checked
_HIDDEN = ("__MACOSX", "PaxHeader", "PaxHeaders", "Thumbs.db", "desktop.ini")
_DRIVE = re.compile(r"[A-Za-z]:")
_DEEPEST = 3  # parts of the longest name: the folder of the transit, a folder beside its files, a file
_WHERE = (
    "expected all files at the top level or in one folder, and no folders deeper than one level below that"
)


@dataclass(frozen=True)
class ArchiveLimits:
    """Limits for the number and the sizes of the files in an archive.

    Attributes
    ----------
    max_files
        Largest number of members of any kind, including hidden files.
    max_bytes
        Largest number of unpacked bytes of all members.
    max_member_bytes
        Largest number of unpacked bytes of one member.
    max_ratio
        Largest ratio of the unpacked bytes to the bytes of the archive. This bound applies only above
        RATIO_FLOOR_BYTES.
    """

    max_files: int = 16_384
    max_bytes: int = 8 * 2**30
    max_ratio: float = 200.0
    max_member_bytes: int = 2**30

    def of_archive(self, size_bytes: int) -> ArchiveLimits:
        """The limits of an archive of this size, whose max_bytes include the ratio."""
        by_ratio = max(RATIO_FLOOR_BYTES, int(self.max_ratio * size_bytes))
        return replace(self, max_bytes=min(self.max_bytes, by_ratio))


@dataclass(frozen=True)
class Admitted:
    """An accepted file: its folder in the archive ("": the top level), and its plain name."""

    folder: str
    name: str


def is_plain_name(name: str) -> bool:
    """True for the name of a file inside a folder: no path, no "..", no drive letter, only printable characters."""
    return (
        0 < len(name.encode("utf-8", "replace")) <= 255
        and name.isprintable()
        and not set("/\\") & set(name)
        and name not in (".", "..")
        and name == name.strip()
        and _DRIVE.match(name) is None
    )


class Gate:
    """Checks every member of one archive: its name, its number and its size.

    The files of a transit are at the top level or in one folder. Beside them there may be other folders, one level
    deep. The files in these folders are ignored, but they are checked and counted like all other files.
    """

    def __init__(self, limits: ArchiveLimits) -> None:
        self.limits = limits
        self._members = self._declared_bytes = 0
        self._is_at_top = False  # there is a file outside all folders
        self._files: dict[Admitted, str] = {}  # accepted files and their names in the archive
        self._folders: list[str] = []  # names of folders that have entries of their own

    def count(self, size: int) -> None:
        """Count a member of any kind and its declared bytes. Raises DataError "archive-too-large"."""
        self._members += 1
        if self._members > self.limits.max_files:
            message = (
                f"expected at most {self.limits.max_files} members; got more: pack only {MANIFEST_NAME} and the files "
                "that it names"
            )
            raise DataError("archive-too-large", message)
        self._declared_bytes += size
        if self._declared_bytes > self.limits.max_bytes:
            message = (
                f"expected an archive that unpacks to at most {self.limits.max_bytes} bytes; got more: pack fewer or "
                "smaller images"
            )
            raise DataError("archive-too-large", message)

    def admit(self, raw_name: str, size: int) -> Admitted | None:
        """Check a file; return its folder and its plain name, or None if the file is hidden and must be skipped.

        Raises DataError "archive-climbs", "archive-not-plain", "archive-too-large".
        """
        parts = _parts(raw_name)
        if not parts:
            raise not_plain(raw_name, "expected a member with the name of a file")
        if _is_hidden(parts):
            return None
        if len(parts) > _DEEPEST:
            raise not_plain(raw_name, _WHERE)
        if not is_plain_name(parts[-1]):
            raise not_plain(raw_name, "expected a plain file name")
        file = Admitted("/".join(parts[:-1]), parts[-1])
        if file in self._files:
            raise not_plain(raw_name, "expected each file name only once")
        if file.name == MANIFEST_NAME and any(other.name == MANIFEST_NAME for other in self._files):
            raise not_plain(raw_name, f"expected {MANIFEST_NAME} only once")
        self._files[file] = raw_name
        self._is_at_top = self._is_at_top or file.folder == ""
        if size > self.limits.max_member_bytes:
            most = self.limits.max_member_bytes
            message = f"{shown(raw_name)}: expected a file of at most {most} bytes; got {size} bytes"
            raise DataError("archive-too-large", message)
        return file

    def is_beside(self, file: Admitted) -> bool:
        """True if it is known already that the folder of a file is not the folder of the transit."""
        return "/" in file.folder or (file.folder != "" and self._is_at_top)

    def check_folder(self, raw_name: str) -> None:
        """Check the entry of a folder; the folder is not created. Raises DataError "archive-climbs",
        "archive-not-plain".
        """
        parts = _parts(raw_name)
        if _is_hidden(parts):
            return
        if len(parts) >= _DEEPEST:
            raise not_plain(raw_name, _WHERE)
        if len(parts) > 1:
            self._folders.append("/".join(parts))

    def main_folder(self) -> str:
        """The folder of the transit's files: the top level if it has files, otherwise the only folder there.

        Call this after all members were checked. Raises DataError "archive-not-plain" if a file is neither in this
        folder nor in a folder directly inside it, or if transit.json is in another folder.
        """
        folders = dict.fromkeys(file.folder for file in self._files)
        main = "" if "" in folders else next((one for one in folders if "/" not in one), "")
        for file, raw_name in self._files.items():
            if file.folder not in ("", main) and _above(file.folder) != main:
                raise not_plain(raw_name, _WHERE)
        for folder in self._folders:
            if _above(folder) != main:
                raise not_plain(folder, _WHERE)
        described = [file for file in self._files if file.name == MANIFEST_NAME]
        if described and Admitted(main, MANIFEST_NAME) not in described:
            message = f"expected {MANIFEST_NAME} in the same folder as the other files"
            raise not_plain(self._files[described[0]], message)
        return main


def not_plain(raw_name: str, message: str) -> DataError:
    """The error for a member that is not a plain file with a plain name."""
    return DataError("archive-not-plain", f"{message}; got {shown(raw_name)}")


def shown(raw_name: str) -> str:
    """A member's name for a message: in ASCII, at most 80 characters of the name."""
    return ascii(raw_name[:80])


def _above(folder: str) -> str:
    """The folder that contains a folder."""
    return folder.rpartition("/")[0]


def _parts(raw_name: str) -> list[str]:
    """The parts of a member's name: its folders and its file name. Raises DataError "archive-climbs"."""
    parts = [part for part in raw_name.split("/") if part not in ("", ".")]
    climbs = raw_name.startswith("/") or "\\" in raw_name or ".." in parts
    if climbs or any(_DRIVE.match(part) for part in parts):
        message = (
            f"expected names inside the folder of the archive; got {shown(raw_name)}: pack the files without "
            "their paths"
        )
        raise DataError("archive-climbs", message)
    return parts


def _is_hidden(parts: list[str]) -> bool:
    return any(part.startswith(".") or part.split(".")[0] in _HIDDEN or part in _HIDDEN for part in parts)
