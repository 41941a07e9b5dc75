"""Resolves the parameters of a request for a job: fills in the defaults, checks the ids and chooses the PSF."""

from __future__ import annotations

import uuid
from dataclasses import dataclass
from typing import Any

from psfcore.deconvolve.box import Box
from psfcore.deconvolve.declaration import check_stop
from psfcore.fits.frame import frame_of
from psfcore.fits.header import HeaderJson, check_not_deconvolved
from psfcore.gap.effect_sources import sha256_of_source
from psfcore.instruments.workload import check_workload
from workers.catalogue.catalogue import Catalogue, Row
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow, TransitRow
from workers.contract.documents import TransitJson
from workers.contract.identities import (
    build_for,
    canonical_hash,
    check_noise,
    diffraction_build,
    instrument_of_build,
    interpolated_psf_identity,
    psf_identity,
)
from workers.contract.kinds import KINDS, JobRequest, Kind, load
from workers.contract.requests import (
    Deconvolve,
    Parameters,
    PsfBuild,
    ResolvedDeconvolve,
    WithDiffraction,
)
from workers.intake import compatibility
from workers.intake.compatibility import check_not_deprecated
from workers.intake.psf_choice import SearchResult, no_psf, picked_for_image
from workers.lineage import made_by
from workers.lookup import row_of


@dataclass(frozen=True)
class Submission:
    """The parameters of a request, and the objects that are needed to resolve them."""

    kind: Kind
    parameters: Any
    catalogue: Catalogue
    owner: str
    added_effects: tuple[str, ...]

    def resolved(self, **more: Any) -> Parameters:
        """The resolved model: the parameters of the request, and these further fields."""
        assert self.kind.resolved is not None
        return self.kind.resolved.model_validate(self.parameters.model_dump(mode="json") | more)

    def row(self, table: type[Row], identity: str) -> Row:
        """The owner's row with this id. Raises ``DataError`` "no-such-image", "no-such-psf", ... if there is none."""
        return row_of(self.catalogue, table, identity, self.owner)


def resolve(
    request: JobRequest, catalogue: Catalogue, owner: str, *, added_effects: tuple[str, ...] = ()
) -> tuple[dict[str, Any], str]:
    """Resolved parameters, and the identity of the job's result.

    Parameters
    ----------
    added_effects
        Modules with effects that the operator adds to the library of a gap diagnosis.

    Raises
    ------
    DataError
        "no-such-image", "no-such-psf", "no-such-transit", "no-such-product", "no-psf-for-instrument", "psf-deprecated",
        "no-noise-figures", "no-known-psf", "unknown-instrument", "bad-instrument-file", "already-deconvolved",
        "psf-as-image", "channel-mismatch" or "plate-scale-mismatch", and the errors of ``workers.intake.psf_choice``
        and ``workers.lineage.made_by``.
    """
    kind = KINDS[request.kind]
    resolver = load(kind.resolver)
    resolved: Parameters = resolver(Submission(kind, request.parameters, catalogue, owner, added_effects))
    if kind.identity is None:
        # A random identity, because every job of this kind makes a new result.
        identity = canonical_hash({"kind": kind.name, "asked": uuid.uuid4().hex})
    else:
        identity = kind.identity(resolved)
    return resolved.model_dump(mode="json"), identity


def resolve_by_ids(submission: Submission) -> Parameters:
    """Check the ids in the parameters, and add the recipe of the diffraction PSF if the kind needs one.

    A parameter is an id if its name is ``image_id``, ``psf_id`` or ``transit_id``, or ends in ``_image_id``,
    ``_psf_id`` or ``_transit_id``.
    """
    parameters = submission.parameters
    for name, identity in parameters:
        for of, table in _TABLES.items():
            if identity is not None and f"_{name}".endswith(f"_{of}_id"):
                submission.row(table, identity)
    assert submission.kind.resolved is not None
    if not issubclass(submission.kind.resolved, WithDiffraction):
        return submission.resolved()
    summary = submission.row(TransitRow, parameters.transit_id).summary
    return submission.resolved(diffraction_recipe=_diffraction_of(submission, summary))


def resolve_psf_build(submission: Submission) -> Parameters:
    """Check the instrument file and the mask of a PSF build."""
    build: PsfBuild = submission.parameters
    check_workload(instrument_of_build(build), build.instrument or "instrument_file")
    if build.mask_id is not None:
        submission.row(ImageRow, build.mask_id)
    return build


def resolve_report(submission: Submission) -> Parameters:
    """Resolve a report. A report on a given PSF needs no fit, and therefore no diffraction PSF and no dark offsets."""
    if submission.parameters.psf_id is None:
        return resolve_by_ids(submission)
    summary = submission.row(TransitRow, submission.parameters.transit_id).summary
    submission.row(PsfRow, submission.parameters.psf_id)
    check_noise(summary, submission.parameters.noise)
    # The ignored parameter is set to a fixed value, so that requests that differ only in it share one report.
    return submission.resolved(dark_offsets=False)


