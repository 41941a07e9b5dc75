"""What jobs cost: the models of ``estimates.json``, which need no catalogue.

``python -m benchmarks.estimates --write`` measured the values. Times in seconds are processor time on one core of a machine of 2026.
Times per pixel are in ns, memory per pixel in bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Linear(_Frozen):
    """Time and memory as a constant plus a part that is proportional to the number of pixels that the job reads.

    as_published, shapes: if the request sets the parameter of this name, the time is multiplied by this factor.
    """

    base_s: float
    pixel_ns: float
    base_mib: float
    pixel_bytes: float
    as_published: float = 1.0
    shapes: float = 1.0
    run: dict[str, tuple[float, float]] = {}  # time of one run, by scheme: s, and ns per pixel


class Deconvolution(_Frozen):
    """Time of a deconvolution. The plane is the image with its margins. `psfcore.deconvolve.memory` has the memory.

    step_ns: for each method, the time of one step for one pixel of the plane, ns.
    """

    base_s: float
    image_ns: float
    step_ns: dict[str, float]
    psf_draws: int  # deconvolutions with other PSFs, for the errors of a fitted PSF: two per parameter

    def of_method(self, name: str) -> float:
        """The time of a method in ``step_ns``; that of the slowest one if it was not measured yet."""
        return self.step_ns.get(name, max(self.step_ns.values()))


class Build(_Frozen):
    """The time that a PSF build takes for each spectral line of the bandpass, and the memory that it needs.

    A mask is sampled at S^2 points per pixel. ``psfcore.instruments.workload`` counts the points, cells, windows and
    entries. Suffix _ns: the time for one point, cell, window or entry; suffix _bytes: the memory for one.
    """

    disc_s: float
    mesh_s: float
    mask_s: float
    fewest_samples: int  # smallest S
    samples_exponent: float
    grid_px: int
    grid_exponent: float
    grid_mib: float
    meshes_mib: float
    airy_ns: float
    airy_bytes: float
    cell_ns: float
    cell_bytes: float
    window_ns: float  # for each window and pixel of an edge of the grid
    outlines: int  # outlines of a mount that ``mask_s`` includes
    entry_ns: float  # for each further entry of the list of edges, times S
    entry_bytes: float
    spectrum_bytes: float  # for each row of the mask and pixel of an edge of the grid
    image_bytes: float  # for each pixel of a mask image


class Costs(_Frozen):
    """The content of ``estimates.json``.

    threads_exponent: p. With n threads, the time is the time of one thread multiplied by n ** -p.
    """

    class Kinds(BaseModel):
        """The models by kind of job. Every kind except ``deconvolve`` and ``psf-build`` is Linear; a kind without an entry uses "other"."""

        model_config = ConfigDict(frozen=True, extra="allow")
        __pydantic_extra__: dict[str, Linear]

        deconvolve: Deconvolution
        psf_build: Build = Field(alias="psf-build")
        other: Linear

    worker_mib: float  # memory of a worker with its libraries, before its first job
    threads_exponent: float
    kinds: Kinds

    def linear(self, kind: str) -> Linear:
        """The linear model of a kind; the model "other" if the kind has no entry."""
        return (self.kinds.__pydantic_extra__ or {}).get(kind, self.kinds.other)


COSTS_FILE = files(__package__).joinpath("estimates.json")
COSTS = Costs.model_validate_json(COSTS_FILE.read_text("utf-8"))


def linear_s(kind: str, parameters: Mapping[str, Any], pixels: float) -> float:
    """The estimated processor time of a job that reads this number of pixels, s. kind: one with a linear model."""
    cost = COSTS.linear(kind)
    cpu_s = cost.base_s + cost.pixel_ns * 1e-9 * pixels
    for parameter, times in (("as_published", cost.as_published), ("shapes", cost.shapes)):
        if parameters.get(parameter):
            cpu_s *= times
    if parameters.get("scheme") in cost.run:
        run_s, run_ns = cost.run[parameters["scheme"]]
        cpu_s += parameters["runs"] * (run_s + run_ns * 1e-9 * pixels)
    return cpu_s
