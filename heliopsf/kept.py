"""Built PSFs are kept in the user's cache, which commands with ``--local`` use too."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from numpy.typing import NDArray

from psfcore.build import build_recipe
from psfcore.built.cache import FITS, PROVENANCE, CachedFile, PsfCache
from psfcore.built.recipe import Recipe
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.psf import Psf
from workers.cache_folder import psf_cache


def kept_psf(
    recipe: Recipe,
    limits: FitsLimits,
    *,
    mount_image: NDArray[Any] | None,
    threads: int,
    progress: Callable[[int, int], None] | None,
) -> Psf:
    """The PSF of a recipe: read from the cache, or built and kept there.

    In both cases the PSF is read from its file, so that it is the same to the last bit. If the cache cannot be used,
    the PSF is built in every call, with a warning.
    """
    cache = psf_cache()
    fits = cache.find(recipe.identity, FITS)
    if fits is not None:
        if progress is not None:
            progress(1, 1)
        return _read(cache, recipe, fits, limits)
    psf = build_recipe(recipe, mount_image=mount_image, threads=threads, progress=progress)
    try:
        fits = _keep(cache, recipe, psf)
    except (OSError, DataError) as error:
        warnings.warn(f"the PSF is not kept and will be built again: {error}", stacklevel=3)
    if fits is not None:
        return _read(cache, recipe, fits, limits)
    with TemporaryDirectory(prefix="heliopsf-") as folder:
        path = Path(folder) / "psf.fits"
        _write(recipe, psf, path)
        return _with_provenance(read_psf(path, limits), psf.provenance)


def _keep(cache: PsfCache, recipe: Recipe, psf: Psf) -> CachedFile | None:
    text = json.dumps(psf.provenance, allow_nan=False)
    cache.keep(recipe.identity, PROVENANCE, lambda path: path.write_text(text))
    return cache.keep(recipe.identity, FITS, lambda path: _write(recipe, psf, path))


def _write(recipe: Recipe, psf: Psf, path: Path) -> None:
    write_psf(path, psf, instrument_file=recipe.text.encode())


def _read(cache: PsfCache, recipe: Recipe, fits: CachedFile, limits: FitsLimits) -> Psf:
    psf = read_psf(fits.path, limits)
    kept = cache.find(recipe.identity, PROVENANCE)
    own = {"psf_id": recipe.identity} if kept is None else json.loads(kept.path.read_bytes())
    return _with_provenance(psf, own)


def _with_provenance(psf: Psf, own: dict[str, Any]) -> Psf:
    toml = {name: psf.provenance[name] for name in ("instrument_toml",) if name in psf.provenance}
    return replace(psf, provenance=own | toml)
