"""Estimates the time and memory of a job from the sizes of its inputs, before the job is accepted.

The time is a constant and a time for each pixel, and of a deconvolution for each step. It is multiplied by a factor
that was measured in this catalogue: on the completed jobs of the same kind that were of the most similar size, and for
the images of a bulk run on the images of the newest run. A wrong estimate does little harm, because a job that takes
too long is stopped, and no memory is reserved.

| symbol | name | unit |
|---|---|---|
| plane | the image and its margins, on which a scene is estimated | px |
| grid | the array on which a PSF is built | px |
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from statistics import median_low
from typing import Any
from weakref import WeakKeyDictionary

from psfcore.deconvolve.box import Box
from psfcore.deconvolve.memory import EXPECTED_RIM_PX, MIB, Demand, product_bytes
from psfcore.errors import DataError
from psfcore.instruments.workload import workload
from psfcore.recipe import REACH_GRID_PX
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, PsfRow, TransitRow
from workers.contract.identities import instrument_of_build
from workers.contract.kinds import KINDS
from workers.contract.requests import PsfBuild
from workers.intake.costs import COSTS, OTHER, WORKER_MIB, job_s
from workers.settings import Settings

# The factor is the median of the NEAREST jobs or images, by the estimated time, of the newest MOST_JOBS. Of short jobs
# FEWEST_JOBS are needed, because the first one may have compiled kernels; one job of LONG_S is enough.
FEWEST_JOBS, NEAREST, MOST_JOBS = 3, 5, 100
LONG_S = 60.0
BOUNDS = 0.1, 20.0
BULK = "bulk-image"  # takes the place of a kind for the images of bulk runs
# If the measured time of a job is below this fraction of its estimate, the job found its result in the catalogue and
# computed nothing. Such jobs are left out.
FOUND = 0.05
KEEP_FACTOR_S = 60.0
# A deconvolution: ns for each pixel of the plane and step; and the deconvolutions with other PSFs, two for each
# parameter of a fitted PSF, that its errors need.
STEP_NS, PSF_DRAWS = 27.0, 8
# A PSF build: the time for each spectral line and for each of its meshes on the grid of REACH_GRID_PX, s; ns for each
# point of the analytic pattern, and for each cell of a mask and each of its outlines. The transform of a mask takes as
# long as LEAST_OUTLINES.
LINE_S, MESH_S, POINT_NS, OUTLINE_NS = 1.0, 3.5, 520.0, 1.15
LEAST_CELLS, LEAST_OUTLINES = 28_674, 16
# Its memory, MiB: of the grid, and of the patterns of meshes and masks; bytes: for each point, for each cell of a
# rotated mesh, for each edge in a row of the mask, for each row of the mask and pixel of an edge of the grid, and for
# each pixel of a mask image.
GRID_MIB, MESHES_MIB = 500.0, 350.0
POINT_BYTES, CELL_BYTES, ENTRY_BYTES, SPECTRUM_BYTES, IMAGE_BYTES = 120.0, 400.0, 8.0, 8.0, 32.0
_times: WeakKeyDictionary[Catalogue, dict[str, tuple[list[tuple[float, float]], float]]] = WeakKeyDictionary()


@dataclass(frozen=True)
class Estimate:
    """The expected time and memory of a job.

    Attributes
    ----------
    start_s
        The estimated time before the measured factor is applied, s.
    """

    memory_mib: int
    seconds: float
    start_s: float


def checked(
    kind: str, parameters: Mapping[str, Any], catalogue: Catalogue, owner: str, settings: Settings
) -> dict[str, float]:
    """The estimate of a job with these resolved parameters, as JSON.

    Raises DataError "too-much-memory" or "too-much-time" if it exceeds the operator's limits.
    """
    expected = estimate(kind, parameters, catalogue, owner, settings.threads)
    if expected.memory_mib > settings.max_job_memory_mib:
        raise DataError(
            "too-much-memory",
            f"expected a job of at most {settings.max_job_memory_mib} MiB (HELIOPSF_MAX_JOB_MEMORY_MIB; its default "
            "follows from the memory and the worker processes of the service's machine); this one needs about "
            f"{expected.memory_mib} MiB: {KINDS[kind].memory_advice}",
        )
    if expected.seconds > settings.max_job_s:
        raise DataError(
            "too-much-time",
            f"expected a job of at most {settings.max_job_s:g} s (HELIOPSF_MAX_JOB_S); this one takes about "
            f"{expected.seconds:g} s: {KINDS[kind].time_advice or KINDS[kind].memory_advice}",
        )
    return asdict(expected)


def estimate(
    kind: str, parameters: Mapping[str, Any], catalogue: Catalogue, owner: str, threads: int
) -> Estimate:
    """The estimated time and memory of a job with these resolved parameters and this number of threads."""
    if kind == "rerun":
        kind, parameters = parameters["kind"], parameters["parameters"]
    if kind == "deconvolve":
        cpu_s, mib = _deconvolution(parameters, catalogue, owner)
    elif kind == "psf-build":
        cpu_s, mib = estimate_build(parameters, catalogue, owner)
    else:
        cpu_s, mib = _linear(kind, parameters, catalogue, owner)
    start_s = cpu_s / threads
    return Estimate(
        memory_mib=round(WORKER_MIB + mib),
        seconds=round(start_s * factor(kind, start_s, catalogue), 1),
        start_s=round(start_s, 3),
    )


def factor(kind: str, start_s: float, catalogue: Catalogue) -> float:
    """The median ratio of measured to estimated time of completed jobs of this kind, of those whose estimate was
    nearest to ``start_s``; 1 if there are too few.
    """
    known = _times.setdefault(catalogue, {})
    times, until = known.get(kind, ([], -math.inf))
    if time.monotonic() >= until:
        progress = catalogue.bulks.progress
        found = (
            progress.image_times(MOST_JOBS)
            if kind == BULK
            else catalogue.stage_times.run_times(kind, MOST_JOBS)
        )
        times = [(estimated_s, took_s) for estimated_s, took_s in found if took_s > FOUND * estimated_s > 0]
        known[kind] = times, time.monotonic() + KEEP_FACTOR_S
    nearest = sorted(times, key=lambda one: abs(math.log(one[0] / max(start_s, 1e-3))))[:NEAREST]
    if len(nearest) < FEWEST_JOBS and not any(took_s >= LONG_S for _, took_s in nearest):
        return 1.0
    ratio = median_low(took_s / estimated_s for estimated_s, took_s in nearest)
    return min(max(ratio, BOUNDS[0]), BOUNDS[1])


def _deconvolution(parameters: Mapping[str, Any], catalogue: Catalogue, owner: str) -> tuple[float, float]:
    image = catalogue.get(ImageRow, parameters["image_id"], owner)
    psf = catalogue.get(PsfRow, parameters["psf_id"], owner)
    # An image of a bulk run may be a file that was not uploaded; the parameters then contain its shape.
    ny, nx = parameters.get("image_shape") or ((0, 0) if image is None else image.summary["shape"])
    built_s, built_mib, psf_shape = 0.0, 0.0, (ny, nx)
    if psf is not None:
        psf_shape = tuple(psf.details["shape"])
    elif parameters.get("psf_interpolation") is not None:  # the PSF may still have to be interpolated
        interpolation = parameters["psf_interpolation"]
        built_s, built_mib = _linear("psf-interpolate", interpolation, catalogue, owner)
        psf = catalogue.get(PsfRow, interpolation["before_psf_id"], owner)
        psf_shape = psf_shape if psf is None else tuple(psf.details["shape"])
    elif parameters.get("psf_recipe") is not None:  # the PSF may still have to be built
        recipe = parameters["psf_recipe"]
        built_s, built_mib = estimate_build(recipe, catalogue, owner)
        psf_shape = (recipe["size"], recipe["size"])
    method, draws = parameters["method"], parameters["error_draws"]
    whole_px = ny * nx
    if parameters.get("region") is not None:
        ny, nx = Box.parse(parameters["region"]).wider(EXPECTED_RIM_PX, (ny, nx)).shape
    asked = Demand(
        method["name"],
        (ny, nx),
        (psf_shape[0], psf_shape[1]),
        edges=method["edges"],
        margin_px=method["margin_px"],
        draws=draws,
    )
    plane = math.prod(asked.plane)
    interpolated = parameters.get("psf_interpolation") is not None
    fitted = interpolated or (psf is not None and "fit" in psf.details)
    runs = 1 + draws + (PSF_DRAWS if draws and fitted else 0)
    cpu_s = built_s + job_s("deconvolve", parameters, ny * nx)
    cpu_s += runs * method["steps"] * STEP_NS * 1e-9 * plane
    return cpu_s, max(built_mib, product_bytes(asked, whole_px) / MIB)


def estimate_build(
    parameters: Mapping[str, Any], catalogue: Catalogue | None = None, owner: str = ""
) -> tuple[float, float]:
    """The processor time, s, and the memory, MiB, of a PSF build.

    Parameters
    ----------
    catalogue
        The catalogue that contains the mask image; None: the build has no mask image.
    """
    size = max(parameters["size"], REACH_GRID_PX)
    grid = size / REACH_GRID_PX
    if not (parameters.get("instrument") or parameters.get("instrument_file")):
        # This is a rerun. The text of the instrument file is in the file of the PSF, which is not read here.
        return OUTLINE_NS * 1e-9 * LEAST_OUTLINES * LEAST_CELLS**2, MESHES_MIB + GRID_MIB * grid**2
    build = PsfBuild.model_validate(parameters)
    instrument = instrument_of_build(build)
    work = workload(instrument, size)
    line_s = LINE_S + MESH_S * len(instrument.meshes)
    if work.mask:
        cells = max(work.mask_cells, LEAST_CELLS)
        masks = 2 if instrument.meshes else 1  # the mount alone, and with the meshes
        line_s += masks * OUTLINE_NS * 1e-9 * cells * max(work.mount_entries, LEAST_OUTLINES * cells)
    line_s = line_s * grid + POINT_NS * 1e-9 * work.airy_points
    meshes_mib = MESHES_MIB if work.mask or instrument.meshes else 0.0
    # Meshes, the analytic pattern and the mask are computed one after the other.
    arrays = max(
        POINT_BYTES * work.airy_points,
        CELL_BYTES * max(work.cells, default=0),
        ENTRY_BYTES * work.mount_entries + SPECTRUM_BYTES * work.mask_cells * size,
    )
    mask = None if catalogue is None else catalogue.get(ImageRow, parameters.get("mask_id") or "", owner)
    if mask is not None:
        arrays += IMAGE_BYTES * math.prod(mask.summary["shape"])
    return len(instrument.spectral_lines) * line_s, meshes_mib + GRID_MIB * grid**2 + arrays / MIB


def _linear(
    kind: str, parameters: Mapping[str, Any], catalogue: Catalogue, owner: str
) -> tuple[float, float]:
    cost, pixels = COSTS.get(kind, OTHER), _pixels(parameters, catalogue, owner)
    built_s, built_mib = 0.0, 0.0
    if parameters.get("diffraction_recipe") is not None:
        built_s, built_mib = estimate_build(parameters["diffraction_recipe"], catalogue, owner)
    cpu_s = built_s + job_s(kind, parameters, pixels)
    return cpu_s, max(built_mib, cost.base_mib + cost.pixel_bytes * pixels / MIB)


def _pixels(parameters: Mapping[str, Any], catalogue: Catalogue, owner: str) -> float:
    """Number of pixels of the job's transit.

    If the job has no transit, the number of pixels of its image; if it has no image either, of its PSF.
    """
    if parameters.get("transit_id"):
        transit = catalogue.get(TransitRow, parameters["transit_id"], owner)
        return 0.0 if transit is None else float(transit.summary["pixels"])
    if parameters.get("image_id"):
        image = catalogue.get(ImageRow, parameters["image_id"], owner)
        return 0.0 if image is None else math.prod(image.summary["shape"])
    psf_id = parameters.get("psf_id") or parameters.get("before_psf_id") or ""
    psf = catalogue.get(PsfRow, psf_id, owner)
    return 0.0 if psf is None else math.prod(psf.details["shape"])
