"""What the service answers, for type checkers: JSON as dictionaries with known keys.

The models of the service, such as `service.views.JobView`, say what each value means; docs/http.md shows them. A test
compares the keys and the types here with the OpenAPI document. The forms that the service uses itself come first.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias, TypeVar

from pydantic import Field
from typing_extensions import TypedDict

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
AnyAnswer = TypeVar("AnyAnswer")
ByComponent = dict[str, list[float]]


class PsfSaid(TypedDict):
    """The fields that every answer has: the PSF, and properties of its array."""

    name: str
    version: str
    shape: list[int]
    sum_on_array: float
    central_weight: float
    reach_px: float
    plate_scale_arcsec: float | None


class CurveAnswer(PsfSaid):
    """1 - encircled energy at the given radii, in percent, for the total PSF (TOTAL) and each component."""

    radii_px: list[float]
    light_beyond_pct: ByComponent
    sigma_points: Annotated[ByComponent, Field(description="1-sigma errors; only for a fitted PSF")]
    resolution: Annotated[
        str, Field(description="resolution of the table, and the largest error of the interpolation")
    ]


class ProfileAnswer(PsfSaid):
    """Mean weight of the pixels of each ring."""

    radius_px: list[float]
    pixels: list[int]
    mean_weight: ByComponent
    sigma: Annotated[ByComponent, Field(description="1-sigma errors; only for a fitted PSF")]
    azimuthal_rms_over_mean: Annotated[
        list[float], Field(description="rms variation of TOTAL along a ring, divided by its mean on the ring")
    ]
    resolution: str


class EncircledAnswer(PsfSaid):
    """Encircled energy: the fraction of the light within a radius."""

    radius_px: float
    light_within: dict[str, float]
    sigma: dict[str, float]
    resolution: str


class AnnulusAnswer(PsfSaid):
    """The fraction of the light between two radii."""

    inner_px: float
    outer_px: float
    light: dict[str, float]
    sigma: dict[str, float]
    resolution: str


class ComparisonAnswer(TypedDict):
    """Differences between two PSFs: `other` minus `one`."""

    one: PsfSaid
    other: PsfSaid
    radii_px: list[float]
    difference_points: Annotated[
        ByComponent, Field(description="difference of the light beyond each radius, in percentage points")
    ]
    sigma_points: ByComponent
    largest_points: dict[str, float]
    difference_of_sums: float
    difference_of_central_weights: float
    only_in_one: list[str]
    only_in_other: list[str]
    resolution: str


class HduHeader(TypedDict):
    """The header of one HDU of a FITS file."""

    index: Annotated[int, Field(description="number of the HDU, counted from 0")]
    name: Annotated[str, Field(description="EXTNAME; empty: the HDU has no name")]
    cards: Annotated[
        list[tuple[str, str | int | float | bool | None, str]],
        Field(
            description="keyword, value and comment of each card, in the order of the file; value null: the card "
            "has no value"
        ),
    ]


# --- forms of models of the service ------------------------------------------------------------------------

Uploaded = TypedDict("Uploaded", {"id": str})
Submitted = TypedDict("Submitted", {"id": str, "kind": str})
Ended = TypedDict("Ended", {"result": str | None})
Identified = TypedDict("Identified", {"parameters": dict[str, object], "result_id": str})
Fault = TypedDict("Fault", {"code": str, "fault": str, "message": str})
JobProgress = TypedDict(
    "JobProgress",
    {"share": float | None, "stage": str, "step": int, "steps": int, "time_left_s": float | None},
)
Estimate = TypedDict("Estimate", {"memory_mib": int, "seconds": float})
Job = TypedDict(
    "Job",
    {
        "attempt": int,
        "cancel_requested": bool,
        "created_at": float,
        "ended_at": float | None,
        "error": Fault | None,
        "estimate": Estimate | None,
        "id": str,
        "kind": str,
        "parameters": dict[str, object],
        "phase": str,
        "progress": JobProgress,
        "queue": str,
        "result": str | None,
        "result_deleted": bool,
        "started_at": float | None,
        "waiting_before": int | None,
    },
)
ChosenPsf = TypedDict("ChosenPsf", {"id": str, "name": str, "status": str | None, "version": str, "why": str})
JobEstimate = TypedDict(
    "JobEstimate",
    {
        "estimate": Estimate,
        "existing": str | None,
        "parameters": dict[str, object],
        "psf": ChosenPsf | None,
        "queue": str,
        "result_id": str,
        "waiting_before": int,
    },
)
Product = TypedDict(
    "Product",
    {
        "bytes": int,
        "changes": str | None,
        "created_at": float,
        "details": dict[str, Any],
        "file": str,
        "id": str,
        "image_id": str,
        "kind": str,
        "preview": str,
        "psf_id": str,
        "psf_version": str,
        "sha256": str,
        "thumbnail": str | None,
    },
)
Psf = TypedDict(
    "Psf",
    {
        "bytes": int,
        "channel": str | None,
        "created_at": float,
        "details": dict[str, Any],
        "file": str,
        "id": str,
        "instrument": str | None,
        "kind": str,
        "name": str,
        "origin": str,
        "preview": str | None,
        "report": str | None,
        "status": str,
        "successor": str | None,
        "valid_from": str | None,
        "valid_to": str | None,
        "version": str,
        "was_certified": bool,
    },
)
Report = TypedDict(
    "Report",
    {
        "about_id": str | None,
        "bytes": int,
        "created_at": float,
        "details": dict[str, Any],
        "file": str,
        "html": str | None,
        "id": str,
        "kind": str,
        "output": str | None,
        "preview": str | None,
        "transit_id": str | None,
    },
)
Image = TypedDict(
    "Image",
    {"bytes": int, "created_at": float, "filename": str | None, "header": dict[str, object], "id": str},
)
Noise = TypedDict("Noise", {"photon_gain_dn": float, "read_noise_dn": float})
Pointing = TypedDict("Pointing", {"fov": int, "images": int})
TransitFile = TypedDict("TransitFile", {"bytes": int, "name": str})
Transit = TypedDict(
    "Transit",
    {
        "archive": str,
        "bytes": int,
        "created_at": float,
        "filename": str | None,
        "files": list[TransitFile],
        "id": str,
        "images": int,
        "instrument": str | None,
        "known_psf": str | None,
        "noise": Noise | None,
        "pointings": list[Pointing],
        "unpacked_bytes": int,
    },
)
Counts = TypedDict(
    "Counts",
    {
        "at_work": int,
        "done": int,
        "failed": int,
        "reused": int,
        "to_look_at": int,
        "total": int,
        "waiting": int,
    },
)
Bulk = TypedDict(
    "Bulk",
    {
        "context_id": str | None,
        "created_at": float,
        "ended_at": float | None,
        "error": Fault | None,
        "events": str,
        "failures": str,
        "id": str,
        "images": Counts,
        "images_an_hour": float | None,
        "listed": bool,
        "name": str,
        "phase": str,
        "psf_id": str | None,
        "request": dict[str, object],
        "results": str,
        "time_left_s": float | None,
    },
)
BulkLine = TypedDict(
    "BulkLine",
    {
        "created_at": float,
        "done": int,
        "ended_at": float | None,
        "failed": int,
        "id": str,
        "listed": bool,
        "name": str,
        "phase": str,
        "total": int,
    },
)
BulkFailure = TypedDict(
    "BulkFailure", {"attempts": int, "ended_at": float | None, "error": Fault, "position": int, "source": str}
)
RefusedImage = TypedDict("RefusedImage", {"error": Fault, "source": str})
BulkEstimate = TypedDict(
    "BulkEstimate",
    {
        "complete": bool,
        "examined": int,
        "example_output": str | None,
        "existing": int,
        "images": int,
        "memory_mib": int,
        "output_bytes": int,
        "refused": list[RefusedImage],
        "refused_images": int,
        "seconds": float,
        "workers": int,
    },
)
StatusChange = TypedDict(
    "StatusChange",
    {
        "at": float,
        "by": str,
        "reason": str,
        "status": str,
        "status_before": str,
        "successor": str | None,
        "valid_from": str | None,
        "valid_to": str | None,
        "version": str,
        "version_before": str,
    },
)
PsfStatus = TypedDict(
    "PsfStatus",
    {
        "history": list[StatusChange],
        "id": str,
        "may_become": list[str],
        "next_version": str | None,
        "series": str | None,
        "status": str,
        "successor": str | None,
        "valid_from": str | None,
        "valid_to": str | None,
        "version": str,
        "was_certified": bool,
    },
)
Choice = TypedDict(
    "Choice",
    {
        "channel": str | None,
        "context": str | None,
        "instrument": str | None,
        "kind": str | None,
        "psf": Psf,
        "valid_at": str | None,
    },
)
Affected = TypedDict(
    "Affected",
    {
        "created_at": float,
        "image_id": str,
        "product_id": str,
        "psf_id": str,
        "psf_status": str,
        "psf_version": str,
        "redo_with": str | None,
        "successor": str | None,
    },
)
SeriesLine = TypedDict("SeriesLine", {"interpolated": bool, "series": str})
SeriesChange = TypedDict("SeriesChange", {"at": float, "by": str, "interpolated": bool, "reason": str})


class Series(SeriesLine):
    """A series with the history of its changes."""

    history: list[SeriesChange]


Pin = TypedDict(
    "Pin",
    {
        "interpolated": bool,
        "psf_id": str,
        "series": str,
        "valid_from": str | None,
        "valid_to": str | None,
        "version": str,
    },
)
ContextLine = TypedDict(
    "ContextLine",
    {"created_at": float, "created_by": str, "id": str, "name": str, "reason": str, "size": int},
)


class Context(ContextLine):
    """A context with its pins."""

    pins: list[Pin]


DefaultChange = TypedDict("DefaultChange", {"at": float, "by": str, "context": str | None, "reason": str})
DefaultContext = TypedDict("DefaultContext", {"context": ContextLine | None, "history": list[DefaultChange]})
Key = TypedDict(
    "Key",
    {
        "created_at": float,
        "expires_at": float | None,
        "id": str,
        "label": str,
        "last_used_at": float | None,
        "made_by": str | None,
        "owner": str,
        "revoked_at": float | None,
        "scopes": list[str],
        "state": str,
    },
)


class MadeKey(Key):
    """A new key with its secret."""

    key: str


Creation = TypedDict(
    "Creation",
    {
        "algorithm_version": int | None,
        "citation": str | None,
        "created_at": float,
        "doi": str | None,
        "file_sha256": str,
        "job_id": str | None,
        "kind": str | None,
        "libraries": dict[str, str] | None,
        "name": str | None,
        "origin": str | None,
        "parameters": dict[str, object] | None,
        "software_version": str | None,
        "status": str | None,
        "version": str | None,
    },
)
Ancestor = TypedDict(
    "Ancestor",
    {
        "cut": bool,
        "id": str,
        "made": Creation | None,
        "parents": list["Ancestor"],
        "there": bool,
        "type": str,
        "weight": float | None,
    },
)
Health = TypedDict("Health", {"status": str, "version": str})

BlockChange = TypedDict("BlockChange", {"sum_pct": float, "up_to_pct": float})
BulkResult = TypedDict(
    "BulkResult",
    {
        "bright": BlockChange | None,
        "bytes": int,
        "dark": BlockChange | None,
        "ended_at": float,
        "file": str | None,
        "flux_change_pct": float,
        "image_sha256": str,
        "kernel_seconds": float | None,
        "negative_pixels": int,
        "output": str | None,
        "position": int,
        "product_id": str,
        "provenance": str | None,
        "psf_id": str,
        "reused": bool,
        "score": float,
        "seconds": float | None,
        "sha256": str,
        "signs": dict[str, float | None],
        "source": str,
        "steps_done": int,
        "stopped_because": str,
        "thumbnail": str | None,
        "warnings": list[str],
    },
)
