"""What a job will need, told from the sizes of what goes in, before it is taken.

The figures of this file are measured: ``python -m benchmarks.estimates`` runs jobs of several sizes and prints what
they needed beside what is said here. Seconds are those of one core as of 2026; threads share the work, though never
quite evenly. A wrong guess costs little: too long is ended by the limit on what a job may execute, and memory that is
not needed is only not used.

| symbol | name | unit |
|---|---|---|
| plane | field and margins, on which a scene is sought | px |
| grid | the array on which a PSF is built | px |
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from psfcore.errors import DataError
from psfcore.instruments.model import parse_instrument
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, PsfRow, TransitRow
from workers.contract.identities import instrument_text
from workers.contract.requests import PsfBuild
from workers.settings import Settings

MIB = 2**20
BASE_MIB = 400.0  # a worker with its libraries, before it has a job
SHARED_BY_THREADS = 0.8  # exponent: two threads take 2 ** -0.8 of the time of one

# Deconvolution: nanoseconds a step and a pixel of the plane, and how far beyond the edges a scene is followed where
# nobody says, as a share of half the PSF (HRI_EUV, which scatters most of all; less, if the field is small).
STEP_NS = {
    "richardson-lucy": 27.0,
    "richardson-lucy-accelerated": 30.0,
    "richardson-lucy-extended": 33.0,
    "richardson-lucy-total-variation": 36.0,
    "basic-iterative": 20.0,
    "linear": 22.0,
}
MARGIN_SHARE = {
    "richardson-lucy-extended": 0.56,
    "basic-iterative": 0.28,
    "linear": 0.28,
}
SMALL_MARGIN_SHARE = 0.08
ONCE_S, ONCE_NS = 0.6, 750.0  # reading, checking, pictures, saving: and a pixel of the image
PLANE_BYTES, IMAGE_BYTES, PSF_BYTES = 30.0, 120.0, 8.0
ERRORS_BYTES = 240.0  # more, a pixel of the image, where errors are drawn
POSSIBLE_PSFS = 8  # two a parameter of a fitted PSF, each a deconvolution of its own

# Building a PSF, a line of the bandpass: a mask is transformed at S^2 places a pixel, in rows that are S times as many.
GRID_PX = 2048
FEWEST_SAMPLES, MOST_SAMPLES = 14, 32
DISC_S, MESH_S, MASK_S = 1.0, 3.5, 17.0
SAMPLES_EXPONENT, GRID_EXPONENT = 3.3, 1.3
GRID_MIB, MESHES_MIB = 500.0, 350.0

TABLES_S, TABLES_NS, TABLES_BYTES = 0.3, 200.0, 16.0


@dataclass(frozen=True)
class _Study:
    """Studies of a transit: least, and for each pixel of all its images."""

    least_s: float
    pixel_ns: float
    least_mib: float
    pixel_bytes: float


STUDIES = {
    "psf-fit": _Study(8.3, 2200.0, 485.0, 15.0),
    "cross-validate": _Study(2.9, 1600.0, 100.0, 20.0),
    "report": _Study(20.0, 10_500.0, 505.0, 27.0),
    "gap-diagnose": _Study(6.0, 7100.0, 115.0, 37.0),
}
RUN_S, RUN_NS = (
    0.3,
    120.0,
)  # what each run of a cross-validation adds, where folds share their reconstructions
EXACT_RUN_S, EXACT_RUN_NS = 4.6, 2100.0  # and where each fold is a fit of its own
PUBLISHED_FACTOR = 7.0  # the published recipe and its four biases, beside the fit
BYTES_A_PIXEL = 4.0  # of a transit's files, of which nothing but their length is known


@dataclass(frozen=True)
class Estimate:
    """What a job is expected to need."""

    memory_mib: int
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """As it is kept with the job."""
        return {"memory_mib": self.memory_mib, "seconds": self.seconds}


def checked(
    kind: str, parameters: Mapping[str, Any], catalogue: Catalogue, owner: str, settings: Settings
) -> dict[str, Any]:
    """The estimate of a job with these resolved parameters, as JSON.

    Raises DataError "too-much-memory", "too-much-time" where it is more than the operator's limits.
    """
    found = estimate(kind, parameters, catalogue, owner, settings.threads)
    if found.memory_mib > settings.max_job_memory_mib:
        raise DataError(
            "too-much-memory",
            f"expected a job of at most {settings.max_job_memory_mib} MiB (HELIOPSF_MAX_JOB_MEMORY_MIB); this one "
            f"needs about {found.memory_mib} MiB: {_advice(kind, 'memory')}",
        )
    if found.seconds > settings.max_job_s:
        raise DataError(
            "too-much-time",
            f"expected a job of at most {settings.max_job_s:g} s (HELIOPSF_MAX_JOB_S); this one takes about "
            f"{found.seconds:g} s: {_advice(kind, 'time')}",
        )
    return found.as_json()


def estimate(
    kind: str, parameters: Mapping[str, Any], catalogue: Catalogue, owner: str, threads: int
) -> Estimate:
    """What a job with these resolved parameters will need with so many threads."""
    if kind == "rerun":
        kind, parameters = parameters["kind"], parameters["parameters"]
    match kind:
        case "deconvolve":
            cpu_s, mib = _deconvolution(parameters, catalogue, owner)
        case "psf-build" if parameters.get("instrument") or parameters.get("instrument_file"):
            cpu_s, mib = _build(PsfBuild.model_validate(parameters))
        case "psf-build":  # a rerun: the instrument's text is in the PSF's file, which is not read here
            cpu_s, mib = MASK_S, MESHES_MIB + GRID_MIB * (max(parameters["size"], GRID_PX) / GRID_PX) ** 2
        case "psf-tables":
            cpu_s, mib = _tables(parameters, catalogue, owner)
        case _:
            cpu_s, mib = _study(kind, parameters, catalogue, owner)
    return Estimate(memory_mib=round(BASE_MIB + mib), seconds=round(cpu_s / threads**SHARED_BY_THREADS, 1))


def _deconvolution(parameters: Mapping[str, Any], catalogue: Catalogue, owner: str) -> tuple[float, float]:
    image = catalogue.get(ImageRow, parameters["image_id"], owner)
    psf = catalogue.get(PsfRow, parameters["psf_id"], owner)
    # An image of a bulk may be no upload, and brings its shape.
    ny, nx = parameters.get("image_shape") or ((0, 0) if image is None else image.summary["shape"])
    built_s, built_mib, psf_shape = 0.0, 0.0, (ny, nx)
    if psf is not None:
        psf_shape = tuple(psf.details["shape"])
    elif parameters.get("psf_recipe") is not None:  # it may not be there yet
        recipe = PsfBuild.model_validate(parameters["psf_recipe"])
        built_s, built_mib = _build(recipe)
        psf_shape = (recipe.size, recipe.size)
    method = parameters["method"]
    margin = 2 * _margin_px(method, (ny, nx), max(psf_shape))
    plane = (ny + margin) * (nx + margin)
    draws = parameters["error_draws"]
    fitted = psf is not None and "fit" in psf.details
    runs = 1 + draws + (POSSIBLE_PSFS if draws and fitted else 0)
    cpu_s = built_s + ONCE_S + ONCE_NS * 1e-9 * ny * nx
    cpu_s += runs * method["steps"] * STEP_NS[method["name"]] * 1e-9 * plane
    image_bytes = IMAGE_BYTES + (ERRORS_BYTES if draws else 0.0)
    working = PLANE_BYTES * plane + image_bytes * ny * nx + PSF_BYTES * math.prod(psf_shape)
    return cpu_s, max(built_mib, working / MIB)


def _margin_px(method: Mapping[str, Any], field: tuple[int, int], psf_px: int) -> int:
    if method["edges"] == "zero":
        return 0
    if method["margin_px"] is not None:
        return int(method["margin_px"])
    share = MARGIN_SHARE.get(method["name"], SMALL_MARGIN_SHARE)
    return int(min(share * psf_px / 2, min(field) / 2))


def _build(build: PsfBuild) -> tuple[float, float]:
    instrument = parse_instrument(instrument_text(build), build.instrument or "instrument_file")
    grid = max(build.size, GRID_PX) / GRID_PX
    shortest_mm = min(line.wavelength_angstrom for line in instrument.lines) * 1e-7
    resolved_mm = shortest_mm * instrument.focal_length_mm / (instrument.detector.pixel_pitch_um * 1e-3)
    samples = max(FEWEST_SAMPLES, 2 * instrument.aperture.diameter_mm / resolved_mm)
    # More samples than these are not taken: the pattern is then that of a disc.
    mask = samples <= MOST_SAMPLES and (instrument.mount is not None or bool(instrument.meshes))
    a_line_s = DISC_S + MESH_S * len(instrument.meshes)
    if mask:
        a_line_s += MASK_S * (samples / FEWEST_SAMPLES) ** SAMPLES_EXPONENT
    more_mib = MESHES_MIB if mask or instrument.meshes else 0.0
    return len(instrument.lines) * a_line_s * grid**GRID_EXPONENT, more_mib + GRID_MIB * grid**2


def _tables(parameters: Mapping[str, Any], catalogue: Catalogue, owner: str) -> tuple[float, float]:
    psf = catalogue.get(PsfRow, parameters["psf_id"], owner)
    pixels = 0 if psf is None else math.prod(psf.details["shape"])
    return TABLES_S + TABLES_NS * 1e-9 * pixels, TABLES_BYTES * pixels / MIB


def _study(kind: str, parameters: Mapping[str, Any], catalogue: Catalogue, owner: str) -> tuple[float, float]:
    transit = catalogue.get(TransitRow, parameters["transit_id"], owner)
    pixels = 0.0 if transit is None else transit.summary["unpacked_bytes"] / BYTES_A_PIXEL
    study = STUDIES[kind]
    cpu_s = study.least_s + study.pixel_ns * 1e-9 * pixels
    if parameters.get("as_published"):
        cpu_s *= PUBLISHED_FACTOR
    if kind == "cross-validate":
        exact = parameters["scheme"] == "exact"
        run_s, run_ns = (EXACT_RUN_S, EXACT_RUN_NS) if exact else (RUN_S, RUN_NS)
        cpu_s += parameters["runs"] * (run_s + run_ns * 1e-9 * pixels)
    built_s, built_mib = 0.0, 0.0
    if parameters.get("diffraction_recipe") is not None:
        built_s, built_mib = _build(PsfBuild.model_validate(parameters["diffraction_recipe"]))
    return built_s + cpu_s, max(built_mib, study.least_mib + study.pixel_bytes * pixels / MIB)


def _advice(kind: str, what: str) -> str:
    match kind:
        case "deconvolve" if what == "memory":
            return "cut the image, or ask for a smaller margin_px or for edges 'zero'"
        case "deconvolve":
            return "ask for fewer steps or error_draws, or for edges 'zero'"
        case "psf-build":
            return "ask for a smaller size, or for fewer lines in the bandpass"
        case "psf-tables":
            return "cut the PSF"
        case "cross-validate":
            return "ask for fewer runs, for scheme 'shared', or send fewer or smaller images"
        case _:
            return "send fewer or smaller images"
