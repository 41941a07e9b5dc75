"""What the web process and the workers agree on: job kinds, parameters, phases, errors and identities.

Both import this module, so it holds no numerics. Methods of deconvolution are in ``workers.contract.methods``.
"""

from __future__ import annotations

import hashlib
import json
from enum import StrEnum
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, Field, model_validator

from psfcore.instruments.files import instrument_path
from workers.contract.methods import Method, NoiseFigures, Parameters, RichardsonLucy

ContextName = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", description="an id or a name")
]
Identity = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256, 64 hexadecimal digits")]


class Phase(StrEnum):
    """Phases of a job, by their IVOA UWS names.

    A job that is asked for over ``/v1/jobs`` starts QUEUED; a UWS client's is PENDING, and may be changed, until it
    is told to run.
    """

    PENDING = "PENDING"
    QUEUED = "QUEUED"
    EXECUTING = "EXECUTING"
    COMPLETED = "COMPLETED"
    ERROR = "ERROR"
    ABORTED = "ABORTED"

    @property
    def ended(self) -> bool:
        """True where nothing more will happen to the job."""
        return self in ENDED


ENDED = frozenset({Phase.COMPLETED, Phase.ERROR, Phase.ABORTED})
LIVE = frozenset({Phase.QUEUED, Phase.EXECUTING, Phase.COMPLETED})  # an equal request shares these


class Fault(StrEnum):
    """Whose an error is: the user's data, a passing failure, or ours."""

    USER = "user"
    TRANSIENT = "transient"
    INTERNAL = "internal"


class JobError(BaseModel):
    """Why a job failed."""

    fault: Fault
    code: str
    message: str


Component = Literal["airy", "entrance_mesh", "mount", "entrance", "filter_wheel", "diffraction", "scatter"]


class PsfBuild(Parameters):
    """Build a PSF from an instrument file: one that ships with the software, or one of the user's."""

    algorithm_version: ClassVar[int] = 2
    instrument: str | None = Field(None, description="name of a shipped instrument file, as hri_euv")
    instrument_file: str | None = Field(
        None, max_length=65536, description="or the text of an instrument file of your own (TOML)"
    )
    mask_id: Identity | None = Field(
        None, description="an uploaded FITS image, where the file's mount names a mask image"
    )
    size: int = Field(2048, ge=64, le=4096, multiple_of=2, description="edge of the PSF's array in pixels")
    component: Component | None = Field(None, description="one part alone; none: the whole PSF")

    @model_validator(mode="after")
    def _one_instrument(self) -> PsfBuild:
        if (self.instrument is None) == (self.instrument_file is None):
            raise ValueError("expected one of instrument and instrument_file")
        return self


class Deconvolve(Parameters):
    """Deconvolve an uploaded image with a PSF."""

    image_id: Identity = Field(description="id that the upload of the image answered")
    psf_id: Identity | None = Field(
        None,
        description="a PSF of the catalogue; none: the certified one for the image, else its instrument's",
    )
    context: ContextName | None = Field(
        None,
        description="the set to find the image's PSF in: its id, its name, or now; none: the default one",
    )
    method: Method = Field(default_factory=lambda: RichardsonLucy())
    noise: NoiseFigures | None = Field(
        None, description="of the image's gain mode; none: the instrument's, if known"
    )
    saturation_dn: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="DN of one exposure; none: the instrument's, if known"
    )
    error_draws: int = Field(
        0,
        ge=0,
        le=64,
        description="noise draws for an ERROR plane (0, or 2 and more; each costs one deconvolution)",
    )
    effects_picture: bool = Field(False, description="also draw difference, ratio and histogram")

    @model_validator(mode="after")
    def _a_spread(self) -> Deconvolve:
        if self.error_draws == 1:
            raise ValueError("error_draws: expected 0, or 2 and more; got 1, which shows no spread")
        return self

    @model_validator(mode="after")
    def _one_choice(self) -> Deconvolve:
        if self.psf_id is not None and self.context is not None:
            raise ValueError("expected psf_id, or a context to find the PSF in, or neither; got both")
        return self


ShapeName = Literal[
    "softened-power-law",
    "stretched-along-x",
    "stretched",
    "one-sided",
    "knee",
    "two-power-laws",
    "core",
]


class PsfFit(Parameters):
    """Fit the diffuse scatter of an uploaded transit: a PSF version with its errors, curves and report."""

    algorithm_version: ClassVar[int] = 1
    transit_id: Identity = Field(description="id that the upload of the transit answered")
    shape: ShapeName = Field("softened-power-law", description="the formula that scatter is fitted with")
    as_published: bool = Field(
        False, description="also the published recipe, and what each of its four biases does (slow)"
    )
    noise: NoiseFigures | None = Field(None, description="instead of those in transit.json")
    saturation_dn: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="DN of one exposure; none: header's or instrument's, if known",
    )
    seed: int = Field(1, ge=0, lt=2**31, description="of the draws of the free and the published fits")


