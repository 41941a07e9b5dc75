"""The default data folder: a folder of the user that does not depend on the working folder.

Earlier versions used ``heliopsf-data`` in the working folder. If this folder still contains data, it is used, and
commands tell the user so. Otherwise a service that is started as before would begin with an empty catalogue.
"""

from __future__ import annotations

import os
import shlex
from pathlib import Path

from platformdirs import user_data_path

EARLIER = "heliopsf-data"


def default_data_dir() -> Path:
    """The data folder of earlier versions if it is in the working folder and contains data; otherwise the user's data
    folder."""
    return earlier_data_dir() or users_data_dir()


def users_data_dir() -> Path:
    """The data folder of this user, by the convention of the operating system, such as ``~/.local/share/heliopsf``."""
    return user_data_path("heliopsf", appauthor=False)


def earlier_data_dir() -> Path | None:
    """The data folder of earlier versions in the working folder; None if it does not exist or is empty.

    A folder of another user is ignored, because in a shared folder such as /tmp any user could create one.
    """
    folder = Path.cwd() / EARLIER
    if not folder.is_dir():
        return None
    # os.stat follows a link, os.lstat does not: both the link and its target must belong to the user.
    if any(found.st_uid != os.geteuid() for found in (folder.lstat(), folder.stat())):
        return None
    return folder if any(folder.iterdir()) else None


def told() -> str | None:
    """A message for the user if the default data folder is the folder of earlier versions; None otherwise."""
    earlier, users = earlier_data_dir(), users_data_dir()
    if earlier is None:
        return None
    said = f"data in {earlier}, because earlier versions kept data there"
    if users.is_dir() and any(users.iterdir()):
        return (
            f"{said}; commands in other folders use {users}, which holds data too: name one of the two with --data or "
            "HELIOPSF_DATA_DIR"
        )
    first = f"rmdir {_quoted(users)}" if users.is_dir() else f"mkdir -p {_quoted(users.parent)}"
    move = f"{first} && mv {_quoted(earlier)} {_quoted(users)}"
    return (
        f"{said}; to use the same data from every folder, stop the service and its workers, then run: {move}"
    )


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
