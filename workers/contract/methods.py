"""Methods of deconvolution as a request names them: a part of ``workers.contract.contract``, which shows them too.

A new method is a class here, a file in ``psfcore/deconvolve`` and a test.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field


class Parameters(BaseModel):
    """Parameters of a job, or of a part of one: what is not known is refused, and nothing is changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Method(Parameters):
    """What every method of deconvolution takes. A method's own parameters stand beside."""

    algorithm_version: ClassVar[int]
    stop: Literal["fixed", "discrepancy"] = Field(
        "fixed",
        description="after all steps, or once the residual is down at the noise (needs noise figures)",
    )
    edges: Literal["zero", "symmetric", "extended"] | None = Field(
        None, description="what is taken to lie beyond the field; none: what the method does best with"
    )
    margin_px: int | None = Field(
        None,
        ge=0,
        le=4096,
        description="how far the scene is followed beyond the field; none: as the PSF asks",
    )


class RichardsonLucy(_Method):
    """Richardson-Lucy; with 20 steps and zero edges it is what the paper recommends."""

    algorithm_version: ClassVar[int] = 2
    name: Literal["richardson-lucy"] = "richardson-lucy"
    steps: int = Field(20, ge=1, le=200, description="iterations; the paper uses 20")


class RichardsonLucyAccelerated(_Method):
    """Richardson-Lucy with the extrapolation of Biggs and Andrews: fewer steps to the same point."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["richardson-lucy-accelerated"]
    steps: int = Field(10, ge=1, le=200)
    order: Literal[1, 2] = Field(1, description="of the extrapolation")


class RichardsonLucyExtended(_Method):
    """Richardson-Lucy that finds what lies beyond the edges too (Bertero and Boccacci)."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["richardson-lucy-extended"]
    steps: int = Field(20, ge=1, le=200)


class RichardsonLucyTotalVariation(_Method):
    """Richardson-Lucy with a price on variation: less noise, for pictures more than for photometry."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["richardson-lucy-total-variation"]
    steps: int = Field(20, ge=1, le=200)
    smoothing: float = Field(0.01, ge=0, le=0.02, description="the price, in counts; 0 is Richardson-Lucy")


class BasicIterative(_Method):
    """Basic iterative deconvolution: the paper's advice for a bright source near an edge."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["basic-iterative"]
    steps: int = Field(20, ge=1, le=200)


class Linear(_Method):
    """The linear reconstruction: no positivity, no bias on faint pixels, settled after about five steps."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["linear"]
    steps: int = Field(5, ge=1, le=200)


Method = Annotated[
    RichardsonLucy
    | RichardsonLucyAccelerated
    | RichardsonLucyExtended
    | RichardsonLucyTotalVariation
    | BasicIterative
    | Linear,
    Field(discriminator="name"),
]


class NoiseFigures(Parameters):
    """Variance of a pixel in DN^2 = photon_gain_dn * signal in DN + read_noise_dn^2."""

    photon_gain_dn: float = Field(ge=0, allow_inf_nan=False, description="DN a detected photon")
    read_noise_dn: float = Field(ge=0, allow_inf_nan=False, description="DN rms of the readout")
