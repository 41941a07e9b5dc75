"""Says which PSF a deconvolution will use, and why."""

from __future__ import annotations

from dataclasses import dataclass

from psfcore.instruments.model import load_instrument
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, PsfRow
from workers.contract.requests import Deconvolve, PsfInterpolate
from workers.contract.resolved import ResolvedDeconvolve
from workers.intake.psf_choice import seen_through
from workers.versions import TOTAL, interpolated_name, series_of


@dataclass(frozen=True)
class ReasonedPsf:
    """The PSF of a deconvolution, and the reason for its choice.

    status: None if the PSF is not built yet. In this case, name and version are those of the instrument file.
    """

    id: str
    name: str
    version: str
    status: str | None
    why: str


def reasoned_psf(
    wanted: Deconvolve, resolved: ResolvedDeconvolve, catalogue: Catalogue, owner: str
) -> ReasonedPsf:
    """The PSF that was chosen for a request, with a sentence that says why.

    wanted: the parameters of the request. resolved: the same parameters after ``workers.intake.requests.resolve``.
    """
    row = catalogue.get(PsfRow, resolved.psf_id, owner)
    if row is not None:
        why = _why(wanted, resolved, row, catalogue, owner)
        return ReasonedPsf(row.id, row.name, row.version, row.status, why)
    if resolved.psf_interpolation is not None:
        before = catalogue.get(PsfRow, resolved.psf_interpolation.before_psf_id, owner)
        assert before is not None  # resolve() has found it
        name, version = interpolated_name(before.instrument, resolved.psf_id)
        why = _why_interpolated(resolved.psf_interpolation, catalogue, owner) + "; the job makes it first."
        return ReasonedPsf(resolved.psf_id, name, version, None, why)
    # resolve() has found the image and the PSF, or the recipe of the PSF
    assert resolved.psf_recipe is not None and resolved.psf_recipe.instrument is not None
    instrument = load_instrument(resolved.psf_recipe.instrument)
    why = _why_built(wanted, catalogue, owner) + "; the job builds it first."
    return ReasonedPsf(resolved.psf_id, instrument.name, instrument.version, None, why)


def _why(
    wanted: Deconvolve, resolved: ResolvedDeconvolve, row: PsfRow, catalogue: Catalogue, owner: str
) -> str:
    if wanted.psf_id is not None:
        return "The request names this PSF."
    if resolved.psf_interpolation is not None:
        return _why_interpolated(resolved.psf_interpolation, catalogue, owner) + "."
    if resolved.psf_recipe is not None:
        return _why_built(wanted, catalogue, owner) + "."
    seen = f"the images of {row.series} at the time of this image"
    context = catalogue.contexts.asked_for(wanted.context, owner)
    if context is None or resolved.context_id is None:
        return f"This PSF is certified for {seen}."
    which = "The default context" if wanted.context is None else "Context"
    return f"{which} {context.name} pins this PSF for {seen}."


def _why_interpolated(asked: PsfInterpolate, catalogue: Catalogue, owner: str) -> str:
    said = []
    for psf_id, until in ((asked.before_psf_id, "until"), (asked.after_psf_id, "from")):
        row = catalogue.get(PsfRow, psf_id, owner)
        named = psf_id[:12] if row is None else f"{psf_id[:12]} ({row.name} {row.version})"
        said.append(
            f"PSF {named}, which holds {until} {asked.before_time if until == 'until' else asked.after_time}"
        )
    return f"This PSF is interpolated to {asked.time}, between {said[0]}, and {said[1]}"


def _why_built(wanted: Deconvolve, catalogue: Catalogue, owner: str) -> str:
    image = catalogue.get(ImageRow, wanted.image_id, owner)
    series = None if image is None else series_of(*seen_through(image.summary), TOTAL)
    return f"No PSF of {series or 'this instrument'} is certified, so the PSF is built from the instrument file that heliopsf ships"
