"""From what a user asks to what is written down: rows of uploads, and requests with nothing left open."""

from __future__ import annotations

import dataclasses
import time
import uuid
from pathlib import PurePath
from typing import Any

from psfcore.errors import DataError
from psfcore.fits.header import HeaderSummary
from psfcore.gap.effect_sources import sha256_of_source
from psfcore.instruments.files import instrument_names
from psfcore.instruments.model import parse_instrument
from psfcore.transit.archive import ArchiveContents
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow, TransitRow
from workers.contract.contract import (
    CrossValidate,
    CrossValidateRequest,
    Deconvolve,
    DeconvolveRequest,
    Evaluate,
    EvaluateRequest,
    GapDiagnose,
    GapDiagnoseRequest,
    JobRequest,
    PsfBuild,
    PsfBuildRequest,
    PsfFit,
    PsfFitRequest,
    PsfTablesRequest,
    Rerun,
    RerunRequest,
    ResolvedCrossValidate,
    ResolvedDeconvolve,
    ResolvedEvaluate,
    ResolvedGapDiagnose,
    ResolvedPsfFit,
    canonical_hash,
    evaluate_identity,
    gap_identity,
    instrument_text,
    product_identity,
    psf_fit_identity,
    psf_identity,
    psf_tables_identity,
)
from workers.intake.psf_choice import picked_for_image
from workers.lineage import made_by
from workers.versions.series import UPLOADED, channel_of, instrument_of, series_of
from workers.versions.status import PsfStatus


def image_row(
    owner: str, sha256: str, size_bytes: int, filename: str | None, summary: HeaderSummary
) -> ImageRow:
    """The row of an uploaded image."""
    return ImageRow(
        owner=owner,
        id=sha256,
        created_at=time.time(),
        bytes=size_bytes,
        filename=filename,
        summary=dataclasses.asdict(summary),
    )


def transit_row(
    owner: str, sha256: str, size_bytes: int, filename: str | None, contents: ArchiveContents
) -> TransitRow:
    """The row of an uploaded transit; its summary is what the table of contents and transit.json say."""
    manifest = contents.manifest
    return TransitRow(
        owner=owner,
        id=sha256,
        created_at=time.time(),
        bytes=size_bytes,
        filename=filename,
        summary={
            "archive": contents.kind,
            "instrument": manifest.instrument,
            "images": len(manifest.images),
            "pointings": [{"fov": fov, "images": images} for fov, images in manifest.pointings.items()],
            "noise": None if manifest.noise is None else manifest.noise.model_dump(mode="json"),
            "known_psf": manifest.known_psf,
            "files": [{"name": name, "bytes": contents.files[name]} for name in manifest.files],
            "unpacked_bytes": sum(contents.files.values()),
        },
    )


def uploaded_psf_row(
    owner: str,
    sha256: str,
    size_bytes: int,
    filename: str | None,
    summary: HeaderSummary,
    *,
    name: str | None = None,
    version: str | None = None,
    instrument: str | None = None,
    channel: str | None = None,
    kind: str | None = None,
) -> PsfRow:
    """The row of an uploaded PSF, a draft; its name, version and series come from the request, the header or the file."""
    header = dataclasses.asdict(summary)
    instrument = instrument or instrument_of(header)
    channel = channel or channel_of(instrument, summary.wavelnth)
    kind = kind or UPLOADED
    return PsfRow(
        owner=owner,
        id=sha256,
        created_at=time.time(),
        name=name or summary.psf_name or PurePath(filename or "uploaded").stem,
        version=version or summary.psf_version or f"0.0.0+{sha256[:8]}",
        instrument=instrument,
        channel=channel,
        kind=kind,
        series=series_of(instrument, channel, kind),
        status=PsfStatus.DRAFT,
        origin="uploaded",
        file_sha256=sha256,
        bytes=size_bytes,
        preview_sha256=None,
        details={
            "shape": list(summary.shape),
            "plate_scale_arcsec": summary.cdelt1,
            "wavelength_angstrom": summary.wavelnth,
            "filename": filename,
        },
    )


