"""Makes the row of a bulk run from its request: checks images and paths, and records the id of the PSF or of the context."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from psfcore.errors import DataError
from workers.catalogue.bulk_progress import BATCH
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.bulks import new_id
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, PsfRow
from workers.contract.bulk import BulkPhase, BulkRequest
from workers.contract.identities import canonical_hash
from workers.files import archive as archive_files
from workers.rows import no_such, row_of
from workers.settings import Settings


def begin(request: BulkRequest, catalogue: Catalogue, owner: str, settings: Settings) -> tuple[BulkRow, bool]:
    """A new bulk run, or the open bulk run of an identical request. Also returns whether it is new.

    Raises ``DataError``: "no-such-psf", "no-such-context", "no-such-image", "bad-path", "path-not-allowed".
    """
    psf_id, context_id = pinned(request, catalogue, owner)
    images = list(dict.fromkeys(request.images))
    check_uploaded(images, catalogue, owner)
    check_places(request, settings)
    asked = request.model_dump(mode="json", exclude={"images", "context"}) | {"context": context_id}
    now = time.time()
    row = BulkRow(
        id=new_id(),
        owner=owner,
        name=request.name,
        phase=BulkPhase.LISTING if request.files else BulkPhase.RUNNING,
        request=asked,
        request_key=_key(asked, images),
        psf_id=psf_id,
        context_id=context_id,
        created_at=now,
        running_since=now,
        listed=not request.files,
    )
    return catalogue.bulks.create(row, images)


def pinned(request: BulkRequest, catalogue: Catalogue, owner: str) -> tuple[str | None, str | None]:
    """The id of the PSF or of the context. Ids are fixed, so a later change of a name does not change the run."""
    if request.psf_id is not None:
        row_of(catalogue, PsfRow, request.psf_id, owner)
        return request.psf_id, None
    assert request.context is not None
    return None, catalogue.contexts.named(request.context, owner).id


def check_uploaded(images: Sequence[str], catalogue: Catalogue, owner: str) -> None:
    """Raise DataError "no-such-image" if one of the ids is not an uploaded image of the owner."""
    for at in range(0, len(images), BATCH):
        batch = images[at : at + BATCH]
        there = catalogue.ids_among(ImageRow, batch, owner)
        missing = next((one for one in batch if one not in there), None)
        if missing is not None:
            raise no_such("image", missing)


def check_places(request: BulkRequest, settings: Settings) -> None:
    """Raise DataError "bad-path" or "path-not-allowed" if a pattern or the output folder cannot be used."""
    allowed = archive_files.roots(settings.bulk_roots)
    for files in request.files:
        archive_files.check_glob(files.glob, allowed)
    if request.output is None:
        return
    folder = Path(request.output.folder)
    if not folder.is_absolute() or ".." in folder.parts:
        raise DataError(
            "bad-path", f"output: expected an absolute path without '..'; got {ascii(str(folder))[:200]}"
        )
    archive_files.check_under(folder, archive_files.roots(settings.bulk_output_roots), "an output folder")


def _key(asked: Mapping[str, Any], images: Sequence[str]) -> str:
    """The key of the request: requests that differ only in their names have the same key."""
    # Runs that were started before these parameters existed keep their keys.
    newer = ("again", "other_channel")
    parameters = {name: value for name, value in asked["parameters"].items() if name not in newer or value}
    output = asked["output"] and {
        name: value for name, value in asked["output"].items() if name != "layout" or value is not None
    }
    return canonical_hash(
        {**asked, "name": None, "parameters": parameters, "output": output, "images": list(images)}
    )
