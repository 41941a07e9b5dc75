"""The lineage of a product or PSF as W3C PROV, with terms of the IVOA Provenance Data Model.

Citation: PROV-DM (W3C, 30 April 2013); PROV-N and PROV-JSON; IVOA ProvenanceDM 1.0 (11 April 2020).

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
from typing import TYPE_CHECKING, Any, Literal

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ProductRow, PsfRow
from workers.contract.identities import canonical_hash
from workers.lineage import Ancestor, Made, lineage

if TYPE_CHECKING:
    from prov.model import ProvDocument

NAMES = "urn:heliopsf:"
VOPROV = "http://www.ivoa.net/documents/ProvenanceDM/index.html#"  # as the package voprov writes it
Format = Literal["json", "provn"]
TYPES = ("product", "psf", "image", "transit", "report", "instrument-file")
PREFIXES = (*TYPES, "job", "kind", "parameter", "owner", "software")
SHOWN_HASH = 12


def provenance_text(catalogue: Catalogue, row: ProductRow | PsfRow, form: Format) -> str:
    """The lineage of a product or PSF as PROV-JSON or PROV-N."""
    document = provenance(catalogue, row)
    text = document.get_provn() if form == "provn" else document.serialize(format="json", indent=1)
    return f"{text}\n"


def provenance(catalogue: Catalogue, row: ProductRow | PsfRow) -> ProvDocument:
    """The lineage of a product or PSF, as far as ``workers.lineage`` follows it."""
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
            told: dict[Any, Any] = {"prov:role": parent.type}
            if parent.weight is not None:
                told["heliopsf:weight"] = parent.weight
            self.prov.used(activity, above, other_attributes=told)
            self.prov.wasDerivedFrom(name, above, activity)
        return name

    def _activity(self, one: Ancestor, made: Made) -> str:
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
        self._declare_plan(plan, made)
        self.prov.wasAssociatedWith(
            name, self._software(made), plan, other_attributes={"prov:role": "software"}
        )
        self.prov.wasAssociatedWith(name, self._owner, other_attributes={"prov:role": "operator"})
        for key, value in sorted((made.parameters or {}).items()):
            self._parameter(name, f"parameter:{job_id}.{key}", key, value)
        return name

    def _declare_plan(self, plan: str, made: Made) -> None:
        if self._new(plan):
            types = [
                ("prov:type", self._named("prov:Plan")),
                ("prov:type", self._named("voprov:ActivityDescription")),
            ]
            version = (
                [] if made.algorithm_version is None else [("voprov:version", str(made.algorithm_version))]
            )
            self.prov.entity(plan, [*types, ("voprov:name", made.kind), *version])

    def _software(self, made: Made) -> str:
        """The agent for the version of heliopsf and of its libraries."""
        version, libraries = made.software_version or "unknown", made.libraries or {}
        name = f"software:heliopsf-{version}"
        if libraries:
            name = f"{name}-{canonical_hash(libraries)[:SHOWN_HASH]}"
        if self._new(name):
            told = [
                ("heliopsf:library", f"{library} {number}") for library, number in sorted(libraries.items())
            ]
            kind = ("prov:type", self._named("prov:SoftwareAgent"))
            self.prov.agent(name, [kind, ("voprov:name", "heliopsf"), ("heliopsf:version", version), *told])
        return name

    def _parameter(self, activity: str, name: str, key: str, value: Any) -> None:
        text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
        kind = self._named("voprov:Parameter")
        self.prov.entity(name, {"prov:type": kind, "voprov:name": key, "prov:value": text})
        self.prov.wasInfluencedBy(
            activity, name, other_attributes={"prov:type": self._named("voprov:WasConfiguredBy")}
        )

    def _named(self, name: str) -> Any:
        return self.prov.valid_qualified_name(name)

    def _new(self, name: str) -> bool:
        """Whether this name was not declared before; it counts as declared afterwards."""
        found = name not in self._declared
        self._declared.add(name)
        return found


def _entity_attributes(one: Ancestor, document: ProvDocument) -> dict[str, Any]:
    made = one.made
    digest = one.id if made is None else made.file_sha256
    # The ids of uploads and instrument files are the SHA-256 of their bytes; that of a deleted result is not.
    known = made is not None or one.type in ("image", "transit", "instrument-file")
    told: dict[str, Any] = {
        "prov:type": document.valid_qualified_name("voprov:DatasetEntity"),
        "prov:label": f"{one.type} {one.id[:SHOWN_HASH]}",
        "heliopsf:sha256": digest if known else None,
        "heliopsf:deleted": True if not one.there and one.type != "instrument-file" else None,
    }
    if made is not None:
        told |= {
            "voprov:generatedAtTime": _time(made.created_at),
            "voprov:name": made.name,
            "heliopsf:version": made.version,
            "heliopsf:status": made.status,
            "heliopsf:origin": made.origin,
        }
    return {key: value for key, value in told.items() if value is not None}


def _time(at: float) -> datetime:
    return datetime.fromtimestamp(at, UTC)
