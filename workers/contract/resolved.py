"""Parameters of every job kind as the worker gets them: defaults are filled in, and the PSF is chosen.

A job of a kind that is not in this module runs with its parameters in ``workers.contract.requests``, unchanged.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import Field

from psfcore.deconvolve.box import Box
from workers.contract.requests import (
    CrossValidate,
    Deconvolve,
    GapDiagnose,
    Identity,
    PsfBuild,
    PsfFit,
    PsfInterpolate,
    Report,
    Rerun,
)

if TYPE_CHECKING:
    from psfcore.deconvolve.run import Options
    from psfcore.noise import Noise


class ResolvedDeconvolve(Deconvolve):
    """A deconvolution with the id of its PSF. If the PSF may still have to be built or interpolated, the parameters
    also say how."""

    psf_id: Identity
    context: None = Field(None, exclude=True)  # the PSF is chosen; context_id says from which context
    psf_recipe: PsfBuild | None = None
    psf_interpolation: PsfInterpolate | None = None
    picked_for: str | None = None  # the instrument of the image, if the service chose the PSF
    context_id: str | None = None  # the context from which the service chose the PSF


def options_of(request: Deconvolve, noise: Noise | None, threads: int) -> Options:
    """The options of psfcore for a request. noise: of the request, or else of the instrument that took the image."""
    # A request is checked without numerical libraries.
    from psfcore.deconvolve.run import Options

    method = request.method
    return Options(
        method=method.name,
        parameters=method.model_dump(exclude={"name", "edges", "margin_px"}),
        edges=method.edges,
        margin_px=method.margin_px,
        noise=noise,
        error_draws=request.error_draws,
        region=None if request.region is None else Box.parse(request.region),
        region_error=request.region_error,
        threads=threads,
    )


class ResolvedPsfFit(PsfFit):
    """A fit with the recipe of the diffraction PSF, if the transit does not contain it."""

    diffraction_recipe: PsfBuild | None = None


class ResolvedCrossValidate(CrossValidate):
    """A cross-validation with the recipe of the diffraction PSF, if the transit does not contain it."""

    diffraction_recipe: PsfBuild | None = None


class ResolvedReport(Report):
    """A report with the recipe of the diffraction PSF, if a fit needs one."""

    diffraction_recipe: PsfBuild | None = None


class ResolvedGapDiagnose(GapDiagnose):
    """A diagnosis with the recipe of the diffraction PSF and the effects that the operator adds to the library."""

    diffraction_recipe: PsfBuild | None = None
    added_effects: tuple[str, ...] = ()
    added_effects_sha256: tuple[
        str, ...
    ] = ()  # hashes of the source texts of the added effects, because a changed text may change the diagnosis


class ResolvedRerun(Rerun):
    """A rerun with the kind and the parameters of the job that made the product or PSF."""

    kind: str
    parameters: dict[str, Any]


# Jobs on an uploaded transit.
ResolvedOnTransit = ResolvedPsfFit | ResolvedCrossValidate | ResolvedReport | ResolvedGapDiagnose