def resolve_gap_diagnose(submission: Submission) -> Parameters:
    """Resolve a diagnosis: also record the effects that the operator adds, and the SHA-256 of their source texts."""
    added = submission.added_effects
    fields = {"added_effects": added, "added_effects_sha256": tuple(map(sha256_of_source, added))}
    resolved = resolve_by_ids(submission)
    return resolved.model_validate(resolved.model_dump(mode="json") | fields)


def resolve_rerun(submission: Submission) -> Parameters:
    """Resolve a rerun: find the job that made the product or PSF."""
    again = submission.parameters
    row = submission.row(PsfRow, again.id) if again.of == "psf" else submission.row(ProductRow, again.id)
    return made_by(submission.catalogue, row)


def resolve_deconvolve(submission: Submission) -> Parameters:
    """Resolve a deconvolution: also choose its PSF."""
    image = submission.row(ImageRow, submission.parameters.image_id)
    return resolved_deconvolution(
        submission.parameters, image.summary, submission.catalogue, submission.owner
    )


def resolved_deconvolution(
    wanted: Deconvolve, header: HeaderJson, catalogue: Catalogue, owner: str
) -> ResolvedDeconvolve:
    """The resolved deconvolution of an image with this header, with its PSF. Raises the same ``DataError`` as
    ``resolve``.
    """
    if not wanted.again:
        check_not_deconvolved(header["content"])
    check_stop(wanted.method.stop, noise_is_known=wanted.noise is not None)
    if wanted.region is not None:
        Box.parse(wanted.region).checked((header["shape"][0], header["shape"][1]))
    resolved = ResolvedDeconvolve(
        **_psf_for(catalogue, header, wanted, owner), **wanted.model_dump(exclude={"psf_id", "context"})
    )
    between = resolved.psf_interpolation  # both ends have the instrument, channel and pixels of the new PSF
    psf_id = resolved.psf_id if between is None else between.before_psf_id
    compatibility.check(resolved, catalogue.get(PsfRow, psf_id, owner), header)
    return resolved


_TABLES: dict[str, Any] = {"image": ImageRow, "psf": PsfRow, "transit": TransitRow}


def _diffraction_of(submission: Submission, summary: TransitJson) -> PsfBuild | None:
    """The recipe of the diffraction PSF of a transit; None if the transit contains this PSF."""
    recipe = diffraction_build(summary, submission.parameters.noise)
    if recipe is None:
        return None
    check_not_deprecated(
        submission.catalogue,
        psf_identity(recipe),
        submission.owner,
        f"the diffraction PSF that heliopsf builds for {recipe.instrument}",
        "name the file of another diffraction PSF as known_psf in transit.json; to use the deprecated PSF anyway, "
        "write it "
        "to a file with `heliopsf psf download {psf} -o FILE` and name that file as known_psf",
    )
    return recipe


def _psf_for(catalogue: Catalogue, header: HeaderJson, wanted: Deconvolve, owner: str) -> dict[str, Any]:
    """The PSF that the request names; else the certified PSF that fits the image, or the PSF that is interpolated
    between two certified PSFs; else the PSF that is built for the instrument.
    """
    if wanted.psf_id is not None:
        row_of(catalogue, PsfRow, wanted.psf_id, owner)
        return {"psf_id": wanted.psf_id}
    found = picked_for_image(catalogue, header, owner, wanted.context)
    if found is not None:
        return {
            **_certified(catalogue, owner, found),
            "picked_for": header["instrument"],
            "context_id": None if found.context is None else found.context.id,
        }
    if header["instrument"] is None:
        raise no_psf(catalogue, header, owner)
    recipe = build_for(header["instrument"], frame_of(header["cards"]).turn_to_build_deg)
    identity = psf_identity(recipe)
    check_not_deprecated(
        catalogue,
        identity,
        owner,
        f"the PSF that heliopsf builds for {header['instrument']}",
        "name another PSF, or use it anyway with --psf {psf} (psf_id in a request)",
    )
    return {"psf_id": identity, "psf_recipe": recipe}


def _certified(catalogue: Catalogue, owner: str, found: SearchResult) -> dict[str, Any]:
    """The certified PSF that was found, or how it is interpolated between two certified PSFs."""
    interpolation = found.interpolation
    if interpolation is None:
        return {"psf_id": found.one().id}
    identity = interpolated_psf_identity(interpolation)
    # A context still uses the PSFs that it pins, even if they were deprecated later.
    if found.context is None:
        check_not_deprecated(
            catalogue,
            identity,
            owner,
            f"the PSF that is interpolated to {interpolation.time}",
            "name another PSF, or use it anyway with --psf {psf} (psf_id in a request)",
        )
    return {"psf_id": identity, "psf_interpolation": interpolation.model_dump(mode="json")}
