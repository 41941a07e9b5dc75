"""Parameters of every job kind, as a client sends them.

The web process and the workers both import this module, so it must not load numerics. Parameters of the methods of
deconvolution are in ``workers.contract.methods``; ``workers.contract.kinds`` makes the requests from these models.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from psfcore.noise_figures import NoiseFigures
from workers.contract.methods import Method, Parameters, RichardsonLucy

ContextName = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", description="id or name of a context")
]
Identity = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256, 64 hexadecimal digits")]
TransitId = Annotated[Identity, Field(description="id returned by the upload of the transit")]
TransitNoise = Annotated[
    NoiseFigures | None, Field(description="replaces the noise figures of transit.json; null: use those")
]
Saturation = Annotated[
    float | None,
    Field(
        gt=0,
        allow_inf_nan=False,
        description="saturation level in DN of one exposure; null: taken from the header or the instrument file, "
        "if known there",
    ),
]
Component = Literal["airy", "entrance_mesh", "mount", "entrance", "filter_wheel", "diffraction", "scatter"]
ShapeName = Literal[
    "softened-power-law",
    "stretched-along-x",
    "stretched",
    "one-sided",
    "knee",
    "two-power-laws",
    "core",
]


class PsfBuild(Parameters):
    """Build a PSF from a shipped instrument file or from your own."""

    algorithm_version: ClassVar[int] = 2
    instrument: str | None = Field(None, description="name of a shipped instrument file, for example hri_euv")
    instrument_file: str | None = Field(
        None, max_length=65536, description="text of your own instrument file (TOML), instead of `instrument`"
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


class Deconvolve(Parameters):
    """Deconvolve an uploaded image with a PSF."""

    image_id: Identity = Field(description="id returned by the upload of the image")
    psf_id: Identity | None = Field(
        None,
        description="a PSF of the catalogue; null: the certified PSF that fits the image, else the PSF built from "
        "the instrument's file",
    )
    context: ContextName | None = Field(
        None,
        description="the context to choose the PSF from: its id, its name, or `now`; null: the default context",
    )
    method: Method = Field(default_factory=lambda: RichardsonLucy())
    noise: NoiseFigures | None = Field(
        None, description="noise figures of the image's gain mode; null: the instrument's, if known"
    )
    saturation_dn: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="saturation level in DN of one exposure; null: the instrument's, if known",
    )
    error_draws: int = Field(
        0,
        ge=0,
        le=64,
        description="number of noise realisations for an ERROR plane: 0, or 2 and more; each costs one deconvolution",
    )
    changes_picture: bool = Field(
        False, description="also draw the difference, the ratio and the histogram of the changes"
    )

    @model_validator(mode="after")
    def _a_spread(self) -> Deconvolve:
        if self.error_draws == 1:
            raise ValueError(
                "error_draws: expected 0, or 2 and more; got 1, and one realisation shows no spread"
            )
        return self

    @model_validator(mode="after")
    def _one_choice(self) -> Deconvolve:
        if self.psf_id is not None and self.context is not None:
            raise ValueError("expected psf_id, context or neither; got both: remove one")
        return self


class PsfFit(Parameters):
    """Fit the diffuse scatter to an uploaded transit. The result is a PSF version with errors, curves and a report."""

    algorithm_version: ClassVar[int] = 1
    transit_id: TransitId
    shape: ShapeName = Field("softened-power-law", description="formula of the scatter kernel")
    as_published: bool = Field(
        False,
        description="also run the published recipe and measure the effect of each of its four biases (slow)",
    )
    noise: TransitNoise = None
    saturation_dn: Saturation = None
    seed: int = Field(
        1, ge=0, lt=2**31, description="seed of the noise realisations of the free and published fits"
    )


class CrossValidate(PsfFit):
    """Cross-validate a fit: hold out blocks of images and bootstrap the rest, in many runs."""

    algorithm_version: ClassVar[int] = 2
    as_published: Literal[False] = False
    scheme: Literal["shared", "exact"] = Field(
        "shared",
        description="`shared`: all folds use the same reconstructions; `exact`: each fold is a fit of its own "
        "(slow; spread over several workers)",
    )
    runs: int = Field(
        10, ge=1, le=50, description="number of runs; each holds every block out once (the paper uses 10)"
    )


class Report(Parameters):
    """Report on an uploaded transit and its PSF.

    Without ``psf_id`` the PSF is fitted to the transit, cross-validated and evaluated on held-out images; with it
    that PSF is evaluated.
    """

    algorithm_version: ClassVar[int] = 1
    transit_id: TransitId
    psf_id: Identity | None = Field(
        None, description="a PSF of the catalogue to evaluate; null: fit one to the transit"
    )
    noise: TransitNoise = None
    saturation_dn: Saturation = None
    seed: int = Field(1, ge=0, lt=2**31, description="seed of all random numbers")
    dark_offsets: bool = Field(
        True,
        description="also fit with -5, -3, +3 and +5 DN added to every image; ignored if psf_id is given",
    )
    shapes: bool = Field(
        False,
        description="also compare the scatter shapes by their held-out residuals; only where the transit is fitted",
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
    """Diagnose the gap between an uploaded transit and the model fitted to it: its size, its place, and which effect explains it."""

    algorithm_version: ClassVar[int] = 4
    transit_id: TransitId
    psf_id: Identity | None = Field(
        None,
        description="a PSF of the catalogue that was fitted to a transit; the fit starts from it",
    )
    noise: TransitNoise = None
    saturation_dn: Saturation = None
    seed: int = Field(1, ge=0, lt=2**31, description="seed of the simulation and of the confidence intervals")
    correct: bool = Field(
        True,
        description="if an effect explains the gap, also add a PSF with that effect in the model to the catalogue",
    )


class PsfTables(Parameters):
    """Make the lookup tables of a PSF. A PSF built or fitted by this service has them already."""

    algorithm_version: ClassVar[int] = 1
    psf_id: Identity = Field(description="a PSF of the catalogue, for example an uploaded one")


class Rerun(Parameters):
    """Make a product or a PSF again with the same parameters, and compare. Existing results do not change."""

    of: Literal["product", "psf"] = Field(description="what to make again")
    id: Identity = Field(description="id of the product or PSF; an uploaded PSF cannot be made again")
