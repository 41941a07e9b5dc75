"""Transits and their solutions, shared by the tasks.

The fit, the cross-validation, the report and the gap diagnosis of a transit begin with the same inversion. The first
job keeps its solution, and later jobs of the same owner read it: a new inversion would give the same values, bit for
bit. The identity of a solution contains everything that determines the solution, and the versions of the software and
its libraries, so that the provenance of a result stays true. The identity does not contain the number of threads,
because this number changes no result.

A kept solution only saves time. If it cannot be read or kept, the job inverts the transit itself and continues.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from psfcore.errors import DataError
from psfcore.fits.psfs import read_psf
from psfcore.scatter.inversion import ALGORITHM_VERSION, invert
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.scatter.shapes import Shape, Vector
from psfcore.scatter.solution_file import read_solution, write_solution
from psfcore.transit.folder import read_prepared
from psfcore.transit.prepare import Prepared
from psfcore.transit.transit import Kernel, Transit
from workers.contract.identities import canonical_hash, diffraction_identity
from workers.contract.requests import ResolvedOnTransit
from workers.rows import row_of
from workers.settings import library_versions, software_version
from workers.tasks.results import Means

if TYPE_CHECKING:
    from workers.tasks.context import Context

log = logging.getLogger(__name__)


def load_transit(
    context: Context,
    request: ResolvedOnTransit,
    *,
    diffraction: Kernel | None = None,
) -> tuple[Transit, Prepared]:
    """Unpack, read and prepare the transit that a request names.

    diffraction: the diffraction PSF to use if the transit contains none; None: build it from the request's recipe.

    Raises DataError "no-such-transit", "no-known-psf", and the errors of unpacking and preparing.
    """
    from workers.catalogue.tables import TransitRow  # a command with --local needs no catalogue

    upload = row_of(context.catalogue, TransitRow, request.transit_id, context.owner)
    images = int(upload.summary["images"])
    context.report("reading", 0, images)
    with context.store.unpacked(request.transit_id, context.settings.archive_limits) as folder:
        return read_prepared(
            folder,
            context.limits,
            progress=lambda done, of: context.report("reading", done, of),
            diffraction=lambda _instrument, _shape: (
                _built_diffraction(context, request) if diffraction is None else diffraction
            ),
            noise=None if request.noise is None else request.noise.noise(),
            saturation_dn=request.saturation_dn,
        )


def _built_diffraction(
    context: Context,
    request: ResolvedOnTransit,
) -> Kernel:
    """The diffraction PSF of the transit's instrument, from the catalogue or built now.

    The PSF is not cropped to the field of view: its kernel of 2048 × 2048 px sums to 1.
    """
    if request.diffraction_recipe is None:
        raise DataError(
            "no-known-psf",
            "expected known_psf in transit.json, or an instrument whose diffraction PSF can be built; got neither: add "
            "the file of the known PSF to the transit",
        )
    from workers.tasks.psf_build import built_psf  # a command with --local needs no catalogue

    row = built_psf(context, request.diffraction_recipe)
    return read_psf(context.store.verified(row.file_sha256), context.settings.psf_limits, parts=False).kernel


# Solutions ------------------------------------------------------------------------------------------


def means_of(context: Context, request: ResolvedOnTransit) -> Means:
    """The means of a job on a transit. psfcore calls ``solved`` when it needs the solution."""

    def solve(
        transit: Transit, shape: Shape, /, *, start: Vector | None, threads: int, progress: Progress
    ) -> Solution:
        assert threads == context.settings.threads
        return solved(context, request, transit, shape, start=start, progress=progress)

    return Means(context.job_id, context.settings.threads, context.report, solve)


def solved(
    context: Context,
    request: ResolvedOnTransit,
    transit: Transit,
    shape: Shape,
    *,
    start: Vector | None = None,
    progress: Progress,
) -> Solution:
    """The solution of a transit: the owner's stored solution if it exists; otherwise a new solution.

    A new solution is stored if the owner's quota allows it. A rerun always computes a new solution and does not store
    it. transit: as ``load_transit`` returns it for the request; only its noise may be replaced. Raises DataError as
    ``psfcore.scatter.inversion.invert`` does.
    """
    identity = solution_identity(request, transit, shape, start)
    kept = None if context.anew else _kept(context, identity, transit)
    if kept is not None:
        return kept
    found = invert(transit, shape, start=start, threads=context.settings.threads, progress=progress)
    if not context.anew:
        _keep(context, identity, found)
    return found


def solution_identity(
    request: ResolvedOnTransit, transit: Transit, shape: Shape, start: Vector | None
) -> str:
    """Identity of a solution: bytes of the transit, parameters, diffraction PSF, noise, shape, start and versions."""
    return canonical_hash(
        {
            "kind": "solution",
            "transit": request.transit_id,
            "saturation_dn": request.saturation_dn,
            "diffraction": diffraction_identity(request),
            # This is not the noise of the request: a diagnosis may replace it by the noise measured in the images.
            "noise": [float(transit.noise.photon_gain_dn), float(transit.noise.read_noise_dn)],
            "shape": shape.name,
            "start": None if start is None else [float(q) for q in start],
            "algorithm_version": ALGORITHM_VERSION,
            "software_version": software_version(),
            "libraries": library_versions(),
        }
    )


def _kept(context: Context, identity: str, transit: Transit) -> Solution | None:
    """The owner's stored solution with this identity; None if it does not exist or cannot be read."""
    from workers.catalogue.tables import SolutionRow  # a command with --local needs no catalogue

    row = context.catalogue.get(SolutionRow, identity, context.owner)
    if row is None:
        return None
    try:
        return read_solution(
            context.store.verified(row.file_sha256), transit, threads=context.settings.threads
        )
    except (DataError, FileNotFoundError) as error:
        log.warning("job %s: removed the kept solution %s: %s", context.job_id, identity, error)
        context.catalogue.owners.forget_solutions([row])
    except OSError as error:
        log.warning("job %s: could not read the kept solution %s: %s", context.job_id, identity, error)
    return None


def _keep(context: Context, identity: str, solution: Solution) -> None:
    """Store a solution if the owner's quota allows it."""
    from workers.catalogue.owners import OverQuota  # a command with --local needs no catalogue
    from workers.catalogue.tables import SolutionRow

    try:
        with context.store.temporary() as file:
            write_solution(file, solution)
            size = file.stat().st_size
            digest = context.store.keep(file)
        context.catalogue.add(
            SolutionRow(
                owner=context.owner, id=identity, created_at=time.time(), file_sha256=digest, bytes=size
            ),
            context.settings.quota_mib,
        )
    except OverQuota:
        log.info("job %s: no room to keep the solution %s", context.job_id, identity)
    except (DataError, OSError) as error:
        log.warning("job %s: could not keep the solution %s: %s", context.job_id, identity, error)
