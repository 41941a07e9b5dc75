"""Where a product or a PSF came from: inputs, parameters, versions and jobs, back to what was uploaded.

What is told is what was written down when each thing was made. Things that are gone are named all the same.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field, ValidationError

from psfcore.errors import DataError
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, JobRow, ProductRow, PsfRow, ReportRow, TransitRow
from workers.contract.contract import ResolvedDeconvolve, ResolvedGapDiagnose, ResolvedPsfFit, ResolvedRerun

MOST_DEEP = 16
MOST_THINGS = 200

Type = Literal["product", "psf", "image", "transit", "report", "instrument-file"]


class Made(BaseModel):
    """How a thing was made; null is what was not written down when it was."""

    created_at: float
    name: str | None = None
    version: str | None = None
    status: str | None = None
    origin: str | None = None
    file_sha256: str
    job_id: str | None = Field(
        None, description="the job that made it; jobs may be destroyed, what they made stays"
    )
    algorithm_version: int | None = None
    software_version: str | None = None
    libraries: dict[str, str] | None = None
    parameters: dict[str, Any] | None = None


class Ancestor(BaseModel):
    """A thing and what it was made from."""

    type: Type
    id: str = Field(description="of an upload and of an instrument file the SHA-256 of its bytes")
    there: bool = Field(
        description="whether the catalogue still holds it; an instrument file is in its PSF's file"
    )
    made: Made | None = Field(None, description="null for what was uploaded as it is, or is gone")
    parents: list[Ancestor] = []
    cut: bool = Field(
        False, description="true where it has parents that are told elsewhere, or not at all: too many"
    )


def lineage(catalogue: Catalogue, row: ProductRow | PsfRow) -> Ancestor:
    """A thing with all that it came from, MOST_DEEP generations and MOST_THINGS things at most."""
    return _Telling(catalogue, row.owner).of_row(row, 0)


def made_by(catalogue: Catalogue, row: ProductRow | PsfRow) -> ResolvedRerun:
    """The job that made a thing, as one could ask for it again.

    Raises ``DataError`` "not-made-here" for an upload, "parameters-unknown" where nobody wrote them down, and
    "parameters-outdated" where this version does not take them.
    """
    parameters = _parameters(row)
    if parameters is None and row.details.get("job_id"):
        job = catalogue.jobs.get(row.details["job_id"])
        parameters = job.parameters if job is not None and _made(job, row) else None
    if isinstance(row, PsfRow) and row.origin == "uploaded":
        raise DataError("not-made-here", f"PSF {row.id} was uploaded: there is nothing to run again")
    if parameters is None:
        raise DataError(
            "parameters-unknown",
            f"expected the parameters that {row.id} was made with; they were not written down, and its job is gone",
        )
    try:
        return _job_of(row, parameters)
    except ValidationError as error:
        first = error.errors()[0]
        raise DataError(
            "parameters-outdated",
            f"{row.id} was made with parameters that this version does not take: "
            f"{'/'.join(map(str, first['loc']))}: {first['msg']}",
        ) from error


def _job_of(row: ProductRow | PsfRow, parameters: dict[str, Any]) -> ResolvedRerun:
    """The job with these parameters; what was written down is what somebody had said, a job has the rest too."""
    if isinstance(row, ProductRow):
        whole = ResolvedDeconvolve.model_validate(parameters).model_dump(mode="json")
        return ResolvedRerun(of="product", id=row.id, kind="deconvolve", parameters=whole)
    if row.origin == "built":
        return ResolvedRerun(of="psf", id=row.id, kind="psf-build", parameters=parameters)
    if "parents" in row.details:
        whole = ResolvedGapDiagnose.model_validate(parameters).model_dump(mode="json")
        return ResolvedRerun(of="psf", id=row.id, kind="gap-diagnose", parameters=whole)
    whole = ResolvedPsfFit.model_validate(parameters).model_dump(mode="json")
    return ResolvedRerun(of="psf", id=row.id, kind="psf-fit", parameters=whole)


def _made(job: JobRow, row: ProductRow | PsfRow) -> bool:
    return job.owner == row.owner and job.result_id == row.id


def _parameters(row: ProductRow | PsfRow) -> dict[str, Any] | None:
    said = row.details if isinstance(row, ProductRow) else _provenance(row)
    found: dict[str, Any] | None = said.get("parameters")
    return found


def _provenance(row: PsfRow) -> dict[str, Any]:
    found: dict[str, Any] = row.details.get("provenance") or {}
    return found


class _Telling:
    """One telling of a lineage: things that were told are named again, but not told again."""

    def __init__(self, catalogue: Catalogue, owner: str) -> None:
        self._catalogue, self._owner = catalogue, owner
        self._told: set[str] = set()

    def of_row(self, row: ProductRow | PsfRow, depth: int) -> Ancestor:
        parents = _parents(row)
        enough = row.id in self._told or depth >= MOST_DEEP or len(self._told) >= MOST_THINGS
        self._told.add(row.id)
        return Ancestor(
            type="product" if isinstance(row, ProductRow) else "psf",
            id=row.id,
            there=True,
            made=_made_of(row),
            parents=[] if enough else [self._parent(*parent, depth + 1) for parent in parents],
            cut=enough and bool(parents),
        )

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
    """What a thing was made from, by type and id."""
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
    if "psf" in named:
        found.append(("psf", named["psf"]))
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
