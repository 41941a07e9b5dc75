"""Built PSFs are kept in the user's cache, which commands with ``--local`` use too."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from numpy.typing import NDArray

from psfcore.build import build_recipe
from psfcore.built.cache import FITS, PROVENANCE, TOTAL_FITS, TOTAL_PROVENANCE, CachedFile, PsfCache
from psfcore.built.recipe import Recipe
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.psf import Psf
from workers.cache_folder import psf_cache


@dataclass(frozen=True)
class _Form:
    """The names of the cache's parts for a PSF with its components, or for the total PSF alone."""

    fits: str
    provenance: str


_WHOLE, _TOTAL = _Form(FITS, PROVENANCE), _Form(TOTAL_FITS, TOTAL_PROVENANCE)


def kept_psf(
    recipe: Recipe,
    limits: FitsLimits,
    *,
    parts: bool = True,
    mount_image: NDArray[Any] | None,
    threads: int,
    progress: Callable[[int, int], None] | None,
) -> Psf:
    """The PSF of a recipe: read from the cache, or built and kept there.

    parts: False: the PSF without its components, which is built in less time. If the components are asked for
    later, the PSF is built again; its kernel is the same. A PSF that was just built is read from its file too,
    so that it is always the same to the last bit. If the cache cannot be used, the PSF is built in every call,
    with a warning.
    """
    cache = psf_cache()
    form = _WHOLE
    fits = cache.find(recipe.identity, form.fits)
    if fits is None and not parts:
        form = _TOTAL
        fits = cache.find(recipe.identity, form.fits)
    if fits is not None:
        if progress is not None:
            progress(1, 1)
        return _read(cache, recipe, form, fits, limits, parts)
    psf = build_recipe(recipe, parts=parts, mount_image=mount_image, threads=threads, progress=progress)
    try:
        fits = _keep(cache, recipe, form, psf)
    except (OSError, DataError) as error:
        warnings.warn(f"the PSF is not kept and will be built again: {error}", stacklevel=3)
    if fits is not None:
        return _read(cache, recipe, form, fits, limits, parts)
    with TemporaryDirectory(prefix="heliopsf-") as folder:
        path = Path(folder) / "psf.fits"
        _write(recipe, psf, path)
        return _with_provenance(recipe, read_psf(path, limits, parts=parts), psf.provenance)


def _keep(cache: PsfCache, recipe: Recipe, form: _Form, psf: Psf) -> CachedFile | None:
    text = json.dumps(psf.provenance, allow_nan=False)
    cache.keep(recipe.identity, form.provenance, lambda path: path.write_text(text))
    return cache.keep(recipe.identity, form.fits, lambda path: _write(recipe, psf, path))


def _write(recipe: Recipe, psf: Psf, path: Path) -> None:
    write_psf(path, psf, instrument_file=recipe.text.encode())


def _read(
    cache: PsfCache, recipe: Recipe, form: _Form, fits: CachedFile, limits: FitsLimits, parts: bool
) -> Psf:
    psf = read_psf(fits.path, limits, parts=parts)
    kept = cache.find(recipe.identity, form.provenance)
    own = {"psf_id": recipe.identity} if kept is None else json.loads(kept.path.read_bytes())
    return _with_provenance(recipe, psf, own)


def _with_provenance(recipe: Recipe, psf: Psf, own: dict[str, Any]) -> Psf:
    return replace(psf, provenance=own | {"instrument_toml": recipe.text})