class CrossValidate(PsfFit):
    """How well a fit is known: blocks of images held out, the others drawn again, in many runs."""

    algorithm_version: ClassVar[int] = 2
    as_published: Literal[False] = False
    scheme: Literal["shared", "exact"] = Field(
        "shared", description="folds that share every reconstruction, or fits of their own (slow, fanned out)"
    )
    runs: int = Field(10, ge=1, le=50, description="each holds every block out once; the paper has ten")


class Evaluate(Parameters):
    """Report on an uploaded transit: its PSF fitted, cross-validated and judged on images held out; or one given, judged."""

    algorithm_version: ClassVar[int] = 1
    transit_id: Identity = Field(description="id that the upload of the transit answered")
    psf_id: Identity | None = Field(
        None, description="a PSF of the catalogue, evaluated as it is; none: the transit is fitted"
    )
    noise: NoiseFigures | None = Field(None, description="instead of those in transit.json")
    saturation_dn: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="DN of one exposure; none: header's or instrument's, if known",
    )
    seed: int = Field(1, ge=0, lt=2**31, description="of all draws")
    dark_offsets: bool = Field(
        True, description="also fit with -5, -3, +3 and +5 DN added to every image; not where a PSF is given"
    )


class GapDiagnose(Parameters):
    """Diagnose the gap between an uploaded transit and the model fitted to it: is there one, where, and which effect."""

    algorithm_version: ClassVar[int] = 4
    transit_id: Identity = Field(description="id that the upload of the transit answered")
    psf_id: Identity | None = Field(
        None, description="a PSF of the catalogue that was fitted to a transit: the fit starts from it"
    )
    noise: NoiseFigures | None = Field(None, description="instead of those in transit.json")
    saturation_dn: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="DN of one exposure; none: header's or instrument's, if known",
    )
    seed: int = Field(1, ge=0, lt=2**31, description="of the simulation and of the intervals")
    correct: bool = Field(
        True, description="where there is an answer, also add the PSF with it in the model to the catalogue"
    )


class PsfTables(Parameters):
    """Make the tables that questions about a PSF are answered from: those that are built or fitted here have them."""

    algorithm_version: ClassVar[int] = 1
    psf_id: Identity = Field(description="a PSF of the catalogue, as one that was uploaded")


class Rerun(Parameters):
    """Make a product or a PSF again from the same parameters, and compare: nothing that is there is changed."""

    of: Literal["product", "psf"]
    id: Identity = Field(description="of what is made again; a PSF that was uploaded was not made here")


class _Request(Parameters):
    queue: Literal["bulk"] | None = Field(
        None, description="bulk: after all that people wait for; none: where jobs of this kind wait"
    )


class DeconvolveRequest(_Request):
    """A request for a deconvolution."""

    kind: Literal["deconvolve"]
    parameters: Deconvolve


class PsfBuildRequest(_Request):
    """A request for a PSF build."""

    kind: Literal["psf-build"]
    parameters: PsfBuild


class PsfFitRequest(_Request):
    """A request for a fit of a transit."""

    kind: Literal["psf-fit"]
    parameters: PsfFit


class CrossValidateRequest(_Request):
    """A request for a cross-validation."""

    kind: Literal["cross-validate"]
    parameters: CrossValidate


class EvaluateRequest(_Request):
    """A request for a report on a transit and its PSF."""

    kind: Literal["evaluate"]
    parameters: Evaluate


class GapDiagnoseRequest(_Request):
    """A request for a diagnosis of the gap."""

    kind: Literal["gap-diagnose"]
    parameters: GapDiagnose


class PsfTablesRequest(_Request):
    """A request for a PSF's tables."""

    kind: Literal["psf-tables"]
    parameters: PsfTables


class RerunRequest(_Request):
    """A request to make a thing again."""

    kind: Literal["rerun"]
    parameters: Rerun


JobRequest = Annotated[
    DeconvolveRequest
    | PsfBuildRequest
    | PsfFitRequest
    | PsfTablesRequest
    | CrossValidateRequest
    | EvaluateRequest
    | GapDiagnoseRequest
    | RerunRequest,
    Field(discriminator="kind"),
]


class ResolvedPsfFit(PsfFit):
    """A fit as the worker gets it: with the recipe of the diffraction, where the transit brings none."""

    diffraction_recipe: PsfBuild | None = None


class ResolvedCrossValidate(CrossValidate):
    """A cross-validation as the worker gets it."""

    diffraction_recipe: PsfBuild | None = None


class ResolvedEvaluate(Evaluate):
    """An evaluation as the worker gets it: with the recipe of the diffraction, where a fit needs one."""

    diffraction_recipe: PsfBuild | None = None


class ResolvedGapDiagnose(GapDiagnose):
    """A diagnosis as the worker gets it: with the diffraction's recipe, and the effects that the operator adds."""

    diffraction_recipe: PsfBuild | None = None
    added_effects: tuple[str, ...] = ()
    added_effects_sha256: tuple[str, ...] = ()  # of their texts: another text is another diagnosis


