"""``heliopsf cache``: lists and removes the built PSFs that are kept for later commands."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

import click

from psfcore.psf_cache import PROVENANCE, CachedPsf, PsfCache
from service.cli.connection import short
from service.cli.options import user_errors
from workers.cache_folder import psf_cache

_MIB = 2**20


@click.group(short_help="List and remove built PSFs that are kept.")
def cache() -> None:
    """List and remove the built PSFs that are kept in your cache folder. No service is needed.

    Commands with --local and the Python functions build a PSF once and keep it there. HELIOPSF_CACHE_DIR names another
    folder, HELIOPSF_CACHE_MIB the largest size (default: 2048; 0: keep nothing). A service keeps its PSFs in its own data folder.
    """


@cache.command("list", short_help="List the PSFs that are kept.")
def list_cached() -> None:
    """List the PSFs that are kept, the last used first: id, size, last use, instrument."""
    with user_errors():
        kept = psf_cache()
        psfs = kept.psfs()
        for psf in psfs:
            used = datetime.fromtimestamp(psf.used_at, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
            click.echo(f"{short(psf.identity)}  {psf.bytes / _MIB:8.1f} MiB  {used}  {_named(kept, psf)}")
    total = sum(psf.bytes for psf in psfs) / _MIB
    click.echo(f"{len(psfs)} PSFs, {total:.1f} of {kept.max_bytes // _MIB} MiB, in {kept.folder}")


@cache.command("clear", short_help="Remove all PSFs that are kept.")
def clear() -> None:
    """Remove all PSFs that are kept. A PSF is built again when it is needed."""
    with user_errors():
        kept = psf_cache()
        count, removed = len(kept.psfs()), kept.clear()
    click.echo(f"removed {count} PSFs, {removed / _MIB:.1f} MiB, from {kept.folder}")


def _named(kept: PsfCache, psf: CachedPsf) -> str:
    """The instrument, the size and the component of a PSF, from its provenance."""
    file = kept.find(psf.identity, PROVENANCE)
    if file is None:
        return "(incomplete)"
    parameters: dict[str, Any] = json.loads(file.path.read_bytes())["parameters"]
    parts = [parameters.get("instrument", "your instrument file"), f"{parameters['size']} px"]
    return ", ".join([*parts, *filter(None, [parameters.get("component")])])
