"""Lineage of a product or a PSF: inputs, parameters, versions and jobs, back to the uploads; also as W3C PROV.

The lineage of a product or PSF was recorded when it was made. A parent that was deleted later is still listed, by its
id.

Citation: PROV-DM (W3C, 30 April 2013); PROV-N and PROV-JSON; IVOA ProvenanceDM 1.0 (11 April 2020), whose terms the
document uses.

| in the lineage | in PROV | identifier |
|---|---|---|
| product, PSF, image, transit, report, instrument file | entity, ``voprov:DatasetEntity`` | its id: a SHA-256 |
| job | activity | the id of the job |
| job kind and version of its algorithm | plan, ``voprov:ActivityDescription`` | kind and version |
| parameter of a job | entity, ``voprov:Parameter``, which influenced the activity | job and name |
| owner | agent, role ``owner`` of entities and ``operator`` of activities | name |
| heliopsf and its libraries | software agent | version, and a hash of the versions of the libraries |

A thing whose job was not recorded has an activity of its own. An upload has no activity.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal, get_args

from pydantic import BaseModel, Field, ValidationError

from psfcore.errors import DataError
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow, ReportRow, TransitRow
from workers.contract.identities import canonical_hash
from workers.contract.kinds import kind_of_origin
from workers.contract.requests import ResolvedRerun
from workers.versions import INTERPOLATED

if TYPE_CHECKING:
    from prov.identifier import QualifiedName
    from prov.model import ProvDocument

    Attribute = QualifiedName | datetime | str | bool | None

MOST_DEEP = 16
MOST_THINGS = 200

Type = Literal["product", "psf", "image", "transit", "report", "instrument-file"]


class Creation(BaseModel):
    """How a product, PSF, ... was made. A field is null if it was not recorded when the job ran."""

    created_at: float
    name: str | None = None
    version: str | None = None
    status: str | None = None
    doi: str | None = Field(None, description="DOI of the publication of a PSF, if its file names one")
    citation: str | None = Field(None, description="publication of a PSF, if its file names one")
    origin: str | None = None
    file_sha256: str
    kind: str | None = Field(None, description="kind of the job that made it; null for an upload")
    job_id: str | None = Field(None, description="the job that made it; the job may have been deleted since")
    algorithm_version: int | None = None
    software_version: str | None = None
    libraries: dict[str, str] | None = None
    parameters: dict[str, object] | None = None


class Ancestor(BaseModel):
    """A product, PSF, report, image, transit or instrument file, and its parents: the entries from which it was
    made.
    """

    type: Type
    id: str = Field(description="id; for an upload or an instrument file the SHA-256 of its bytes")
    there: bool = Field(
        description="whether the catalogue still contains the thing; false for an instrument file, because its text "
        "is in the PSF file"
    )
    made: Creation | None = Field(None, description="null for an upload and for a deleted thing")
    weight: float | None = Field(
        None,
        description="the weight of this PSF in the PSF that was interpolated between it and another PSF; null for "
        "other parents",
    )
    parents: list[Ancestor] = []
    cut: bool = Field(
        False,
        description="true: the parents are left out here, because they are listed elsewhere in this answer or because "
        "there are too many things",
    )


def lineage(catalogue: Catalogue, row: ProductRow | PsfRow) -> Ancestor:
    """A product or PSF and its ancestors: at most MOST_DEEP generations and MOST_THINGS entries."""
    return _Walk(catalogue, row.owner).entry(row, 0)


def made_by(catalogue: Catalogue, row: ProductRow | PsfRow) -> ResolvedRerun:
    """The parameters of the job that made a product or PSF; with them, the job can run again.

    Raises ``DataError`` "not-made-here" for an upload, "parameters-unknown" if the parameters were not recorded, and
    "parameters-outdated" if this version of the software does not accept them.
    """
    parameters = _parameters(row)
    if isinstance(row, PsfRow) and row.origin == "uploaded":
        raise DataError(
            "not-made-here",
            f"expected a PSF that this service made; PSF {row.id} was uploaded, so no job made it: choose a built or "
            "fitted PSF",
        )
    if parameters is None:
        raise DataError(
            "parameters-unknown",
            f"expected the parameters that {row.id} was made with; these parameters were not recorded: submit a new "
            "request instead",
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


def _job_of(row: ProductRow | PsfRow, parameters: dict[str, object]) -> ResolvedRerun:
    """The job with these parameters. The catalogue may contain only the parameters that the client gave; this function
    adds the defaults.
    """
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
    details = row.details if isinstance(row, ProductRow) else _provenance(row)
    parameters: dict[str, Any] | None = details.get("parameters")
    return parameters


def _provenance(row: PsfRow) -> dict[str, Any]:
    return row.details.get("provenance") or {}


# The tables of the entries that a row of the catalogue can be.
_TABLES: dict[Type, Any] = {"psf": PsfRow, "image": ImageRow, "transit": TransitRow, "report": ReportRow}


class _Walk:
    """One walk through a lineage. If an entry occurs twice, it is listed twice, but its parents are listed only
    once.
    """

    def __init__(self, catalogue: Catalogue, owner: str) -> None:
        self._catalogue, self._owner = catalogue, owner
        self._visited: set[str] = set()

    def entry(self, row: ProductRow | PsfRow, depth: int) -> Ancestor:
        parents = _parents(row)
        enough = row.id in self._visited or depth >= MOST_DEEP or len(self._visited) >= MOST_THINGS
        self._visited.add(row.id)
        weights: dict[str, float] = row.details.get("weights") or {}  # of an interpolated PSF
        return Ancestor(
            type="product" if isinstance(row, ProductRow) else "psf",
            id=row.id,
            there=True,
            made=_made_of(row),
            parents=[] if enough else [self._parent(*one, depth + 1, weights.get(one[1])) for one in parents],
            cut=enough and bool(parents),
        )

    def _parent(self, kind: Type, identity: str, depth: int, weight: float | None) -> Ancestor:
        table = _TABLES.get(kind)
        row = None if table is None else self._catalogue.get(table, identity, self._owner)
        if isinstance(row, PsfRow):
            return self.entry(row, depth).model_copy(update={"weight": weight})
        return Ancestor(type=kind, id=identity, there=row is not None, weight=weight)


def _parents(row: ProductRow | PsfRow) -> list[tuple[Type, str]]:
    """Type and id of each input from which a product or PSF was made."""
    if isinstance(row, ProductRow):
        return [("image", row.image_id), ("psf", row.psf_id)]
    provenance = _provenance(row)
    parameters = provenance.get("parameters") or {}
    named: dict[str, str] = row.details.get("parents") or {}
    inputs: tuple[tuple[Type, str | None], ...] = (
        ("transit", row.details.get("transit_id")),
        ("report", named.get("report")),
        *(("psf", named.get(name)) for name in ("psf", "before", "after")),
        ("psf", row.details.get("diffraction_psf_id")),
        ("instrument-file", provenance.get("instrument_file_sha256")),
        ("image", parameters.get("mask_id")),
    )
    return [(kind, identity) for kind, identity in inputs if identity is not None]


def _made_of(row: ProductRow | PsfRow) -> Creation:
    details = _provenance(row) | row.details if isinstance(row, PsfRow) else row.details
    cards = row.details.get("cards") or {}
    columns = (
        "created_at",
        "file_sha256",
        "name",
        "version",
        "status",
        "origin",
    )  # a product has only the first two
    entries = ("job_id", "algorithm_version", "software_version", "libraries")
    uploaded = isinstance(row, PsfRow) and row.origin == "uploaded"
    return Creation(
        kind=None if uploaded else kind_of_origin(_origin(row)).name,
        parameters=_parameters(row),
        doi=cards.get("PSFDOI"),
        citation=cards.get("PSFREF"),
        **{name: getattr(row, name, None) for name in columns},
        **{name: details.get(name) for name in entries},
    )


# W3C PROV -------------------------------------------------------------------------------------------

NAMES = "urn:heliopsf:"
VOPROV = "http://www.ivoa.net/documents/ProvenanceDM/index.html#"  # as the package voprov writes it
Format = Literal["json", "provn"]
PREFIXES = (*get_args(Type), "job", "kind", "parameter", "owner", "software")
SHOWN_HASH = 12


def provenance_text(catalogue: Catalogue, row: ProductRow | PsfRow, form: Format) -> str:
    """The lineage of a product or PSF as PROV-JSON or PROV-N."""
    document = provenance(catalogue, row)
    text = document.get_provn() if form == "provn" else document.serialize(format="json", indent=1)
    return f"{text}\n"


def provenance(catalogue: Catalogue, row: ProductRow | PsfRow) -> ProvDocument:
    """The lineage of a product or PSF, as far as ``lineage`` follows it."""
    document = _Document(catalogue, row.owner)
    document.add(lineage(catalogue, row))
    return document.prov


class _Document:
    """A document that is filled entry by entry. Every entity, activity and agent is declared once."""

    def __init__(self, catalogue: Catalogue, owner: str) -> None:
        from prov.model import ProvDocument  # half a second, which only requests for provenance need

        self.prov = ProvDocument()
        self.prov.add_namespace("voprov", VOPROV)
        self.prov.add_namespace("heliopsf", NAMES)
        for prefix in PREFIXES:
            self.prov.add_namespace(prefix, f"{NAMES}{prefix}:")
        self._catalogue, self._declared = catalogue, set[str]()
        self._owner = f"owner:{owner}"
        self.prov.agent(self._owner, {"voprov:name": owner, "prov:label": owner})

    def add(self, one: Ancestor) -> str:
        """Declare an entry with its ancestors; returns the name of its entity."""
        name = f"{one.type}:{one.id}"
        if self._new(name):
            self.prov.entity(name, _entity_attributes(one, self.prov))
            self.prov.wasAttributedTo(name, self._owner, other_attributes={"voprov:role": "owner"})
        if one.made is None or one.made.kind is None:
            return name
        activity = self._activity(one, one.made)
        if self._new(f"{name} by {activity}"):
            self.prov.wasGeneratedBy(name, activity, _time(one.made.created_at))
        for parent in one.parents:
            above = self.add(parent)
            if not self._new(f"{name} from {above}"):
                continue
            weight = [] if parent.weight is None else [("heliopsf:weight", parent.weight)]
            self.prov.used(activity, above, other_attributes=[("prov:role", parent.type), *weight])
            self.prov.wasDerivedFrom(name, above, activity)
        return name

    def _activity(self, one: Ancestor, made: Creation) -> str:
        """The activity that made an entry, with its plan, parameters and agents."""
        job_id = made.job_id or f"of-{one.id}"
        name, plan = f"job:{job_id}", f"kind:{made.kind}"
        if made.algorithm_version is not None:
            plan = f"{plan}-{made.algorithm_version}"
        if not self._new(name):
            return name
        job = None if made.job_id is None else self._catalogue.jobs.get(made.job_id)
        started = None if job is None or job.started_at is None else _time(job.started_at)
        ended = _time(made.created_at) if job is None or job.ended_at is None else _time(job.ended_at)
        self.prov.activity(name, started, ended, {"voprov:name": made.kind, "prov:label": made.kind})
        if self._new(plan):
            types = [("prov:type", self._named(one)) for one in ("prov:Plan", "voprov:ActivityDescription")]
            number = made.algorithm_version
            version = [] if number is None else [("voprov:version", str(number))]
            self.prov.entity(plan, [*types, ("voprov:name", made.kind), *version])
        self.prov.wasAssociatedWith(
            name, self._software(made), plan, other_attributes={"prov:role": "software"}
        )
        self.prov.wasAssociatedWith(name, self._owner, other_attributes={"prov:role": "operator"})
        for key, value in sorted((made.parameters or {}).items()):
            self._parameter(name, f"parameter:{job_id}.{key}", key, value)
        return name

    def _software(self, made: Creation) -> str:
        """The agent for the version of heliopsf and of its libraries."""
        version, libraries = made.software_version or "unknown", made.libraries or {}
        name = f"software:heliopsf-{version}"
        if libraries:
            name = f"{name}-{canonical_hash(libraries)[:SHOWN_HASH]}"
        if self._new(name):
            used = [("heliopsf:library", f"{one} {number}") for one, number in sorted(libraries.items())]
            kind = ("prov:type", self._named("prov:SoftwareAgent"))
            self.prov.agent(name, [kind, ("voprov:name", "heliopsf"), ("heliopsf:version", version), *used])
        return name

    def _parameter(self, activity: str, name: str, key: str, value: object) -> None:
        text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
        kind = self._named("voprov:Parameter")
        self.prov.entity(name, {"prov:type": kind, "voprov:name": key, "prov:value": text})
        self.prov.wasInfluencedBy(
            activity, name, other_attributes={"prov:type": self._named("voprov:WasConfiguredBy")}
        )

    def _named(self, name: str) -> QualifiedName | None:
        return self.prov.valid_qualified_name(name)

    def _new(self, name: str) -> bool:
        """Whether this name was not declared before; it counts as declared afterwards."""
        new = name not in self._declared
        self._declared.add(name)
        return new


def _entity_attributes(one: Ancestor, document: ProvDocument) -> dict[str, Attribute]:
    made = one.made
    digest = one.id if made is None else made.file_sha256
    # The ids of uploads and instrument files are the SHA-256 of their bytes; that of a deleted result is not.
    known = made is not None or one.type in ("image", "transit", "instrument-file")
    attributes: dict[str, Attribute] = {
        "prov:type": document.valid_qualified_name("voprov:DatasetEntity"),
        "prov:label": f"{one.type} {one.id[:SHOWN_HASH]}",
        "heliopsf:sha256": digest if known else None,
        "heliopsf:deleted": True if not one.there and one.type != "instrument-file" else None,
    }
    if made is not None:
        attributes |= {
            "voprov:generatedAtTime": _time(made.created_at),
            "voprov:name": made.name,
            "heliopsf:version": made.version,
            "heliopsf:status": made.status,
            "heliopsf:origin": made.origin,
        }
    return {key: value for key, value in attributes.items() if value is not None}


def _time(at: float) -> datetime:
    return datetime.fromtimestamp(at, UTC)
