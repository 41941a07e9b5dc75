"""The task ``rerun``: makes a product or a PSF again from its stored parameters, and compares it with the first one.

The rows of products and PSFs in the catalogue are not changed: only the report refers to the new file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Comparison, compare
from psfcore.errors import DataError
from psfcore.fits.images import read_plane, read_planes
from workers.catalogue.catalogue import Row
from workers.catalogue.tables import ProductRow, PsfRow
from workers.contract.identities import rerun_identity
from workers.contract.kinds import KINDS, ResultType
from workers.contract.requests import ResolvedRerun
from workers.lineage import Creation, lineage
from workers.tasks.catalogue_workspace import CatalogueWorkspace, ResultRow
from workers.tasks.results import report_result

KIND = "rerun"
SCHEMA = 1
Thing = ProductRow | PsfRow


@dataclass(frozen=True)
class RerunWorkspace(CatalogueWorkspace):
    """A workspace in which the results in `hidden` do not exist, so that a task makes them again. The rows of new
    results are in `rows` and not in the catalogue.
    """

    hidden: frozenset[str] = frozenset()
    rows: list[ResultRow] = field(default_factory=list)

    def row(self, table: type[Row], identity: str) -> Row:
        for row in self.rows:
            if isinstance(row, table) and row.id == identity:
                return row
        return super().row(table, identity)

    def has(self, result: ResultType, identity: str) -> bool:
        return identity not in self.hidden and super().has(result, identity)

    def add_row(self, row: Any) -> ResultRow:
        self.rows.append(row)
        return self.rows[-1]


def rerun(workspace: CatalogueWorkspace, parameters: Mapping[str, object]) -> str:
    """Make a product or a PSF again, and compare it with the first one; returns the report's id."""
    request = ResolvedRerun.model_validate(parameters)
    identity = rerun_identity(request, workspace.job_id)
    if workspace.has(ResultType.REPORT, identity):
        return identity
    of_psf = request.of == "psf"
    first = workspace.row(PsfRow, request.id) if of_psf else workspace.row(ProductRow, request.id)
    again = _made_again(workspace, request, first)
    _save(workspace, identity, request, first, again)
    return identity


def _made_again(workspace: CatalogueWorkspace, request: ResolvedRerun, first: Thing) -> Thing:
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
    if request.kind == "psf-build":
        parameters |= {"instrument": None, "instrument_file": _instrument_text(workspace, first)}
    again = RerunWorkspace(**vars(workspace) | {"anew": True}, hidden=frozenset(hidden))
    kind.load_task()(again, parameters)
    # The last row is the requested product or PSF. The rows before it had been deleted and were needed again.
    made = [row for row in again.rows if isinstance(row, type(first))]
    if not made:
        raise DataError(
            "not-made-again",
            f"expected the rerun to make a {request.of}; it made no {request.of}: compare the versions of software "
            "and libraries in the lineage",
        )
    found = made[-1]
    assert isinstance(found, ProductRow | PsfRow)
    return found


def _instrument_text(workspace: CatalogueWorkspace, first: Thing) -> str:
    """The text of the instrument file that the first run used, because shipped files can change with the software."""
    assert isinstance(first, PsfRow)
    text: str = workspace.psf_of(first).provenance["instrument_toml"]
    return text


def _arrays(workspace: CatalogueWorkspace, row: Thing) -> dict[str, NDArray[np.generic]]:
    """The image arrays of a product or PSF file, by name."""
    if isinstance(row, PsfRow):
        psf = workspace.psf_of(row)
        terms = {f"FIELD {one.x_power} {one.y_power}": one.kernel for one in psf.field_terms}
        return {"PSF": psf.kernel, **psf.components, **terms}
    path = workspace.store.verified(row.file_sha256)
    return {"IMAGE": read_plane(path, workspace.limits), **read_planes(path)}


def _save(
    workspace: CatalogueWorkspace, identity: str, request: ResolvedRerun, first: Thing, again: Thing
) -> None:
    workspace.report("comparing", 0, 1)
    arrays, others = _arrays(workspace, first), _arrays(workspace, again)
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
        "first": _made(workspace, first),
        "again": _made(workspace, again) | {"id": again.id},
        "parameters": request.parameters,
    }
    named = ("of", "sentence", "same", "same_file", "largest_relative_difference")
    details = {name: said[name] for name in named} | {"output_sha256": again.file_sha256}
    # This raises an exception if the job was cancelled, so that no report is kept.
    workspace.report("comparing", 1, 1)
    workspace.add(report_result(identity, KIND, said, details, about_id=request.id))


def _made(workspace: CatalogueWorkspace, row: Thing) -> dict[str, object]:
    made = lineage(workspace.catalogue, row).made
    assert isinstance(made, Creation)
    return made.model_dump(mode="json", exclude={"parameters"})


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
