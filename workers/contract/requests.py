"""Parameters of every job kind: as a client sends them, and (``Resolved...``) as the worker gets them.

The web process and the workers both import this module, so it must not load numerical libraries.
``workers.contract.kinds`` makes the requests from these models. The parameters of a method of deconvolution are those
that its file in ``psfcore/deconvolve/methods`` declares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Union

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, create_model, model_validator

from psfcore.deconvolve import declaration
from psfcore.deconvolve.box import BOX, LARGEST_ERROR, Box, region_without_discrepancy, region_without_errors
from psfcore.deconvolve.declaration import Edges, Stop
from psfcore.deconvolve.methods.registry import DEFAULT, method_names, properties_of
from psfcore.errors import DataError
from psfcore.instruments.model import MOST_BYTES
from psfcore.noise import NoiseFigures
from psfcore.recipe import BUILD_VERSION
from workers.versions import TIME, iso, seconds

if TYPE_CHECKING:
    from psfcore.deconvolve.work import Options


@dataclass(frozen=True)
class Option:
    """How a command names a field of a request, as metadata of its annotation; `service.cli.options` makes the option.

    Attributes
    ----------
    name
        Name of the option, such as "--saturation"; None: the name of the field.
    metavar
        Placeholder of the value.
    check
        Function that raises DataError for a text that is no value.
    """

    name: str | None = None
    metavar: str | None = None
    check: Callable[[str], object] | None = None


ContextName = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", description="id or name of a context")
]
# The first digits of an id stand for the id, if no other id begins with them.
FEWEST_DIGITS = 8
SHORT_ID = rf"[0-9a-f]{{{FEWEST_DIGITS},63}}"  # pattern of a text that can be a shortened id
Identity = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256, 64 hexadecimal digits")]
TransitId = Annotated[Identity, Field(description="id returned by the upload of the transit")]
TransitNoise = Annotated[
    NoiseFigures | None,
    Field(description="photon gain (DN per photon), read noise (DN rms); null: those of transit.json"),
]
Saturation = Annotated[
    float | None,
    Option("--saturation", "DN"),
    Field(
        gt=0,
        allow_inf_nan=False,
        description="level (DN) from which pixels are not used; null: as its file says",
    ),
]
Component = Literal["airy", "entrance_mesh", "mount", "entrance", "filter_wheel", "diffraction", "scatter"]
OtherChannel = Annotated[
    bool,
    Field(description="allow a PSF of another telescope, channel, filter; false: such an image is refused"),
]
ShapeName = Literal[
    "softened-power-law",
    "stretched-along-x",
    "stretched",
    "one-sided",
    "knee",
    "two-power-laws",
    "core",
]


class Parameters(BaseModel):
    """Base class of the parameters of a job, or of a part of a job. Unknown names are refused; values cannot be changed
    afterwards.

    algorithm_version: raise it when the same parameters give another result; it is part of the identity of the result.
    """

    algorithm_version: ClassVar[int]
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Method(Parameters):
    """Parameters that every method of deconvolution has. Each method adds its own, and its name."""

    if TYPE_CHECKING:
        name: str
        steps: int
    stop: Stop = Field(
        "fixed",
        description="`fixed`: do all `steps`; `discrepancy`: stop once the residual is like the noise",
    )
    edges: Annotated[Edges | None, Option(metavar="SCENE")] = Field(
        None,
        description="scene beyond the field: zero, symmetric, extended or periodic; null: depends on the method",
    )
    margin_px: int | None = Field(
        None,
        ge=0,
        le=4096,
        description="width of the margin around the field of view in which the scene is also estimated; null: derived "
        "from the PSF",
    )


def _request_of(method: declaration.Method) -> type[_Method]:
    """The model of a method's parameters, as the method declares them."""
    fields: dict[str, Any] = {}
    for one in method.parameters:
        least, most = (None, None) if one.values else (one.least, one.most)
        of_type: Any = Literal[one.values] if one.values else one.type
        fields[one.name] = (of_type, Field(one.default, ge=least, le=most, description=one.about))
    name: Any = Literal[method.name]
    model = create_model(
        "".join(map(str.title, method.name.split("-"))),
        __base__=_Method,
        __module__=__name__,
        __doc__=method.use,
        name=(name, method.name if method.name == DEFAULT else ...),
        **fields,
    )
    model.algorithm_version = method.algorithm_version
    return model


