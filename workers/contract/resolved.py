"""Parameters of every job kind as the worker gets them: every default filled in, the PSF chosen.

A kind that is not here is run with the parameters of ``workers.contract.requests`` as they are.
"""

from __future__ import annotations

from typing import Any

from psfcore.noise_figures import NoiseFigures
from workers.contract.methods import Method, Parameters
from workers.contract.requests import CrossValidate, GapDiagnose, Identity, PsfBuild, PsfFit, Report, Rerun


class ResolvedDeconvolve(Parameters):
    """A deconvolution with its PSF, and with the recipe of that PSF if it may still have to be built."""

    image_id: Identity
    psf_id: Identity
    psf_recipe: PsfBuild | None = None
    picked_for: str | None = None  # the image's instrument, if the service chose the PSF
    context_id: str | None = None  # the context that the service chose it from
    method: Method
    noise: NoiseFigures | None = None
    saturation_dn: float | None = None
    error_draws: int = 0
    changes_picture: bool = False


class ResolvedPsfFit(PsfFit):
    """A fit with the recipe of the diffraction PSF, if the transit does not bring that PSF."""

    diffraction_recipe: PsfBuild | None = None


class ResolvedCrossValidate(CrossValidate):
    """A cross-validation with the recipe of the diffraction PSF, if the transit does not bring that PSF."""

    diffraction_recipe: PsfBuild | None = None


class ResolvedReport(Report):
    """A report with the recipe of the diffraction PSF, if a fit needs one."""

    diffraction_recipe: PsfBuild | None = None


class ResolvedGapDiagnose(GapDiagnose):
    """A diagnosis with the recipe of the diffraction PSF and the effects that the operator adds to the library."""

    diffraction_recipe: PsfBuild | None = None
    added_effects: tuple[str, ...] = ()
    added_effects_sha256: tuple[str, ...] = ()  # of their source texts: a changed text is another diagnosis


class ResolvedRerun(Rerun):
    """A rerun with the kind of the job that made the thing, and with that job's own parameters."""

    kind: str
    parameters: dict[str, Any]


# Jobs on an uploaded transit.
ResolvedOnTransit = ResolvedPsfFit | ResolvedCrossValidate | ResolvedReport | ResolvedGapDiagnose
