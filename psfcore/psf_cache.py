"""A folder of built PSFs, so that a PSF is built only once: `kept_psf` reads a PSF from it, or builds and keeps it.

The name of a file is IDENTITY.SHA256.PART: the identity of the PSF (`psfcore.recipe`), the hash of the file, and
the content of the file, such as "fits". A file is written under a temporary name and then renamed. Its hash is checked
when it is read. If the files need more space than allowed, the files of the least recently used PSF are removed.

Other users have no access to the folder, because the files in it are used without any other check.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from psfcore.errors import DataError
from psfcore.files import PARTIAL, sha256_of
from psfcore.recipe import Recipe

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from psfcore.fits.blocks import FitsLimits
    from psfcore.psf import Psf

FITS, PROVENANCE = "fits", "provenance.json"  # parts that every builder keeps
# The same for a PSF that was built for a deconvolution: its kernel is equal, but it has no components.
TOTAL_FITS, TOTAL_PROVENANCE = "total.fits", "total.provenance.json"
_NAME = re.compile(r"([0-9a-f]{64})\.([0-9a-f]{64})\.([a-z.]+)")
_TEMPORARY = re.compile(rf"\..*{re.escape(PARTIAL)}")
_OTHERS = 0o077  # permissions of the group and of all other users
_ABANDONED_S = 86_400.0  # a temporary file of this age belongs to no running process


@dataclass(frozen=True)
class CachedPsf:
    """All files of one PSF. used_at: the time when the PSF was last used, in seconds since 1970."""

    identity: str
    files: tuple[Path, ...]
    bytes: int
    used_at: float


class PsfCache:
    """Keeps the files of PSFs by identity. max_bytes: the largest size of all files; 0: nothing is kept.

    Files in a folder that belongs to another user are not used, because that user could change them.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder = folder
        self.max_bytes = max_bytes

    def find(self, identity: str, part: str) -> Path | None:
        """A file of a PSF, after its content was checked; None if the cache has no such file.

        A damaged file is removed.
        """
        for path in self._files():
            of, sha256, found_part = path.name.split(".", 2)
            if (of, found_part) != (identity, part):
                continue
            try:
                if sha256_of(path) == sha256:
                    # The access time of the file is set to now: it records the last use. The modification time is not
                    # changed, because other running commands use it to notice that a file was replaced.
                    os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))
                    return path
                path.unlink()
            except FileNotFoundError:  # another process removed it
                continue
        return None

    def keep(self, identity: str, part: str, write: Callable[[Path], object]) -> Path | None:
        """Keep a file. ``write(path)`` writes it. Returns None if the file is larger than the largest size of the
        cache.

        Raises DataError "cache-of-another-user", and OSError if the file cannot be written.
        """
        if self.max_bytes == 0:
            return None
        self._make_private()
        unfinished = self.folder / f".{uuid.uuid4().hex}{PARTIAL}"
        try:
            unfinished.touch(mode=0o600)
            write(unfinished)
            unfinished.chmod(0o600)
            with unfinished.open("rb") as written:
                os.fsync(written.fileno())
            if unfinished.stat().st_size > self.max_bytes:
                return None
            kept = self.folder / f"{identity}.{sha256_of(unfinished)}.{part}"
            unfinished.replace(kept)
        finally:
            unfinished.unlink(missing_ok=True)
        self._shrink(identity)
        return kept

    def psfs(self) -> list[CachedPsf]:
        """The PSFs in the cache; the most recently used PSF comes first."""
        files: dict[str, list[tuple[Path, os.stat_result]]] = {}
        for path in self._files():
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
        removed = self.psfs()
        for psf in removed:
            _remove(psf)
        for leftover in self._files(_TEMPORARY):
            leftover.unlink(missing_ok=True)
        return sum(psf.bytes for psf in removed)

    def _files(self, pattern: re.Pattern[str] = _NAME) -> list[Path]:
        """The files with such names, by default those of PSFs; none if there is no folder or it belongs to another user."""
        if not self.folder.is_dir() or self._of_another_user():
            return []
        return sorted(path for path in self.folder.iterdir() if pattern.fullmatch(path.name))

    def _shrink(self, last: str) -> None:
        """Remove the least recently used PSFs until the others fit.

        The PSF with the identity ``last`` is never removed.
        """
        psfs = self.psfs()
        total = sum(psf.bytes for psf in psfs)
        for psf in reversed(psfs):
            if total <= self.max_bytes:
                break
            if psf.identity != last:
                _remove(psf)
                total -= psf.bytes
        for leftover in self._files(_TEMPORARY):  # killed processes leave such files
            with suppress(FileNotFoundError):
                if time.time() - leftover.stat().st_mtime > _ABANDONED_S:
                    leftover.unlink()

    def _of_another_user(self) -> bool:
        return self.folder.stat().st_uid != os.geteuid()

    def _make_private(self) -> None:
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if self._of_another_user():
            raise DataError(
                "cache-of-another-user",
                f"expected the folder {self.folder} to belong to you; it belongs to another user: name another folder with "
                "HELIOPSF_CACHE_DIR",
            )
        if self.folder.stat().st_mode & _OTHERS:
            self.folder.chmod(0o700)


def _remove(psf: CachedPsf) -> None:
    for path in psf.files:
        path.unlink(missing_ok=True)


@contextmanager
def built_file(
    cache: PsfCache,
    recipe: Recipe,
    *,
    parts: bool = True,
    mount_image: NDArray[Any] | None = None,
    threads: int,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The file of the PSF of a recipe and its provenance: from the cache, or built and kept there.

    parts: False: the PSF without its components, which is built in less time. If the components are asked for later, the PSF is
    built again; its kernel is the same. progress is called while the PSF is built. If the cache cannot be used, the PSF is
    built in every call, with a warning.
    """
    names = (FITS, PROVENANCE)
    fits = cache.find(recipe.identity, FITS)
    if fits is None and not parts:
        names = (TOTAL_FITS, TOTAL_PROVENANCE)
        fits = cache.find(recipe.identity, TOTAL_FITS)
    if fits is not None:
        provenance = cache.find(recipe.identity, names[1])
        yield fits, {"psf_id": recipe.identity} if provenance is None else json.loads(provenance.read_bytes())
        return
    # A command that finds its PSF does not load the libraries of the diffraction.
    from psfcore.build import build_recipe
    from psfcore.fits.psfs import write_psf

    psf = build_recipe(recipe, parts=parts, mount_image=mount_image, threads=threads, progress=progress)
    text = json.dumps(psf.provenance, allow_nan=False)
    with TemporaryDirectory(prefix="heliopsf-") as folder:
        path = Path(folder) / "psf.fits"
        write_psf(path, psf, instrument_file=recipe.text.encode())
        try:
            cache.keep(recipe.identity, names[1], lambda part: part.write_text(text))
            cache.keep(recipe.identity, names[0], partial(shutil.copyfile, path))
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