METHODS: list[str] = method_names()
METHOD_MODELS: dict[str, type[_Method]] = {name: _request_of(properties_of(name)) for name in METHODS}
DefaultMethod = METHOD_MODELS[DEFAULT]  # its fields are those that every method has
if TYPE_CHECKING:
    Method = _Method
else:
    Method = Annotated[Union[tuple(METHOD_MODELS.values())], Field(discriminator="name")]  # noqa: UP007


class PsfBuild(Parameters):
    """Build a PSF from a shipped instrument file or from your own instrument file."""

    algorithm_version: ClassVar[int] = BUILD_VERSION
    instrument: str | None = Field(None, description="name of a shipped instrument file, for example hri_euv")
    instrument_file: str | None = Field(
        None,
        max_length=MOST_BYTES,
        description="text of your own instrument file (TOML), instead of `instrument`",
    )
    mask_id: Identity | None = Field(
        None,
        description="id of an uploaded FITS image with the mask of the mount; needed if the instrument file names "
        "a mask image",
    )
    size: int = Field(
        2048, ge=64, le=4096, multiple_of=2, description="edge length of the PSF array in pixels"
    )
    component: Component | None = Field(None, description="build only this component; null: the total PSF")

    @model_validator(mode="after")
    def _one_instrument(self) -> PsfBuild:
        if (self.instrument is None) == (self.instrument_file is None):
            got = "neither" if self.instrument is None else "both"
            raise ValueError(f"expected exactly one of instrument and instrument_file; got {got}")
        return self


class Treatment(Parameters):
    """How an image is deconvolved: the same for one image and for each image of a bulk run."""

    method: Method = Field(default_factory=lambda: DefaultMethod.model_validate({}))
    noise: NoiseFigures | None = Field(
        None,
        description="photon gain (DN per photon), read noise (DN rms); null: published, else measured in the image",
    )
    saturation_dn: Saturation = None
    error_draws: Annotated[int, Option("--errors", "N")] = Field(
        0,
        ge=0,
        le=64,
        description="noise realisations for an ERROR plane: 0, or 2 and more, such as 8 (slow)",
    )
    other_channel: OtherChannel = False
    again: bool = Field(False, description="deconvolve even a product or a PSF")

    @model_validator(mode="after")
    def _a_spread(self) -> Treatment:
        if self.error_draws == 1:
            raise ValueError(
                "error_draws: expected 0, or 2 or more; got 1: the spread cannot be estimated from one realisation"
            )
        return self


class Deconvolve(Treatment):
    """Deconvolve an uploaded image with a PSF."""

    image_id: Identity = Field(description="id returned by the upload of the image")
    psf_id: Identity | None = Field(
        None,
        description="id of a PSF of the catalogue; null: the certified PSF that fits the image, else the PSF built "
        "from the instrument file",
    )
    context: ContextName | None = Field(
        None,
        description="context of the PSF: id, name or `now`; null: the default context",
    )
    changes_picture: bool = Field(
        False, description="also draw the difference, the ratio and the histogram of the changes"
    )

    hdu: Annotated[int | None, Option(metavar="N")] = Field(
        None, ge=0, le=999, description="number of the HDU with the image; null: the first image"
    )
    plate_scale_arcsec: Annotated[float | None, Option("--plate-scale", "ARCSEC")] = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="plate scale of a PSF whose file gives none; null: not compared",
    )
    region: Annotated[str | None, Option(metavar="X0:X1,Y0:Y1", check=Box.parse)] = Field(
        None,
        pattern=BOX,
        description="only this box, px from 0 (x0 <= x < x1); null: the whole image",
    )
    region_error: Annotated[float, Option(metavar="SHARE")] = Field(
        LARGEST_ERROR,
        gt=0,
        le=1,
        description="largest error by the rim of the region, share of its mean light",
    )

    @model_validator(mode="after")
    def _options_together(self) -> Deconvolve:
        if self.region is not None and self.error_draws:
            raise ValueError(region_without_errors(self.error_draws).message)
        if self.region is not None and self.method.stop == "discrepancy":
            raise ValueError(region_without_discrepancy().message)
        if self.psf_id is not None and self.context is not None:
            raise ValueError("expected psf_id, context or neither; got both: remove one")
        return self