# Jobs on an uploaded transit, as the worker gets them.
ResolvedOnTransit = ResolvedPsfFit | ResolvedCrossValidate | ResolvedEvaluate | ResolvedGapDiagnose


class ResolvedRerun(Rerun):
    """A rerun as the worker gets it: the kind of job that made the thing, and that job's own parameters."""

    kind: Literal["deconvolve", "psf-build", "psf-fit", "gap-diagnose"]
    parameters: dict[str, Any]


class ResolvedDeconvolve(Parameters):
    """A deconvolution as the worker gets it: the PSF is named, with its recipe where it may not exist yet."""

    image_id: Identity
    psf_id: Identity
    psf_recipe: PsfBuild | None = None
    picked_for: str | None = None  # the image's instrument, where nobody named the PSF
    context_id: str | None = None  # where it was found then
    method: Method
    noise: NoiseFigures | None = None
    saturation_dn: float | None = None
    error_draws: int = 0
    effects_picture: bool = False


def canonical_hash(content: dict[str, Any]) -> str:
    """SHA-256 of a JSON object in canonical form (sorted keys, no spaces)."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def instrument_text(build: PsfBuild) -> str:
    """The instrument file of a build: the user's own, or the shipped one of that name."""
    if build.instrument_file is not None:
        return build.instrument_file
    assert build.instrument is not None
    return instrument_path(build.instrument).read_text("utf-8")


def psf_identity(build: PsfBuild) -> str:
    """Identity of a built PSF: the instrument file's bytes, the parameters and the algorithm's version.

    Raises ``psfcore.errors.DataError`` where no such instrument is shipped.
    """
    return canonical_hash(
        {
            "kind": "psf-build",
            "instrument_file": hashlib.sha256(instrument_text(build).encode()).hexdigest(),
            "parameters": build.model_dump(mode="json", include={"mask_id", "size", "component"}),
            "algorithm_version": build.algorithm_version,
        }
    )


def psf_tables_identity(request: PsfTables) -> str:
    """Identity of a PSF's tables: the PSF and the algorithm's version."""
    return canonical_hash(
        {"kind": "psf-tables", "psf_id": request.psf_id, "algorithm_version": request.algorithm_version}
    )


def product_identity(request: ResolvedDeconvolve) -> str:
    """Identity of a deconvolved image: input bytes, PSF, method with all parameters, algorithm version."""
    # The PSF's id says what it is; the recipe only how to make it where it is missing, the context where it was found.
    beside = {"psf_recipe", "context_id"} | ({"picked_for"} if request.picked_for is None else set())
    return canonical_hash(
        {
            "kind": "deconvolve",
            "request": request.model_dump(mode="json", exclude=beside),
            "algorithm_version": request.method.algorithm_version,
        }
    )


def psf_fit_identity(request: ResolvedPsfFit | ResolvedCrossValidate) -> str:
    """Identity of a fit or a cross-validation: the transit's bytes, parameters, the diffraction's identity, version."""
    return _transit_identity("psf-fit" if isinstance(request, ResolvedPsfFit) else "cross-validate", request)


def evaluate_identity(request: ResolvedEvaluate) -> str:
    """Identity of a report: the transit's bytes, the PSF's identity or the diffraction's, parameters, version."""
    return _transit_identity("evaluate", request)


def gap_identity(request: ResolvedGapDiagnose) -> str:
    """Identity of a diagnosis: the transit's bytes, the PSF's and the diffraction's identity, parameters, version."""
    # Without added effects the identity is what it was before their texts counted.
    beside = () if request.added_effects_sha256 else ("added_effects_sha256",)
    return _transit_identity("gap-diagnose", request, beside)


def diffraction_identity(request: ResolvedOnTransit) -> str | None:
    """Identity of the diffraction that is built for a request; None where its transit or its PSF brings it."""
    return None if request.diffraction_recipe is None else psf_identity(request.diffraction_recipe)


def _transit_identity(kind: str, request: ResolvedOnTransit, beside: tuple[str, ...] = ()) -> str:
    """beside: what of the request does not count."""
    return canonical_hash(
        {
            "kind": kind,
            # The diffraction's identity says what it is; the recipe only how to make it.
            "request": request.model_dump(mode="json", exclude={"diffraction_recipe", *beside}),
            "diffraction": diffraction_identity(request),
            "algorithm_version": request.algorithm_version,
        }
    )


def rerun_identity(request: ResolvedRerun, job_id: str) -> str:
    """Identity of what one rerun found: every job that is asked for is one of its own."""
    return canonical_hash({"kind": "rerun", "of": request.of, "id": request.id, "job": job_id})


def corrected_psf_identity(diagnosis: str) -> str:
    """Identity of the PSF with the answer of a diagnosis in the model."""
    return canonical_hash({"kind": "gap-corrected-psf", "diagnosis": diagnosis})
