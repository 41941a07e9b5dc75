"""Kept solutions of transits, shared by the jobs of an owner.

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
from dataclasses import dataclass

from psfcore.arrays import Vector
from psfcore.errors import DataError
from psfcore.scatter.inversion import ALGORITHM_VERSION, invert
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.scatter.shapes import Shape
from psfcore.scatter.solution_file import read_solution, write_solution
from psfcore.transit.transit import Transit
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.quotas import OverQuota
from workers.catalogue.tables import SolutionRow
from workers.contract.identities import canonical_hash, diffraction_identity
from workers.contract.requests import ResolvedOnTransit
from workers.files.store import Store
from workers.settings import Settings, library_versions, software_version

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class KeptSolutions:
    """The kept solutions of an owner, as a job uses them.

    Attributes
    ----------
    anew
        Whether the job is a rerun.
    """

    catalogue: Catalogue
    store: Store
    settings: Settings
    owner: str
    job_id: str
    anew: bool = False

    def solved(
        self,
        request: ResolvedOnTransit,
        transit: Transit,
        shape: Shape,
        /,
        *,
        start: Vector | None,
        threads: int,
        progress: Progress,
    ) -> Solution:
        """The solution of a transit: the owner's stored solution if it exists; otherwise a new solution.

        A new solution is stored if the owner's quota allows it. A rerun always computes a new solution and does not
        store it.

        Parameters
        ----------
        transit
            The transit as ``load_transit`` returns it for the request; only its noise may be replaced.

        Raises
        ------
        DataError
            The errors of ``psfcore.scatter.inversion.invert``.
        """
        identity = solution_identity(request, transit, shape, start)
        kept = None if self.anew else self._kept(identity, transit, threads)
        if kept is not None:
            return kept
        found = invert(transit, shape, start=start, threads=threads, progress=progress)
        if not self.anew:
            self._keep(identity, found)
        return found

    def _kept(self, identity: str, transit: Transit, threads: int) -> Solution | None:
        """The owner's stored solution with this identity; None if it does not exist or cannot be read."""
        row = self.catalogue.get(SolutionRow, identity, self.owner)
        if row is None:
            return None
        try:
            return read_solution(self.store.verified(row.file_sha256), transit, threads=threads)
        except (DataError, FileNotFoundError) as error:
            log.warning("job %s: removed the kept solution %s: %s", self.job_id, identity, error)
            self.catalogue.quotas.forget_solutions([row])
        except OSError as error:
            log.warning("job %s: could not read the kept solution %s: %s", self.job_id, identity, error)
        return None

    def _keep(self, identity: str, solution: Solution) -> None:
        """Store a solution if the owner's quota allows it."""
        try:
            with self.store.temporary() as file:
                write_solution(file, solution)
                size = file.stat().st_size
                digest = self.store.keep(file)
            self.catalogue.add(
                SolutionRow(
                    owner=self.owner, id=identity, created_at=time.time(), file_sha256=digest, bytes=size
                ),
                self.settings.quota_mib,
            )
        except OverQuota:
            log.info("job %s: no room to keep the solution %s", self.job_id, identity)
        except (DataError, OSError) as error:
            log.warning("job %s: could not keep the solution %s: %s", self.job_id, identity, error)


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
