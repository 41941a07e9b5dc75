"""Identities: the id of a job's result is the SHA-256 of everything that determines the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from psfcore.errors import DataError
from psfcore.gap.effect_sources import library_sha256
from psfcore.instruments.files import instrument_names, instrument_path, turned_text
from psfcore.instruments.model import Instrument, parse_instrument
from psfcore.noise import NoiseFigures
from psfcore.recipe import Recipe
from psfcore.recipe import canonical_hash as canonical_hash
from workers.contract.requests import (
    Parameters,
    PsfBuild,
    ResolvedCrossValidate,
    ResolvedDeconvolve,
    ResolvedGapDiagnose,
    ResolvedOnTransit,
    ResolvedPsfFit,
    ResolvedReport,
    ResolvedRerun,
)


def instrument_text(build: PsfBuild) -> str:
    """The text of the instrument file of a build: the user's own file, or a shipped file.

    Raises DataError "unknown-instrument" if no instrument file with this name is shipped.
    """
    if build.instrument_file is not None:
        return build.instrument_file
    assert build.instrument is not None
    return instrument_path(build.instrument).read_text("utf-8")


def instrument_of_build(build: PsfBuild) -> Instrument:
    """The instrument that a build describes. Raises the errors of `instrument_text` and of `parse_instrument`."""
    return parse_instrument(instrument_text(build), build.instrument or "instrument_file")


def build_for(instrument: str, turn_deg: float) -> PsfBuild:
    """The build of the PSF of a known instrument at full size, for images that are turned by this angle against it."""
    if turn_deg:
        return PsfBuild(instrument_file=turned_text(instrument, turn_deg))
    return PsfBuild(instrument=instrument)


def diffraction_build(transit: Mapping[str, object], noise: NoiseFigures | None) -> PsfBuild | None:
    """The build of the diffraction PSF of a transit; None if the transit contains this PSF.

    Parameters
    ----------
    transit
        The entries "noise", "known_psf" and "instrument" of the manifest of the transit.
    noise
        The noise figures of the request; None: the request has none.

    Raises
    ------
    DataError
        "no-noise-figures" and "no-known-psf".
    """
    check_noise(transit, noise)
    if transit["known_psf"] is not None:
        return None
    instrument = transit["instrument"]
    if not isinstance(instrument, str) or instrument not in instrument_names():
        raise DataError(
            "no-known-psf",
            f"expected known_psf in transit.json, or one of the instruments {', '.join(instrument_names())}; "
            f"got neither ({instrument!r})",
        )
    return PsfBuild(instrument=instrument, component="diffraction")


def check_noise(transit: Mapping[str, object], noise: NoiseFigures | None) -> None:
    """Raise DataError "no-noise-figures" if neither the transit nor the request has noise figures."""
    if noise is None and transit["noise"] is None:
        raise DataError(
            "no-noise-figures",
            "expected noise figures (photon_gain_dn, read_noise_dn) in transit.json or in the request; got neither",
        )


def psf_identity(build: PsfBuild) -> str:
    """The identity of a built PSF: the hash of the instrument file, the parameters and the version of the algorithm.

    Raises DataError "unknown-instrument" if no instrument file with this name is shipped.
    """
    return recipe_of(build).identity


def recipe_of(build: PsfBuild) -> Recipe:
    """The recipe of a build, with the text of its instrument file. Raises DataError "unknown-instrument"."""
    return Recipe(
        text=instrument_text(build),
        name=build.instrument,
        mask_id=build.mask_id,
        size=build.size,
        component=build.component,
        algorithm_version=build.algorithm_version,
    )


# Version of the content of product files.
PRODUCT_FORMAT = 2


_ALWAYS_HASHED = (
    "image_id",
    "psf_id",
    "method",
    "noise",
    "saturation_dn",
    "error_draws",
    "changes_picture",
    "region_error",
)


def product_identity(request: ResolvedDeconvolve) -> str:
    """The identity of a deconvolved image: the hash of the input, the PSF, the method and its parameters, and the
    versions of algorithm and file.
    """
    # The id of the PSF determines the PSF. The recipe and the interpolation only say how to make the PSF, and the
    # context where it was found. `again` only permits a second deconvolution; the image itself determines whether this
    # deconvolution is a second one.
    excluded = {"psf_recipe", "psf_interpolation", "context_id", "again"}
    # A field that is not given leaves the identities as they were before there was this field.
    fields = type(request).model_fields
    excluded |= {
        name for name, value in request if name not in _ALWAYS_HASHED and value == fields[name].default
    }
    if request.region is None:
        excluded.add("region_error")
    hashed = request.model_dump(mode="json", exclude=excluded)
    # The ids of products depend on this name of the parameter.
    hashed["effects_picture"] = hashed.pop("changes_picture")
    return canonical_hash(
        {
            "kind": "deconvolve",
            "request": hashed,
            "algorithm_version": request.method.algorithm_version,
            "product_format": PRODUCT_FORMAT,
        }
    )


def psf_fit_identity(request: ResolvedPsfFit | ResolvedCrossValidate) -> str:
    """The identity of a fit or a cross-validation: the hash of the transit, the parameters, the diffraction PSF and the
    version of the algorithm.
    """
    # Fits without terms of the field keep the ids that they had before there were such terms.
    excluded = () if request.field else ("field",)
    kind = "psf-fit" if isinstance(request, ResolvedPsfFit) else "cross-validate"
    return _transit_identity(kind, request, excluded)


def report_identity(request: ResolvedReport) -> str:
    """The identity of a report: the hash of the transit, the parameters, the PSF or diffraction PSF, and the algorithm
    version.
    """
    return _transit_identity("report", request)


def gap_identity(request: ResolvedGapDiagnose) -> str:
    """The identity of a diagnosis: the hash of the transit, the parameters, the PSFs, the source text of the library of
    effects, and the version of the algorithm.
    """
    # Diagnoses without added effects keep the ids that they had before the texts of added effects were hashed.
    excluded = () if request.added_effects_sha256 else ("added_effects_sha256",)
    return _transit_identity("gap-diagnose", request, excluded, library=library_sha256())


def diffraction_identity(request: ResolvedOnTransit) -> str | None:
    """The identity of the diffraction PSF that the job has to build; None if the transit contains a known PSF or the
    request names a PSF.
    """
    return None if request.diffraction_recipe is None else psf_identity(request.diffraction_recipe)


def _transit_identity(
    kind: str, request: ResolvedOnTransit, excluded: tuple[str, ...] = (), **more: str
) -> str:
    """The identity of the result of a request on a transit.

    Parameters
    ----------
    excluded
        Fields of the request that do not change the result.
    **more
        Further values that determine the result.
    """
    return canonical_hash(
        {
            "kind": kind,
            # The identity of the diffraction PSF determines this PSF; the recipe only says how to build it.
            "request": request.model_dump(mode="json", exclude={"diffraction_recipe", *excluded}),
            "diffraction": diffraction_identity(request),
            "algorithm_version": request.algorithm_version,
            **more,
        }
    )


def request_identity(kind: str) -> Callable[[Any], str]:
    """The identity function of a job kind whose result depends only on its parameters and its ``algorithm_version``."""

    def identity(request: Parameters) -> str:
        version = {"algorithm_version": request.algorithm_version}
        return canonical_hash({"kind": kind, **request.model_dump(mode="json"), **version})

    return identity


interpolated_psf_identity = request_identity("psf-interpolate")


def rerun_identity(request: ResolvedRerun, job_id: str) -> str:
    """The identity of the report of a rerun. The identity contains the job's id, so that every rerun is executed."""
    return canonical_hash({"kind": "rerun", "of": request.of, "id": request.id, "job": job_id})


def corrected_psf_identity(diagnosis: str) -> str:
    """The identity of the corrected PSF that a diagnosis adds: the fit with the effects of the answer in the model."""
    return canonical_hash({"kind": "gap-corrected-psf", "diagnosis": diagnosis})
