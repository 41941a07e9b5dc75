"""A folder of built PSFs, so that a PSF is built only once: `kept_psf` reads a PSF from it, or builds and keeps it.

The name of a file is IDENTITY.PART: the identity of the PSF (`psfcore.recipe`), and the content of the file, such as
"fits". A file is written under a temporary name and then renamed; when it is read, the card CHECKSUM of its HDUs proves
that it is whole. If the files need more space than allowed, the files of the least recently used PSF are removed.

Other users have no access to the folder, because the files in it are used without any other check.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from psfcore.errors import DataError
from psfcore.files import PARTIAL, whole_path
from psfcore.fits.blocks import BLOCK_BYTES
from psfcore.recipe import Recipe

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from psfcore.fits.blocks import FitsLimits
    from psfcore.psf import Psf

FITS, PROVENANCE = "fits", "json"
TOTAL_FITS = (
    "total.fits"  # a PSF that was built for a deconvolution: its kernel is equal, but it has no components
)
_NAME = re.compile(r"[0-9a-f]{64}\..+")
_TEMPORARY = re.compile(rf"\..*{re.escape(PARTIAL)}")
_OTHERS = 0o077  # permissions of the group and of all other users
_PIECE_BYTES = 2**22
_ABANDONED_S = 86_400.0  # a temporary file of this age belongs to no running process


@dataclass(frozen=True)
class CachedPsf:
    """All files of one PSF.

    Attributes
    ----------
    used_at
        The time when the PSF was last used, in seconds since 1970.
    """

    identity: str
    files: tuple[Path, ...]
    bytes: int
    used_at: float


class PsfCache:
    """Keeps the files of PSFs by identity.

    Files in a folder that belongs to another user are not used, because that user could change them.

    Parameters
    ----------
    max_bytes
        The largest size of all files, bytes; 0: nothing is kept.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder = folder
        self.max_bytes = max_bytes

    def find(self, identity: str, part: str = FITS) -> Path | None:
        """The FITS file of a PSF; None if the cache does not have it. A damaged file is removed."""
        path = self.folder / f"{identity}.{part}"
        with suppress(FileNotFoundError):  # the cache does not have it, or another process removed it
            if not self._ours():
                return None
            if _whole(path):
                # The access time of the file is set to now: it records the last use. The modification time is not
                # changed, because other running commands use it to notice that a file was replaced.
                os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))
                return path
            path.unlink()
        return None

    def provenance(self, identity: str) -> dict[str, object]:
        """How a PSF of the cache was made; empty if this was not kept."""
        try:
            found: dict[str, object] = json.loads((self.folder / f"{identity}.{PROVENANCE}").read_bytes())
        except (FileNotFoundError, ValueError):
            return {}
        return found

    def keep(self, identity: str, part: str, file: Path) -> None:
        """Keep a copy of a file, unless it is larger than the cache may be.

        Raises DataError "cache-of-another-user", and OSError if the file cannot be written.
        """
        if file.stat().st_size > self.max_bytes:
            return
        self._make_private()
        with whole_path(self.folder / f"{identity}.{part}") as unfinished:
            unfinished.touch(mode=0o600)
            shutil.copyfile(file, unfinished)
        self._shrink(self.max_bytes, identity)

    def psfs(self) -> list[CachedPsf]:
        """The PSFs in the cache; the most recently used PSF comes first."""
        files: dict[str, list[tuple[Path, os.stat_result]]] = {}
        for path in self._files(_NAME):
            with suppress(FileNotFoundError):  # another process removed it
                files.setdefault(path.name.split(".")[0], []).append((path, path.stat()))
        psfs = [
            CachedPsf(
                identity=identity,
                files=tuple(path for path, _ in of),
                bytes=sum(state.st_size for _, state in of),
                used_at=max(state.st_atime for _, state in of),
            )
            for identity, of in files.items()
        ]
        return sorted(psfs, key=lambda psf: psf.used_at, reverse=True)

    def clear(self) -> int:
        """Remove all files; returns the size of the PSFs in bytes. Other files in the folder stay."""
        return self._shrink(-1, abandoned_s=-math.inf)

    def _files(self, pattern: re.Pattern[str]) -> list[Path]:
        """The files with such names; none if there is no folder or it belongs to another user."""
        found = self.folder.iterdir() if self._ours() else ()
        return sorted(path for path in found if pattern.fullmatch(path.name))

    def _shrink(self, most_bytes: int, last: str = "", *, abandoned_s: float = _ABANDONED_S) -> int:
        """Remove the least recently used PSFs until the others fit, and what killed processes left; returns the size of
        these PSFs.

        The PSF with the identity ``last`` is never removed.
        """
        psfs = self.psfs()
        total = before = sum(psf.bytes for psf in psfs)
        for psf in reversed(psfs):
            if total > most_bytes and psf.identity != last:
                total -= psf.bytes
                for path in psf.files:
                    path.unlink(missing_ok=True)
        for leftover in self._files(_TEMPORARY):
            with suppress(FileNotFoundError):
                if time.time() - leftover.stat().st_mtime > abandoned_s:
                    leftover.unlink()
        return before - total

    def _ours(self) -> bool:
        """Whether the folder is there and belongs to this user."""
        return self.folder.is_dir() and self.folder.stat().st_uid == os.geteuid()

    def _make_private(self) -> None:
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not self._ours():
            raise DataError(
                "cache-of-another-user",
                f"expected the folder {self.folder} to belong to you; it belongs to another user: name another "
                "folder with HELIOPSF_CACHE_DIR",
            )
        if self.folder.stat().st_mode & _OTHERS:
            self.folder.chmod(0o700)


