"""Keeps the built PSFs of a temporary catalogue in the user's cache, for later commands.

For each PSF, the cache contains the FITS file, the provenance, and the row of the catalogue with the tables and the
picture. If the Python functions built the PSF, the cache does not contain its row; the row is then made from the FITS
file.
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from psfcore.built.cache import FITS, PROVENANCE, CachedFile, PsfCache
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.psfs import read_psf
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import PsfRow
from workers.contract.identities import psf_identity
from workers.contract.requests import PsfBuild
from workers.files.store import Store
from workers.settings import library_versions
from workers.tasks.data.psfs import psf_row
from workers.versions.series import TOTAL

log = logging.getLogger(__name__)
_ROW, _TABLES, _PREVIEW = "row.json", "tables.json", "preview.png"
_ROW_FORMAT = 1  # raise this number when the content of the row, the tables or the picture changes
_COLUMNS = ("name", "version", "instrument", "channel", "kind", "series", "status", "origin", "bytes")


@dataclass(frozen=True)
class CachedPsfs:
    """Exchanges PSFs between the cache and a catalogue with its store.

    adopt(path, sha256): adds a checked file to the store without copying it.
    """

    cache: PsfCache
    catalogue: Catalogue
    store: Store
    owner: str
    limits: FitsLimits
    threads: int
    adopt: Callable[[Path, str], None]

    def recall(self, build: PsfBuild) -> None:
        """Add the PSF of a recipe to the catalogue, if the cache contains it and the catalogue does not."""
        identity = psf_identity(build)
        if self.catalogue.get(PsfRow, identity, self.owner) is not None:
            return
        fits = self.cache.find(identity, FITS)
        if fits is None:
            return
        self.adopt(fits.path, fits.sha256)
        self.catalogue.add(self._kept_row(identity, fits) or self._new_row(identity, build, fits))

    def remember(self, build: PsfBuild) -> None:
        """Keep the PSF of a recipe in the cache, if the catalogue contains it.

        A failure to write the cache is only logged.
        """
        identity = psf_identity(build)
        row = self.catalogue.get(PsfRow, identity, self.owner)
        if row is None or self.cache.find(identity, _ROW) is not None:
            return
        try:
            self._keep(row)
        except (OSError, DataError) as error:
            log.warning("the PSF is not kept for later commands: %s", error)

    def _keep(self, row: PsfRow) -> None:
        files = {FITS: row.file_sha256, _TABLES: row.details["tables_sha256"], _PREVIEW: row.preview_sha256}
        for part, digest in files.items():
            if digest is not None and self.cache.find(row.id, part) is None:
                self.cache.keep(row.id, part, partial(shutil.copyfile, self.store.path(digest)))
        about = {name: getattr(row, name) for name in (*_COLUMNS, "file_sha256", "preview_sha256", "details")}
        # The row is kept last: if the cache contains the row, it also contains the other files.
        for part, content in (
            (PROVENANCE, row.details["provenance"]),
            (_ROW, about | {"format": _ROW_FORMAT}),
        ):
            self.cache.keep(row.id, part, partial(_write_json, content))

    def _kept_row(self, identity: str, fits: CachedFile) -> PsfRow | None:
        """The row that an earlier command kept; None if there is no such row, or if one of its files is missing."""
        kept = self.cache.find(identity, _ROW)
        if kept is None:
            return None
        about: dict[str, Any] = json.loads(kept.path.read_bytes())
        tables, picture = self.cache.find(identity, _TABLES), self.cache.find(identity, _PREVIEW)
        found = {
            "format": _ROW_FORMAT,
            "file_sha256": fits.sha256,
            "preview_sha256": picture and picture.sha256,
        }
        if tables is None or picture is None or {name: about.get(name) for name in found} != found:
            return None
        if about["details"]["tables_sha256"] != tables.sha256:
            return None
        for file in (tables, picture):
            self.adopt(file.path, file.sha256)
        return PsfRow(
            owner=self.owner,
            id=identity,
            created_at=time.time(),
            **{name: about[name] for name in (*_COLUMNS, "file_sha256", "preview_sha256", "details")},
        )

    def _new_row(self, identity: str, build: PsfBuild, fits: CachedFile) -> PsfRow:
        from psfcore.drawing import plots  # matplotlib is loaded only if a picture is drawn

        psf = read_psf(fits.path, self.limits)
        provenance = self.cache.find(identity, PROVENANCE)
        if provenance is not None:
            psf = replace(psf, provenance=json.loads(provenance.path.read_bytes()))
        with self.store.temporary() as picture:
            plots.psf_png(psf, picture)
            return psf_row(
                psf,
                identity,
                self.owner,
                origin="built",
                file_sha256=fits.sha256,
                store=self.store,
                preview_sha256=self.store.keep(picture),
                kind=build.component or TOTAL,
                details={"libraries": library_versions()},
                threads=self.threads,
            )


def recipes_in(kind: str, resolved: Mapping[str, Any]) -> list[PsfBuild]:
    """The recipes of the PSFs that a job builds if the catalogue does not contain them. resolved: the job's resolved
    parameters."""
    if kind == "psf-build":
        return [PsfBuild.model_validate(resolved)]
    named = (resolved.get(name) for name in ("psf_recipe", "diffraction_recipe"))
    return [PsfBuild.model_validate(one) for one in named if one is not None]


def _write_json(content: Mapping[str, Any], path: Path) -> None:
    path.write_text(json.dumps(content, allow_nan=False))
