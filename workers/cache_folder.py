"""The cache of built PSFs of this user. Commands with ``--local`` and the Python functions share it.

This module needs no other module of ``workers``, so that the package ``heliopsf`` can import it alone.
"""

from __future__ import annotations

import os
from pathlib import Path

from platformdirs import user_cache_path

from psfcore.errors import DataError
from psfcore.psf_cache import PsfCache

FOLDER, LARGEST = "HELIOPSF_CACHE_DIR", "HELIOPSF_CACHE_MIB"
DEFAULT_MIB = 2048  # about 15 PSFs of 2048 px with their components
_PSFS, _PUBLISHED = (
    "psfs",
    "published",
)  # a separate subfolder, because the cache makes its folder inaccessible to other users


def psf_cache() -> PsfCache:
    """The cache in the folder that HELIOPSF_CACHE_DIR names, or in the user's cache folder, such as ``~/.cache/heliopsf``.

    Raises DataError "bad-setting" if HELIOPSF_CACHE_MIB is not a whole number.
    """
    largest = os.environ.get(LARGEST) or str(DEFAULT_MIB)
    if not (largest.isascii() and largest.isdigit()):
        raise DataError(
            "bad-setting", f"{LARGEST}: expected a whole number of MiB, 0 for no cache; got {largest!r}"
        )
    return PsfCache(_folder() / _PSFS, int(largest) * 2**20)


def published_folder() -> Path:
    """The folder of published PSFs (`psfcore.published_psfs`), beside the cache of built PSFs. Users may share it."""
    return _folder() / _PUBLISHED


def _folder() -> Path:
    named = os.environ.get(FOLDER)
    return Path(named).expanduser() if named else user_cache_path("heliopsf", appauthor=False)
