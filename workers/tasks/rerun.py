"""The task ``rerun``: makes a product or a PSF again from its stored parameters, and compares it with the first one.

The rows of products and PSFs in the catalogue are not changed: only the report refers to the new file.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Comparison, compare
from psfcore.errors import DataError
from psfcore.fits.images import read_plane, read_planes
from psfcore.fits.psfs import read_psf
from workers.catalogue.catalogue import Catalogue, Row
from workers.catalogue.tables import ProductRow, PsfRow, ReportRow
from workers.contract.identities import rerun_identity
from workers.contract.kinds import KINDS
from workers.contract.requests import ResolvedRerun
from workers.lineage import Made, lineage
from workers.rows import row_of
from workers.tasks.context import Context
from workers.tasks.results import add_report, named_psf, write_json

KIND = "rerun"
SCHEMA = 1
Thing = ProductRow | PsfRow


class _RerunCatalogue(Catalogue):
    """The catalogue without the rows in `hidden`, so that a task makes them again.

    Added rows go into the list ``made``, not into the database.
    """

    def __init__(self, real: Catalogue, hidden: frozenset[str]) -> None:
        vars(self).update(vars(real))  # the same database connection and tables
        self._hidden = hidden
        self.made: list[object] = []

    def get(self, table: type[Row], identity: str, owner: str) -> Row | None:
        """The row of this identity; None if it does not exist or is hidden."""
        return None if identity in self._hidden else super().get(table, identity, owner)

    def add(self, row: Row, quota_mib: int | None = None) -> tuple[Row, bool]:
        """Append the row to the list ``made``. This method writes nothing to the database and does not check the quota."""
        self.made.append(row)
        return row, True


def rerun(context: Context, parameters: Mapping[str, Any]) -> str:
    """Make a product or a PSF again, and compare it with the first one; returns the report's id."""
    request = ResolvedRerun.model_validate(parameters)
    identity = rerun_identity(request, context.job_id)
    if context.catalogue.get(ReportRow, identity, context.owner) is not None:
        return identity
    first = _first(context, request)
    again = _made_again(context, request, first)
    _save(context, identity, request, first, again)
    return identity


def _first(context: Context, request: ResolvedRerun) -> Thing:
    if request.of == "psf":
        return named_psf(context, request.id)
    return row_of(context.catalogue, ProductRow, request.id, context.owner)


def _made_again(context: Context, request: ResolvedRerun, first: Thing) -> Thing:
    """The product or PSF as this version makes it. Its file is in the store; its row is not in the catalogue."""
    named = first.details.get("parents") or {}
    hidden = {first.id, *([named["report"]] if "report" in named else [])}
    parameters = dict(request.parameters)
    kind = KINDS[request.kind]
    if request.kind == "deconvolve":
        # This version may give the product another id than the first product has, and may have made this
        # product already.
        assert kind.resolved is not None and kind.identity is not None
        hidden.add(kind.identity(kind.resolved.model_validate(parameters)))
    rerun_catalogue = _RerunCatalogue(context.catalogue, frozenset(hidden))
    if request.kind == "psf-build":
        parameters |= {"instrument": None, "instrument_file": _instrument_text(context, first)}
    kind.load_task()(dataclasses.replace(context, catalogue=rerun_catalogue, anew=True), parameters)
    # The last row is the requested product or PSF. The rows before it had been deleted and were needed again.
    made = [row for row in rerun_catalogue.made if isinstance(row, type(first))]
    if not made:
        raise DataError(
            "not-made-again",
            f"expected the rerun to make a {request.of}; it made no {request.of}: compare the versions of software "
            "and libraries in the lineage",
        )
    found = made[-1]
    assert isinstance(found, ProductRow | PsfRow)
    return found


def _instrument_text(context: Context, first: Thing) -> str:
    """The text of the instrument file that the first run used, because shipped files can change with the software."""
    psf = read_psf(context.store.verified(first.file_sha256), context.settings.psf_limits)
    text: str = psf.provenance["instrument_toml"]
    return text


def _arrays(context: Context, row: Thing) -> dict[str, NDArray[Any]]:
    """The image arrays of a product or PSF file, by name."""
    path = context.store.verified(row.file_sha256)
    if isinstance(row, ProductRow):
        return {"IMAGE": read_plane(path, context.limits), **read_planes(path)}
    psf = read_psf(path, context.settings.psf_limits)
    return {"PSF": psf.kernel, **psf.components}


def _save(context: Context, identity: str, request: ResolvedRerun, first: Thing, again: Thing) -> None:
    context.report("comparing", 0, 1)
    arrays, others = _arrays(context, first), _arrays(context, again)
    nothing = np.zeros((0, 0))
    compared = {
        name: compare(arrays.get(name, nothing), others.get(name, nothing)) for name in {**arrays, **others}
    }
    said = {
        "schema": SCHEMA,
        "of": request.of,
        "id": request.id,
        "sentence": _sentence(request, first, again, compared),
        "same": all(one.same for one in compared.values()),
        "same_file": first.file_sha256 == again.file_sha256,
        "largest_relative_difference": _largest(compared),
        "arrays": {name: dataclasses.asdict(one) for name, one in compared.items()},
        "first": _made(context, first),
        "again": _made(context, again) | {"id": again.id},
        "parameters": request.parameters,
    }
    with context.store.temporary() as text:
        write_json(text, said)
        named = ("of", "sentence", "same", "same_file", "largest_relative_difference")
        details = {name: said[name] for name in named} | {"output_sha256": again.file_sha256}
        context.report(
            "comparing", 1, 1
        )  # raises an exception if the job was cancelled, so that no report is kept
        add_report(context, identity, KIND, text=text, details=details, about_id=request.id)


def _made(context: Context, row: Thing) -> dict[str, Any]:
    made = lineage(context.catalogue, row).made
    assert isinstance(made, Made)
    told: dict[str, Any] = json.loads(made.model_dump_json(exclude={"parameters"}))
    return told


def _largest(compared: Mapping[str, Comparison]) -> float | None:
    """The largest relative difference of the arrays; None if an array differs in shape or missing values."""
    each = [one.largest_relative for one in compared.values()]
    return None if None in each else max((one for one in each if one is not None), default=0.0)


def _sentence(request: ResolvedRerun, first: Thing, again: Thing, compared: Mapping[str, Comparison]) -> str:
    what = "PSF" if request.of == "psf" else request.of
    if first.file_sha256 == again.file_sha256:
        return f"The new {what} is the same file, bit for bit."
    if all(one.same for one in compared.values()):
        return f"The new {what} has the same values, bit for bit; only the headers of the two files differ."
    differ = sorted(name for name, one in compared.items() if not one.same)
    largest = _largest(compared)
    by = "in shape or missing values" if largest is None else f"by at most {largest:.3g} of the largest value"
    return f"The new {what} differs {by}, in {', '.join(differ)}."