def resolve(
    request: JobRequest, catalogue: Catalogue, owner: str, *, added_effects: tuple[str, ...] = ()
) -> tuple[dict[str, Any], str]:
    """Parameters with nothing left open, and the identity of what the job makes.

    added_effects: modules of effects that the operator adds to a diagnosis. Raises ``DataError`` with code ``no-such-image``, ``no-such-psf``, ``no-psf-for-instrument``,
    ``unknown-instrument`` or ``bad-instrument-file``, and as ``workers.intake.psf_choice`` does.
    """
    match request:
        case PsfBuildRequest(parameters=build):
            parse_instrument(instrument_text(build), build.instrument or "instrument_file")
            if build.mask_id is not None and catalogue.get(ImageRow, build.mask_id, owner) is None:
                raise DataError("no-such-image", f"no image was uploaded with id {build.mask_id}")
            return build.model_dump(mode="json"), psf_identity(build)
        case PsfFitRequest(parameters=fit) | CrossValidateRequest(parameters=fit):
            row = _transit(catalogue, fit.transit_id, owner)
            kind = ResolvedCrossValidate if isinstance(fit, CrossValidate) else ResolvedPsfFit
            resolved_fit = kind(
                diffraction_recipe=_diffraction_of(row.summary, fit), **fit.model_dump(mode="json")
            )
            return resolved_fit.model_dump(mode="json"), psf_fit_identity(resolved_fit)
        case EvaluateRequest(parameters=judged):
            resolved_report = _evaluation(catalogue, judged, owner)
            return resolved_report.model_dump(mode="json"), evaluate_identity(resolved_report)
        case GapDiagnoseRequest(parameters=diagnosis):
            resolved_gap = _diagnosis(catalogue, diagnosis, owner, added_effects)
            return resolved_gap.model_dump(mode="json"), gap_identity(resolved_gap)
        case PsfTablesRequest(parameters=asked):
            _check_psf(catalogue, asked.psf_id, owner)
            return asked.model_dump(mode="json"), psf_tables_identity(asked)
        case RerunRequest(parameters=again):
            made = made_by(catalogue, _thing(catalogue, again, owner))
            # Of its own: a rerun that found an earlier one's result would be none.
            return made.model_dump(mode="json"), canonical_hash({"kind": "rerun", "asked": uuid.uuid4().hex})
        case DeconvolveRequest(parameters=wanted):
            image = catalogue.get(ImageRow, wanted.image_id, owner)
            if image is None:
                raise DataError("no-such-image", f"no image was uploaded with id {wanted.image_id}")
            resolved = resolved_deconvolution(wanted, image.summary, catalogue, owner)
            return resolved.model_dump(mode="json"), product_identity(resolved)


def resolved_deconvolution(
    wanted: Deconvolve, header: dict[str, Any], catalogue: Catalogue, owner: str
) -> ResolvedDeconvolve:
    """A deconvolution of an image with this header, its PSF found. Raises ``DataError`` as ``resolve`` does."""
    return ResolvedDeconvolve(
        **_psf_for(catalogue, header, wanted, owner), **wanted.model_dump(exclude={"psf_id", "context"})
    )


def _transit(catalogue: Catalogue, transit_id: str, owner: str) -> TransitRow:
    row = catalogue.get(TransitRow, transit_id, owner)
    if row is None:
        raise DataError("no-such-transit", f"no transit was uploaded with id {transit_id}")
    return row


def _thing(catalogue: Catalogue, again: Rerun, owner: str) -> ProductRow | PsfRow:
    """What is to be made again."""
    row: ProductRow | PsfRow | None
    if again.of == "psf":
        row = catalogue.get(PsfRow, again.id, owner)
    else:
        row = catalogue.get(ProductRow, again.id, owner)
    if row is None:
        raise DataError(f"no-such-{again.of}", f"the catalogue holds no {again.of} with id {again.id}")
    return row


