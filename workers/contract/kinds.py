"""The table of job kinds, with one row for each kind. All code that depends on the kind of a job reads this table.

To add a kind, write its parameters in ``workers.contract.requests``, a row here, a task in ``workers/tasks``, and a
test. The web process imports this module. Therefore a row contains only the name of its task, and only workers import
the task.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

from pydantic import Field, create_model

from workers.contract.identities import (
    gap_identity,
    interpolated_psf_identity,
    product_identity,
    psf_fit_identity,
    psf_identity,
    report_identity,
    request_identity,
)
from workers.contract.jobs import Queue
from workers.contract.requests import (
    CrossValidate,
    Deconvolve,
    GapDiagnose,
    Parameters,
    PsfBuild,
    PsfFit,
    PsfInterpolate,
    PsfTables,
    Report,
    Rerun,
    ResolvedCrossValidate,
    ResolvedDeconvolve,
    ResolvedGapDiagnose,
    ResolvedPsfFit,
    ResolvedReport,
    ResolvedRerun,
)
from workers.versions import INTERPOLATED

Task = Callable[[Any, Mapping[str, object]], str]
Assistant = Callable[[Any, Mapping[str, object]], None]


class ResultType(StrEnum):
    """The type of a job's result. The value is the beginning of the address of such a result."""

    PRODUCT = "/v1/products"
    PSF = "/v1/psfs"
    REPORT = "/v1/reports"
    BULK = "/v1/bulk"


class Request(Parameters):
    """A request for a job. Each kind has a model of its own, made from its row of the table."""

    queue: Literal["bulk"] | None = Field(
        None, description="`bulk`: lowest priority; null: the default queue of the kind"
    )
    kind: str
    parameters: Any


@dataclass(frozen=True)
class Kind:
    """A kind of job.

    Attributes
    ----------
    task, assistant
        Dotted names of functions. Other workers run the assistant when a job asks for help; if ``assistant`` is None,
        they cannot help.
    result
        Type of the result.
    parameters, resolved
        Models of the parameters as clients send them, and as workers get them; None: the kind is not for clients.
    identity
        Function from the resolved parameters to the identity of the result; None: every job makes a new result.
    resolver
        Dotted name of the function that resolves the parameters; default: by their ids.
    queue
        The queue in which jobs of this kind wait by default.
    origin
        The origin of the PSFs or products of this kind; by it a rerun finds the kind.
    needs_room
        Whether the job starts only if the owner's quota is not full.
    counted_whole
        Whether the reported steps count the whole job, so that the time left can be estimated from them.
    memory_advice, time_advice
        Advice for a request that exceeds the limit of the memory or of the time. If ``time_advice`` is None,
        ``memory_advice`` is given for both.
    """

    name: str
    task: str
    result: ResultType
    parameters: type[Parameters] | None = None
    resolved: type[Parameters] | None = None
    identity: Callable[[Any], str] | None = None
    resolver: str = "workers.intake.requests:resolve_by_ids"
    assistant: str | None = None
    origin: str | None = None
    queue: Queue = Queue.INTERACTIVE
    needs_room: bool = True
    counted_whole: bool = False
    memory_advice: str = "use fewer or smaller images"
    time_advice: str | None = None

    def load_task(self) -> Task:
        """Import the task. Only workers may do this, because the task loads numerical libraries."""
        task: Task = load(self.task)
        return task

    def load_assistant(self) -> Assistant | None:
        """Import the function that other workers run to help with a job of this kind; None if they cannot help."""
        return None if self.assistant is None else load(self.assistant)


