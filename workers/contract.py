"""What the web process and the workers agree on: job kinds, parameters, phases, errors and identities.

Both import this module, so it holds no numerics. A new method of deconvolution is a class here, a file in
``psfcore`` and a test.
"""

from __future__ import annotations

import hashlib
import json
from enum import StrEnum
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from psfcore.instruments.files import instrument_path

Identity = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256, 64 hexadecimal digits")]


class Phase(StrEnum):
    """Phases of a job, by their IVOA UWS names."""

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


class _Parameters(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RichardsonLucy(_Parameters):
    """Richardson-Lucy with a fixed number of steps, as the paper recommends it."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["richardson-lucy"] = "richardson-lucy"
    steps: int = Field(20, ge=1, le=200, description="iterations; the paper uses 20")


Component = Literal["airy", "entrance_mesh", "mount", "entrance", "filter_wheel", "diffraction", "scatter"]


class PsfBuild(_Parameters):
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


class Deconvolve(_Parameters):
    """Deconvolve an uploaded image with a PSF."""

    image_id: Identity = Field(description="id that the upload of the image answered")
    psf_id: Identity | None = Field(None, description="a PSF of the catalogue; none: the image's instrument")
    method: RichardsonLucy = Field(default_factory=lambda: RichardsonLucy())


class DeconvolveRequest(_Parameters):
    """A request for a deconvolution."""

    kind: Literal["deconvolve"]
    parameters: Deconvolve


class PsfBuildRequest(_Parameters):
    """A request for a PSF build."""

    kind: Literal["psf-build"]
    parameters: PsfBuild


JobRequest = Annotated[DeconvolveRequest | PsfBuildRequest, Field(discriminator="kind")]


class ResolvedDeconvolve(_Parameters):
    """A deconvolution as the worker gets it: the PSF is named, with its recipe where it may not exist yet."""

    image_id: Identity
    psf_id: Identity
    psf_recipe: PsfBuild | None = None
    method: RichardsonLucy


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


def product_identity(image_id: str, psf_id: str, method: RichardsonLucy) -> str:
    """Identity of a deconvolved image: input bytes, PSF, method with parameters, algorithm version."""
    return canonical_hash(
        {
            "kind": "deconvolve",
            "image": image_id,
            "psf": psf_id,
            "method": method.model_dump(mode="json"),
            "algorithm_version": method.algorithm_version,
        }
    )