class PsfFit(Parameters):
    """Fit the diffuse scatter to an uploaded transit. The result is a PSF version with the errors of the fit, its
    curves and a report.
    """

    algorithm_version: ClassVar[int] = 1
    transit_id: TransitId
    shape: ShapeName = Field("softened-power-law", description="formula of the scatter kernel")
    as_published: bool = Field(
        False,
        description="also run the published recipe and measure each of its four biases (slow)",
    )
    field: int = Field(
        0,
        ge=0,
        le=1,
        description="1: also fit how the scatter changes linearly over the field, and write it as terms of the PSF",
    )
    noise: TransitNoise = None
    saturation_dn: Saturation = None
    seed: int = Field(
        1,
        ge=0,
        lt=2**31,
        description="seed of the random numbers in the fit of free shells and in the published recipe",
    )


class CrossValidate(PsfFit):
    """Cross-validate a fit: hold out blocks of images and bootstrap the other images, in many runs."""

    algorithm_version: ClassVar[int] = 2
    as_published: Literal[False] = False
    field: Literal[0] = 0
    scheme: Literal["shared", "exact"] = Field(
        "shared",
        description="`shared`: all folds use the same reconstructions; `exact`: each fold makes its own "
        "reconstructions (slow; several workers share the folds)",
    )
    runs: int = Field(
        10, ge=1, le=50, description="number of runs; each run holds out every block once (the paper uses 10)"
    )


class Report(Parameters):
    """Report on an uploaded transit and its PSF.

    Without ``psf_id`` the PSF is fitted to the transit, cross-validated and evaluated on held-out images. With
    ``psf_id`` the PSF with this id is evaluated.
    """

    algorithm_version: ClassVar[int] = 1
    transit_id: TransitId
    psf_id: Identity | None = Field(
        None, description="id of the PSF to evaluate; null: fit a PSF to the transit"
    )
    noise: TransitNoise = None
    saturation_dn: Saturation = None
    seed: int = Field(1, ge=0, lt=2**31, description="seed of all random numbers")
    dark_offsets: bool = Field(
        True,
        description="also fit with -5, -3, +3 and +5 DN added to every image; ignored if a PSF is given",
    )
    shapes: bool = Field(
        False,
        description="also compare the scatter shapes by their residuals on held-out images; only if no PSF is given",
    )

    @model_validator(mode="after")
    def _shapes_of_a_fit(self) -> Report:
        if self.shapes and self.psf_id is not None:
            raise ValueError(
                "expected shapes or psf_id; got both: shapes are compared by fitting them to the transit, so leave "
                "out psf_id"
            )
        return self


class GapDiagnose(Parameters):
    """Diagnose the gap between an uploaded transit and the model that was fitted to it. The report says how large the
    gap is, where in the data it appears, and which effects explain it.
    """

    algorithm_version: ClassVar[int] = 18
    transit_id: TransitId
    psf_id: Identity | None = Field(
        None,
        description="id of a PSF that was fitted to a transit; the fit starts from the parameters of this PSF",
    )
    noise: TransitNoise = None
    saturation_dn: Saturation = None
    seed: int = Field(1, ge=0, lt=2**31, description="seed of the simulation and of the confidence intervals")
    coverage: float = Field(
        0.9,
        ge=0.5,
        le=0.95,
        description="probability of the alternatives of each cause together: with a larger one more alternatives are "
        "told",
    )
    correct: bool = Field(
        True,
        description="if the diagnosis finds an effect, also add a corrected PSF to the catalogue: a fit with this "
        "effect in the model",
    )


def _in_utc(text: str) -> str:
    """The time in the one form that the identity of a request contains. Raises ValueError."""
    try:
        return iso(seconds(text)) or text
    except DataError as error:
        raise ValueError(error.message) from error


Time = Annotated[
    str,
    Field(pattern=TIME),
    AfterValidator(_in_utc),
]