_ROWS = (
    Kind(
        "deconvolve",
        task="workers.tasks.deconvolve:deconvolve",
        result=ResultType.PRODUCT,
        parameters=Deconvolve,
        resolved=ResolvedDeconvolve,
        identity=product_identity,
        origin="deconvolved",
        resolver="workers.intake.requests:resolve_deconvolve",
        time_advice="use fewer steps or error_draws, or edges 'zero'",
        memory_advice="crop the image, or use a smaller margin_px or edges 'zero'",
    ),
    Kind(
        "psf-build",
        task="workers.tasks.psf_build:psf_build",
        result=ResultType.PSF,
        parameters=PsfBuild,
        resolved=PsfBuild,
        identity=psf_identity,
        origin="built",
        resolver="workers.intake.requests:resolve_psf_build",
        counted_whole=True,
        memory_advice="use a smaller size, or fewer spectral lines in the bandpass",
    ),
    Kind(
        "psf-fit",
        task="workers.tasks.psf_fit:psf_fit",
        result=ResultType.PSF,
        parameters=PsfFit,
        resolved=ResolvedPsfFit,
        identity=psf_fit_identity,
        origin="fitted",
        counted_whole=True,
    ),
    Kind(
        "psf-interpolate",
        task="workers.tasks.interpolation:psf_interpolate",
        result=ResultType.PSF,
        parameters=PsfInterpolate,
        resolved=PsfInterpolate,
        identity=interpolated_psf_identity,
        origin=INTERPOLATED,
        memory_advice="crop the two PSFs",
    ),
    Kind(
        "psf-tables",
        task="workers.tasks.psf_tables:psf_tables",
        result=ResultType.PSF,
        parameters=PsfTables,
        resolved=PsfTables,
        identity=request_identity("psf-tables"),
        needs_room=False,  # the quota does not count tables
        memory_advice="crop the PSF",
    ),
    Kind(
        "cross-validate",
        task="workers.tasks.crossval:cross_validate",
        result=ResultType.REPORT,
        parameters=CrossValidate,
        resolved=ResolvedCrossValidate,
        identity=psf_fit_identity,
        assistant="workers.tasks.crossval:assist_cross_validation",
        queue=Queue.CROSSVAL,  # these jobs take long, so quick jobs run first
        counted_whole=True,
        memory_advice="use fewer runs, scheme 'shared', or fewer or smaller images",
    ),
    Kind(
        "report",
        task="workers.tasks.report:report",
        result=ResultType.REPORT,
        parameters=Report,
        resolved=ResolvedReport,
        identity=report_identity,
        resolver="workers.intake.requests:resolve_report",
        counted_whole=True,
    ),
    Kind(
        "gap-diagnose",
        task="workers.tasks.gap:gap_diagnose",
        result=ResultType.REPORT,
        parameters=GapDiagnose,
        resolved=ResolvedGapDiagnose,
        identity=gap_identity,
        origin="corrected",
        resolver="workers.intake.requests:resolve_gap_diagnose",
    ),
    Kind(
        "rerun",
        task="workers.tasks.rerun:rerun",
        result=ResultType.REPORT,
        parameters=Rerun,
        resolved=ResolvedRerun,
        resolver="workers.intake.requests:resolve_rerun",
    ),
    # /v1/bulk makes these jobs from requests of its own; the task checks the quota before each image.
    Kind(
        "bulk",
        task="workers.bulk.task:bulk_turn",
        result=ResultType.BULK,
        queue=Queue.BULK,
        needs_room=False,
    ),
)
KINDS: Mapping[str, Kind] = {row.name: row for row in _ROWS}


def _request_model(row: Kind) -> type[Request]:
    name = "".join(part.title() for part in row.name.split("-")) + "Request"
    fields: dict[str, Any] = {"kind": (Literal[row.name], ...), "parameters": (row.parameters, ...)}
    return create_model(
        name,
        __base__=Request,
        __module__=__name__,
        __doc__=f"A request for a job of kind `{row.name}`.",
        **fields,
    )


# The models of the kinds that clients can request.
REQUESTS: Mapping[str, type[Request]] = {
    row.name: _request_model(row) for row in _ROWS if row.parameters is not None
}
if TYPE_CHECKING:
    JobRequest = Request
else:
    JobRequest = Annotated[Union[tuple(REQUESTS.values())], Field(discriminator="kind")]  # noqa: UP007


def queue_of(kind: str) -> Queue:
    """The default queue of a kind."""
    return KINDS[kind].queue if kind in KINDS else Queue.INTERACTIVE


def kind_of_origin(origin: str) -> Kind:
    """The kind of job that makes PSFs or products of this origin."""
    return next(kind for kind in _ROWS if kind.origin == origin)


def load(dotted: str) -> Any:
    """Import the function of a name such as ``workers.tasks.rerun:rerun``."""
    module, _, name = dotted.partition(":")
    return getattr(import_module(module), name)
