"""Keeps the built PSFs of a temporary catalogue in the user's cache, for later commands.

For each PSF, the cache contains the FITS file, the provenance, and the row of the catalogue with the tables and the
picture. If the Python functions built the PSF, the cache does not contain its row; the row is then made from the FITS
file. A PSF that was built for a deconvolution is kept as other parts: its FITS file holds the total PSF alone, and it has
neither tables nor a picture.
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

from psfcore.built.cache import FITS, PROVENANCE, TOTAL_FITS, TOTAL_PROVENANCE, CachedFile, PsfCache
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.psf import Psf
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import PsfRow
from workers.contract.identities import psf_identity
from workers.contract.requests import PsfBuild
from workers.files.store import Store
from workers.settings import library_versions
from workers.tasks.data.psfs import is_total_alone, psf_row
from workers.versions import TOTAL

log = logging.getLogger(__name__)
_ROW, _TABLES, _PREVIEW, _TOTAL_ROW = "row.json", "tables.json", "preview.png", "total.row.json"
_ROW_FORMAT = 1  # raise this number when the content of the row, the tables or the picture changes
_COLUMNS = (
    *("name", "version", "instrument", "channel", "kind", "series", "status", "origin", "bytes"),
    *("file_sha256", "preview_sha256", "details"),
)


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

    def recall(self, build: PsfBuild, *, whole: bool = True) -> None:
        """Add the PSF of a recipe to the catalogue, if the cache contains it and the catalogue does not.

        whole: False if the total PSF alone is enough.
        """
        identity = psf_identity(build)
        if self.catalogue.get(PsfRow, identity, self.owner) is not None:
            return
        fits = self.cache.find(identity, FITS)
        if fits is not None:
            self.adopt(fits.path, fits.sha256)
            self.catalogue.add(self._kept_row(identity, fits) or self._new_row(identity, build, fits))
        elif not whole and (total := self.cache.find(identity, TOTAL_FITS)) is not None:
            self.adopt(total.path, total.sha256)
            self.catalogue.add(self._total_row(identity, total))

    def remember(self, build: PsfBuild) -> None:
        """Keep the PSF of a recipe in the cache, if the catalogue contains it.

        A failure to write the cache is only logged.
        """
        identity = psf_identity(build)
        row = self.catalogue.get(PsfRow, identity, self.owner)
        if row is None:
            return
        keep, mark = (self._keep_total, _TOTAL_ROW) if is_total_alone(row) else (self._keep, _ROW)
        if self.cache.find(identity, mark) is not None:
            return
        try:
            keep(row)
        except (OSError, DataError) as error:
            log.warning("the PSF is not kept for later commands: %s", error)

    def _keep(self, row: PsfRow) -> None:
        files = {FITS: row.file_sha256, _TABLES: row.details["tables_sha256"], _PREVIEW: row.preview_sha256}
        for part, digest in files.items():
            if digest is not None and self.cache.find(row.id, part) is None:
                self.cache.keep(row.id, part, partial(shutil.copyfile, self.store.path(digest)))
        # The row is kept last: if the cache contains the row, it also contains the other files.
        for part, content in (
            (PROVENANCE, row.details["provenance"]),
            (_ROW, _about(row)),
        ):
            self.cache.keep(row.id, part, partial(_write_json, content))

    def _keep_total(self, row: PsfRow) -> None:
        if self.cache.find(row.id, TOTAL_FITS) is None:
            self.cache.keep(row.id, TOTAL_FITS, partial(shutil.copyfile, self.store.path(row.file_sha256)))
        for part, content in ((TOTAL_PROVENANCE, row.details["provenance"]), (_TOTAL_ROW, _about(row))):
            self.cache.keep(row.id, part, partial(_write_json, content))

    def _total_row(self, identity: str, fits: CachedFile) -> PsfRow:
        kept = self.cache.find(identity, _TOTAL_ROW)
        if kept is not None:
            about: dict[str, Any] = json.loads(kept.path.read_bytes())
            if (about.get("format"), about.get("file_sha256")) == (_ROW_FORMAT, fits.sha256):
                return self._row_of(identity, about)
        return psf_row(
            self._psf(identity, fits, TOTAL_PROVENANCE, parts=False),
            identity,
            self.owner,
            origin="built",
            file_sha256=fits.sha256,
            store=self.store,
            preview_sha256=None,
            details={"libraries": library_versions()},
            whole=False,
        )

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
        return self._row_of(identity, about)

    def _psf(self, identity: str, fits: CachedFile, provenance: str, *, parts: bool) -> Psf:
        """The PSF of a FITS file in the cache. provenance: the name of the cache's part with its provenance."""
        psf = read_psf(fits.path, self.limits, parts=parts)
        kept = self.cache.find(identity, provenance)
        return psf if kept is None else replace(psf, provenance=json.loads(kept.path.read_bytes()))

    def _row_of(self, identity: str, about: Mapping[str, Any]) -> PsfRow:
        columns = {name: about[name] for name in _COLUMNS}
        return PsfRow(owner=self.owner, id=identity, created_at=time.time(), **columns)

    def _new_row(self, identity: str, build: PsfBuild, fits: CachedFile) -> PsfRow:
        from psfcore.drawing import plots  # matplotlib is loaded only if a picture is drawn

        psf = self._psf(identity, fits, PROVENANCE, parts=True)
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


def _about(row: PsfRow) -> dict[str, Any]:
    return {name: getattr(row, name) for name in _COLUMNS} | {"format": _ROW_FORMAT}


def _write_json(content: Mapping[str, Any], path: Path) -> None:
    path.write_text(json.dumps(content, allow_nan=False))