class PsfInterpolate(Parameters):
    """Interpolate between two fitted PSFs in time. The result is a PSF version with its errors. Nothing is
    extrapolated.
    """

    algorithm_version: ClassVar[int] = 1
    before_psf_id: Identity = Field(description="id of the earlier PSF")
    before_time: Time = Field(
        description="the last time at which the earlier PSF holds, such as 2024-03-01T12:00:00Z; a time without a "
        "zone is UTC"
    )
    after_psf_id: Identity = Field(description="id of the later PSF, which was fitted with the same shape")
    after_time: Time = Field(description="the first time at which the later PSF holds")
    time: Time = Field(description="the time of the new PSF, between the two other times")

    @model_validator(mode="after")
    def _between(self) -> PsfInterpolate:
        before, after, at = (seconds(text) for text in (self.before_time, self.after_time, self.time))
        if not before < after:
            raise ValueError(
                f"expected before_time earlier than after_time; got {self.before_time} and {self.after_time}: "
                "exchange the two PSFs, or correct the times"
            )
        if not before <= at <= after:
            raise ValueError(
                f"time: expected a time from {self.before_time} to {self.after_time}, because PSFs are not "
                f"extrapolated; got {self.time}: name PSFs whose times enclose it"
            )
        return self


class PsfTables(Parameters):
    """Make the lookup tables of a PSF. A PSF that this service built or fitted already has tables."""

    algorithm_version: ClassVar[int] = 1
    psf_id: Identity = Field(description="id of a PSF of the catalogue, for example an uploaded PSF")


class Rerun(Parameters):
    """Make a product or a PSF again with the same parameters, and compare it with the first one. Existing results do
    not change.
    """

    of: Literal["product", "psf"] = Field(description="type of the result to make again")
    id: Identity = Field(description="id of the product or PSF; an uploaded PSF cannot be made again")


class ResolvedDeconvolve(Deconvolve):
    """A deconvolution with the id of its PSF. If the PSF may still have to be built or interpolated, the parameters
    also say how.
    """

    psf_id: Identity
    context: None = Field(None, exclude=True)  # the PSF is chosen; context_id says from which context
    psf_recipe: PsfBuild | None = None
    psf_interpolation: PsfInterpolate | None = None
    picked_for: str | None = None  # the instrument of the image, if the service chose the PSF
    context_id: str | None = None  # the context from which the service chose the PSF


class WithDiffraction(Parameters):
    """A job on a transit: the recipe of the diffraction PSF, if the job needs this PSF and the transit does not contain
    it.
    """

    diffraction_recipe: PsfBuild | None = None


class ResolvedPsfFit(WithDiffraction, PsfFit):
    """A fit with the recipe of the diffraction PSF."""


class ResolvedCrossValidate(WithDiffraction, CrossValidate):
    """A cross-validation with the recipe of the diffraction PSF."""


class ResolvedReport(WithDiffraction, Report):
    """A report with the recipe of the diffraction PSF."""


class ResolvedGapDiagnose(WithDiffraction, GapDiagnose):
    """A diagnosis with the recipe of the diffraction PSF and the effects that the operator adds to the library."""

    added_effects: tuple[str, ...] = ()
    # Hashes of the source texts of the added effects, because a changed text may change the diagnosis.
    added_effects_sha256: tuple[str, ...] = ()


class ResolvedRerun(Rerun):
    """A rerun with the kind and the parameters of the job that made the product or PSF."""

    kind: str
    parameters: dict[str, object]


# Jobs on an uploaded transit.
ResolvedOnTransit = ResolvedPsfFit | ResolvedCrossValidate | ResolvedReport | ResolvedGapDiagnose


def options_of(request: Deconvolve, threads: int) -> Options:
    """The options of psfcore for a request."""
    # A request is checked without numerical libraries.
    from psfcore.deconvolve.work import Options

    method = request.method
    return Options(
        method=method.name,
        parameters=method.model_dump(exclude={"name", "edges", "margin_px"}),
        edges=method.edges,
        margin_px=method.margin_px,
        noise=None if request.noise is None else request.noise.noise(),
        error_draws=request.error_draws,
        region=None if request.region is None else Box.parse(request.region),
        region_error=request.region_error,
        threads=threads,
    )
