"""Methods of deconvolution and their parameters, as a request names them.

To add a method, write a class here, a file in ``psfcore/deconvolve/methods`` and a test.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field


class Parameters(BaseModel):
    """Base class of the parameters of a job, or of a part of a job. Unknown names are refused; values cannot be changed afterwards.

    algorithm_version: raise it when the same parameters give another result; it is part of the identity of the result.
    """

    algorithm_version: ClassVar[int]
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Method(Parameters):
    """Parameters that every method of deconvolution has. Each method adds its own."""

    stop: Literal["fixed", "discrepancy"] = Field(
        "fixed",
        description="`fixed`: do all `steps`; `discrepancy`: stop once the residual is like the noise",
    )
    edges: Literal["zero", "symmetric", "extended"] | None = Field(
        None, description="assumed scene beyond the field of view; null: depends on the method"
    )
    margin_px: int | None = Field(
        None,
        ge=0,
        le=4096,
        description="width of the margin around the field of view in which the scene is also estimated; null: derived from the PSF",
    )


class RichardsonLucy(_Method):
    """Richardson-Lucy. The paper recommends 20 steps and edges `zero`."""

    algorithm_version: ClassVar[int] = 2
    name: Literal["richardson-lucy"] = "richardson-lucy"
    steps: int = Field(20, ge=1, le=200, description="number of iterations; the paper uses 20")


class RichardsonLucyAccelerated(_Method):
    """Richardson-Lucy with the extrapolation of Biggs and Andrews, which reaches the same result in fewer steps."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["richardson-lucy-accelerated"]
    steps: int = Field(10, ge=1, le=200)
    order: Literal[1, 2] = Field(1, description="order of the extrapolation")


class RichardsonLucyExtended(_Method):
    """Richardson-Lucy that also estimates the scene beyond the edges (Bertero and Boccacci)."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["richardson-lucy-extended"]
    steps: int = Field(20, ge=1, le=200)


class RichardsonLucyTotalVariation(_Method):
    """Richardson-Lucy with total-variation regularisation: less noise; meant for pictures rather than photometry."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["richardson-lucy-total-variation"]
    steps: int = Field(20, ge=1, le=200)
    smoothing: float = Field(
        0.01, ge=0, le=0.02, description="weight of the regularisation, in counts; 0 gives Richardson-Lucy"
    )


class BasicIterative(_Method):
    """Basic iterative deconvolution, which the paper recommends for a bright source near an edge."""

    algorithm_version: ClassVar[int] = 1
    name: Literal["basic-iterative"]
    steps: int = Field(20, ge=1, le=200)


class Linear(_Method):
    """Linear reconstruction: no positivity constraint, no bias of faint pixels, converged after about five steps."""

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
METHODS: list[str] = [
    get_args(one.model_fields["name"].annotation)[0] for one in get_args(get_args(Method)[0])
]
