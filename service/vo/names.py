"""Names of products and PSFs for VO clients: ``urn:heliopsf:product:ID`` and ``urn:heliopsf:psf:ID``.

The names are in lists, DataLink tables and provenance. A request may also give the bare id; if a product and a PSF had
the same id, the bare id would mean the product.
"""

from __future__ import annotations

import re

from service.http.callers import Caller
from service.http.state import State
from workers.catalogue.tables import ProductRow, PsfRow
from workers.lineage import NAMES

PRODUCT, PSF = "product", "psf"
_ID = re.compile(r"[0-9a-f]{64}")


def did(kind: str, identity: str) -> str:
    """The name of a product or PSF."""
    return f"{NAMES}{kind}:{identity}"


def row_named(state: State, caller: Caller, name: str) -> ProductRow | PsfRow | None:
    """The row of the product or PSF with this name or id; None if the caller has none."""
    kinds, identity = (PRODUCT, PSF), name
    for kind in kinds:
        if name.startswith(did(kind, "")):
            kinds, identity = (kind,), name.removeprefix(did(kind, ""))  # type: ignore[assignment]
    if not _ID.fullmatch(identity):
        return None
    found: ProductRow | PsfRow | None = None
    if PRODUCT in kinds:
        found = state.catalogue.get(ProductRow, identity, caller.owner)
    if found is None and PSF in kinds:
        found = state.catalogue.get(PsfRow, identity, caller.owner)
    return found