def _whole(path: Path) -> bool:
    """Whether a FITS file is as it was written: in ones' complement, the 32-bit words of each HDU with the card
    CHECKSUM sum to -0.

    FITS standard 4.0, Appendix J.
    """
    import numpy as np  # `heliopsf cache list` needs no numerical libraries

    total = 0
    with path.open("rb") as file:
        while words := file.read(_PIECE_BYTES):
            total += int(np.frombuffer(words, ">u4", len(words) // 4).sum(dtype=np.uint64))
        return total > 0 and total % 0xFFFFFFFF == 0 and file.tell() % BLOCK_BYTES == 0


@contextmanager
def built_file(
    cache: PsfCache,
    recipe: Recipe,
    *,
    parts: bool = True,
    mount_image: NDArray[np.floating] | None = None,
    threads: int,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[Path, dict[str, object]]]:
    """The file of the PSF of a recipe and its provenance: from the cache, or built and kept there.

    If the cache cannot be used, the PSF is built in every call, with a warning.

    Parameters
    ----------
    parts
        Whether the PSF has its components. Without them it is built in less time. If the components are asked for
        later, the PSF is built again; its kernel is the same.
    progress
        Function that is called while the PSF is built.
    """
    identity = recipe.identity
    fits = cache.find(identity) or (None if parts else cache.find(identity, TOTAL_FITS))
    if fits is not None:
        yield fits, cache.provenance(identity) or {"psf_id": identity}
        return
    # A command that finds its PSF does not load the libraries of the diffraction.
    from psfcore.build import build_recipe
    from psfcore.fits.psfs import write_psf

    psf = build_recipe(recipe, parts=parts, mount_image=mount_image, threads=threads, progress=progress)
    with TemporaryDirectory(prefix="heliopsf-") as folder:
        path, about = Path(folder) / "psf.fits", Path(folder) / "provenance.json"
        write_psf(path, psf, instrument_file=recipe.text.encode())
        about.write_text(json.dumps(psf.provenance, allow_nan=False))
        try:
            cache.keep(identity, PROVENANCE, about)
            cache.keep(identity, FITS if parts else TOTAL_FITS, path)
        except (OSError, DataError) as error:
            warnings.warn(f"the PSF is not kept and will be built again: {error}", stacklevel=4)
        yield path, psf.provenance


def kept_psf(cache: PsfCache, recipe: Recipe, limits: FitsLimits, *, parts: bool = True, **how: Any) -> Psf:
    """The PSF in the file of `built_file`, whose parameters it takes.

    A PSF that was just built is read from its file too, so that it is always the same to the last bit.
    """
    from psfcore.fits.psfs import read_psf

    with built_file(cache, recipe, parts=parts, **how) as (path, own):
        psf = read_psf(path, limits, parts=parts)
    return replace(psf, provenance=own | {"instrument_toml": recipe.text})