def _check_psf(catalogue: Catalogue, psf_id: str, owner: str) -> None:
    if catalogue.get(PsfRow, psf_id, owner) is None:
        raise DataError("no-such-psf", f"the catalogue holds no PSF with id {psf_id}")


def _evaluation(catalogue: Catalogue, asked: Evaluate, owner: str) -> ResolvedEvaluate:
    """A report with nothing left open; where a PSF is given there is nothing to fit, and no diffraction is asked for."""
    summary = _transit(catalogue, asked.transit_id, owner).summary
    if asked.psf_id is None:
        recipe, given = _diffraction_of(summary, asked), asked.model_dump(mode="json")
    else:
        _check_psf(catalogue, asked.psf_id, owner)
        _check_noise(summary, asked)
        # Equal requests share a report, and what is not done makes none of its own.
        recipe, given = None, asked.model_dump(mode="json") | {"dark_offsets": False}
    return ResolvedEvaluate(diffraction_recipe=recipe, **given)


def _diagnosis(
    catalogue: Catalogue, asked: GapDiagnose, owner: str, added_effects: tuple[str, ...]
) -> ResolvedGapDiagnose:
    """A diagnosis with nothing left open."""
    summary = _transit(catalogue, asked.transit_id, owner).summary
    if asked.psf_id is not None:
        _check_psf(catalogue, asked.psf_id, owner)
    return ResolvedGapDiagnose(
        diffraction_recipe=_diffraction_of(summary, asked),
        added_effects=added_effects,
        added_effects_sha256=tuple(sha256_of_source(source) for source in added_effects),
        **asked.model_dump(mode="json"),
    )


def _check_noise(summary: dict[str, Any], asked: PsfFit | Evaluate | GapDiagnose) -> None:
    if asked.noise is None and summary["noise"] is None:
        raise DataError(
            "no-noise-figures",
            "expected noise figures in transit.json or in the request (photon_gain_dn, read_noise_dn); got neither",
        )


def _diffraction_of(summary: dict[str, Any], fit: PsfFit | Evaluate | GapDiagnose) -> PsfBuild | None:
    """How the known part of a transit's PSF is made; None where the transit brings it."""
    _check_noise(summary, fit)
    if summary["known_psf"] is not None:
        return None
    if summary["instrument"] not in instrument_names():
        raise DataError(
            "no-known-psf",
            f"expected known_psf in transit.json, or an instrument of {', '.join(instrument_names())}; "
            f"got neither ({summary['instrument']!r})",
        )
    return PsfBuild(instrument=summary["instrument"], component="diffraction")


def _psf_for(catalogue: Catalogue, header: dict[str, Any], wanted: Deconvolve, owner: str) -> dict[str, Any]:
    """The PSF of a deconvolution: the one named, the certified one for the image, or its instrument's as it is built."""
    if wanted.psf_id is not None:
        _check_psf(catalogue, wanted.psf_id, owner)
        return {"psf_id": wanted.psf_id}
    found = picked_for_image(catalogue, header, owner, wanted.context)
    if found is not None:
        return {
            "psf_id": found.one().id,
            "picked_for": header["instrument"],
            "context_id": None if found.context is None else found.context.id,
        }
    recipe = _default_psf(header)
    return {"psf_id": psf_identity(recipe), "psf_recipe": recipe}


def _default_psf(header: dict[str, Any]) -> PsfBuild:
    """The PSF of the instrument that made the image: the shipped instrument file at full size."""
    if header["instrument"] is None:
        made_by = " ".join(str(header[k]) for k in ("telescop", "instrume", "detector") if header[k])
        raise DataError(
            "no-psf-for-instrument",
            f"expected an image of an instrument whose PSF is known here, got one by "
            f"'{made_by or 'an unnamed instrument'}'; upload its PSF and name it as psf_id",
        )
    return PsfBuild(instrument=header["instrument"])
