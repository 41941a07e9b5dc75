"""Start values of the estimates: ``estimates.json``, measured by ``python -m benchmarks.estimates --write``.

Seconds are processor time of one core in 2026. Times per pixel are in ns, memory per pixel in bytes.
"""

from __future__ import annotations

from importlib.resources import files

from pydantic import BaseModel, ConfigDict, Field


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Linear(_Frozen):
    """A base, and a part for each pixel that the job reads. The factors apply if the request sets the parameter."""

    base_s: float
    pixel_ns: float
    base_mib: float
    pixel_bytes: float
    as_published: float = 1.0
    shapes: float = 1.0
    run: dict[str, tuple[float, float]] = Field(default_factory=dict)  # per run, by scheme: s, ns a pixel


class Deconvolution(_Frozen):
    """Time of a step for each pixel of the plane (the image with its margins), by method."""

    base_s: float
    image_ns: float
    step_ns: dict[str, float]
    margin_share: dict[
        str, float
    ]  # default margin as a share of half the PSF, measured with the PSF of HRI_EUV
    psf_draws: int  # deconvolutions with other PSFs, for the errors of a fitted PSF: two for each parameter
    plane_bytes: float
    image_bytes: float
    errors_bytes: float  # more for each pixel of the image, if errors are estimated
    psf_bytes: float


class Build(_Frozen):
    """Time for each spectral line of the bandpass. A mask is transformed at S^2 places a pixel, S in ``samples``."""

    disc_s: float
    mesh_s: float
    mask_s: float
    samples: tuple[int, int]  # fewest and most; a mask that needs more is treated as a disc
    samples_exponent: float
    grid_px: int
    grid_exponent: float
    grid_mib: float
    meshes_mib: float


class Costs(_Frozen):
    """The content of ``estimates.json``. ``threads_exponent`` p: n threads need n ** -p of the time of one."""

    class Kinds(BaseModel):
        """By kind of job. Every other kind is Linear; a kind without an entry uses "other"."""

        model_config = ConfigDict(frozen=True, extra="allow")
        __pydantic_extra__: dict[str, Linear]

        deconvolve: Deconvolution
        psf_build: Build = Field(alias="psf-build")
        other: Linear

    worker_mib: float  # of a worker with its libraries, before its first job
    threads_exponent: float
    kinds: Kinds

    def linear(self, kind: str) -> Linear:
        """The model of a kind that has no model of its own."""
        return (self.kinds.__pydantic_extra__ or {}).get(kind, self.kinds.other)


COSTS_FILE = files(__package__).joinpath("estimates.json")
COSTS = Costs.model_validate_json(COSTS_FILE.read_text("utf-8"))
