"""Lineage of a product or a PSF: inputs, parameters, versions and jobs, back to the uploads.

The lineage of a product or PSF was recorded when it was made. A parent that was deleted later is still listed, by its
id.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field, ValidationError

from psfcore.errors import DataError
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow, ReportRow, TransitRow
from workers.contract.kinds import kind_of_origin
from workers.contract.requests import ResolvedRerun
from workers.versions.series import INTERPOLATED

MOST_DEEP = 16
MOST_THINGS = 200

Type = Literal["product", "psf", "image", "transit", "report", "instrument-file"]


class Made(BaseModel):
    """How a product, PSF, ... was made. A field is null if it was not recorded when the job ran."""

    created_at: float
    name: str | None = None
    version: str | None = None
    status: str | None = None
    origin: str | None = None
    file_sha256: str
    kind: str | None = Field(None, description="kind of the job that made it; null for an upload")
    job_id: str | None = Field(None, description="the job that made it; the job may have been deleted since")
    algorithm_version: int | None = None
    software_version: str | None = None
    libraries: dict[str, str] | None = None
    parameters: dict[str, Any] | None = None


class Ancestor(BaseModel):
    """A product, PSF, report, image, transit or instrument file, and its parents: the entries from which it was
    made."""

    type: Type
    id: str = Field(description="id; for an upload or an instrument file the SHA-256 of its bytes")
    there: bool = Field(
        description="whether the catalogue still contains the thing; false for an instrument file, because its text is in the PSF file"
    )
    made: Made | None = Field(None, description="null for an upload and for a deleted thing")
    weight: float | None = Field(
        None,
        description="the weight of this PSF in the PSF that was interpolated between it and another PSF; null for other parents",
    )
    parents: list[Ancestor] = []
    cut: bool = Field(
        False,
        description="true: the parents are left out here, because they are listed elsewhere in this answer or because there are too many things",
    )


def lineage(catalogue: Catalogue, row: ProductRow | PsfRow) -> Ancestor:
    """A product or PSF and its ancestors: at most MOST_DEEP generations and MOST_THINGS entries."""
    return _Walk(catalogue, row.owner).of_row(row, 0)


def made_by(catalogue: Catalogue, row: ProductRow | PsfRow) -> ResolvedRerun:
    """The parameters of the job that made a product or PSF; with them, the job can run again.

    Raises ``DataError`` "not-made-here" for an upload, "parameters-unknown" if the parameters were not recorded, and
    "parameters-outdated" if this version of the software does not accept them.
    """
    parameters = _parameters(row)
    if isinstance(row, PsfRow) and row.origin == "uploaded":
        raise DataError(
            "not-made-here",
            f"expected a PSF that this service made; PSF {row.id} was uploaded, so no job made it: choose a built or fitted PSF",
        )
    if parameters is None:
        raise DataError(
            "parameters-unknown",
            f"expected the parameters that {row.id} was made with; these parameters were not recorded: submit a new request "
            "instead",
        )
    try:
        return _job_of(row, parameters)
    except ValidationError as error:
        first = error.errors()[0]
        raise DataError(
            "parameters-outdated",
            f"expected parameters that this version accepts; {row.id} was made with others: "
            f"{'/'.join(map(str, first['loc']))}: {first['msg']}: submit a new request instead",
        ) from error


def _job_of(row: ProductRow | PsfRow, parameters: dict[str, Any]) -> ResolvedRerun:
    """The job with these parameters. The catalogue may contain only the parameters that the client gave; this function adds the defaults."""
    of: Literal["product", "psf"] = "product" if isinstance(row, ProductRow) else "psf"
    origin = _origin(row)
    kind = kind_of_origin(origin)
    assert kind.resolved is not None
    # A build also requires the text of the instrument file, which is in the file of the built PSF.
    if origin != "built":
        parameters = kind.resolved.model_validate(parameters).model_dump(mode="json")
    return ResolvedRerun(of=of, id=row.id, kind=kind.name, parameters=parameters)


def _origin(row: ProductRow | PsfRow) -> str:
    """The origin of a product or PSF, as ``workers.contract.kinds`` names it."""
    if isinstance(row, ProductRow):
        return "deconvolved"
    if row.origin in ("built", INTERPOLATED):
        return row.origin
    return "corrected" if "parents" in row.details else "fitted"


def _parameters(row: ProductRow | PsfRow) -> dict[str, Any] | None:
    said = row.details if isinstance(row, ProductRow) else _provenance(row)
    found: dict[str, Any] | None = said.get("parameters")
    return found


def _provenance(row: PsfRow) -> dict[str, Any]:
    found: dict[str, Any] = row.details.get("provenance") or {}
    return found


class _Walk:
    """One walk through a lineage. If an entry occurs twice, it is listed twice, but its parents are listed only
    once."""

    def __init__(self, catalogue: Catalogue, owner: str) -> None:
        self._catalogue, self._owner = catalogue, owner
        self._visited: set[str] = set()

    def of_row(self, row: ProductRow | PsfRow, depth: int) -> Ancestor:
        parents = _parents(row)
        enough = row.id in self._visited or depth >= MOST_DEEP or len(self._visited) >= MOST_THINGS
        self._visited.add(row.id)
        return Ancestor(
            type="product" if isinstance(row, ProductRow) else "psf",
            id=row.id,
            there=True,
            made=_made_of(row),
            parents=[]
            if enough
            else [self._weighted(row, self._parent(*parent, depth + 1)) for parent in parents],
            cut=enough and bool(parents),
        )

    @staticmethod
    def _weighted(row: ProductRow | PsfRow, parent: Ancestor) -> Ancestor:
        """The parent with its weight, if the PSF was interpolated from it."""
        weights: dict[str, float] = row.details.get("weights") or {}
        return parent.model_copy(update={"weight": weights.get(parent.id)})

    def _parent(self, kind: Type, identity: str, depth: int) -> Ancestor:
        match kind:
            case "psf":
                psf = self._catalogue.get(PsfRow, identity, self._owner)
                return (
                    Ancestor(type=kind, id=identity, there=False) if psf is None else self.of_row(psf, depth)
                )
            case "image":
                there = self._catalogue.get(ImageRow, identity, self._owner) is not None
            case "transit":
                there = self._catalogue.get(TransitRow, identity, self._owner) is not None
            case "report":
                there = self._catalogue.get(ReportRow, identity, self._owner) is not None
            case _:
                there = False
        return Ancestor(type=kind, id=identity, there=there)


def _parents(row: ProductRow | PsfRow) -> list[tuple[Type, str]]:
    """Type and id of each input from which a product or PSF was made."""
    if isinstance(row, ProductRow):
        return [("image", row.image_id), ("psf", row.psf_id)]
    provenance = _provenance(row)
    parameters = provenance.get("parameters") or {}
    found: list[tuple[Type, str]] = []
    named: dict[str, str] = row.details.get("parents") or {}
    if "transit_id" in row.details:
        found.append(("transit", row.details["transit_id"]))
    if "report" in named:
        found.append(("report", named["report"]))
    found += [("psf", named[name]) for name in ("psf", "before", "after") if name in named]
    if row.details.get("diffraction_psf_id") is not None:
        found.append(("psf", row.details["diffraction_psf_id"]))
    if provenance.get("instrument_file_sha256") is not None:
        found.append(("instrument-file", provenance["instrument_file_sha256"]))
    if parameters.get("mask_id") is not None:
        found.append(("image", parameters["mask_id"]))
    return found


def _made_of(row: ProductRow | PsfRow) -> Made:
    said = {**_provenance(row), **row.details} if isinstance(row, PsfRow) else row.details
    written = {
        name: said.get(name) for name in ("job_id", "algorithm_version", "software_version", "libraries")
    }
    uploaded = isinstance(row, PsfRow) and row.origin == "uploaded"
    written["kind"] = None if uploaded else kind_of_origin(_origin(row)).name
    if isinstance(row, ProductRow):
        return Made(
            created_at=row.created_at, file_sha256=row.file_sha256, parameters=_parameters(row), **written
        )
    return Made(
        created_at=row.created_at,
        name=row.name,
        version=row.version,
        status=row.status,
        origin=row.origin,
        file_sha256=row.file_sha256,
        parameters=_parameters(row),
        **written,
    )
