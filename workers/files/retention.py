"""Deletes what is older than the operator keeps it, with its files. PSFs and contexts are always kept."""

from __future__ import annotations

import logging
import time
from collections import defaultdict

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.retention import RESULTS, UPLOADS
from workers.files.collection import files_of, remove_unnamed
from workers.files.store import Store
from workers.settings import Settings

log = logging.getLogger(__name__)
DAY_S = 86_400.0


def retain(catalogue: Catalogue, store: Store, settings: Settings) -> dict[tuple[str, str], list[int]]:
    """Delete what is older than ``settings.kept_days`` allows, and log it. In a dry run, only log what would be deleted.

    Returns the bytes of each deleted thing, by owner and kind.
    """
    deleted: dict[tuple[str, str], list[int]] = defaultdict(list)
    for (owner, kind), days in settings.kept_days.items():
        others = [other for other, of in settings.kept_days if other and of == kind]
        for of, identity, size in catalogue.retention.old(kind, time.time() - days * DAY_S, owner, others):
            if settings.keep_dry_run or _delete(catalogue, store, kind, of, identity):
                deleted[of, kind].append(size)
    done = "would delete" if settings.keep_dry_run else "deleted"
    for (owner, kind), sizes in deleted.items():
        fields = {"owner": owner, "kind": kind, "count": len(sizes), "bytes": sum(sizes)}
        log.info("retention: %s %d of kind %s", done, len(sizes), kind, extra={"fields": fields})
    return dict(deleted)


def _delete(catalogue: Catalogue, store: Store, kind: str, owner: str, identity: str) -> bool:
    if kind == "job":
        return catalogue.uws.destroy(identity)
    if kind == "bulk":
        return catalogue.bulks.delete(identity)
    row = catalogue.delete((UPLOADS | RESULTS)[kind], identity, owner)
    if row is not None:
        named = [identity] if kind in UPLOADS else [digest for digest, _ in files_of(row)]
        remove_unnamed(catalogue, store, named)
    return row is not None
