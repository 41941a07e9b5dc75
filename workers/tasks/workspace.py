"""The workspace of a task: where the task finds its inputs, and where it puts its results.

A task knows this interface alone. A service implements it on the catalogue and the store
(`workers.tasks.catalogue_workspace`), a command with ``--local`` on the user's files (`service.cli.local_workspace`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfcore.fits.blocks import FitsLimits
from workers.contract.kinds import KINDS, ResultType, Task
from workers.contract.requests import PsfBuild, ResolvedDeconvolve, ResolvedOnTransit
from workers.settings import Settings
from workers.stage_timer import StageTimer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from psfcore.deconvolve.run import PsfSource
    from psfcore.psf import Psf
    from psfcore.recipe import Recipe
    from psfcore.scatter.inversion import Inverter

Progress = Callable[[str, int, int], None]
Json = dict[str, object]
PARTS = "folds"  # the stage of the parts of a job


class TurnOver(Exception):
    """A turn of a bulk run ends before all images are done, so that other jobs can run. The job of the turn is queued
    again as if it had not started.
    """


@dataclass(frozen=True)
class Result:
    """A result of a task, whose files are not yet written.

    Attributes
    ----------
    details
        Entries that describe the result.
    files
        Functions that write the files, by name: "file" is the result itself, "preview" its picture (PNG), "html" its
        page.
    columns
        Further columns of the row in a catalogue.
    figures
        Function that draws the figures of the page (PNG).
    """

    type: ResultType
    id: str
    details: Mapping[str, Any]
    files: Mapping[str, Callable[[Path], object]]
    columns: Mapping[str, Any] = field(default_factory=dict)
    figures: Callable[[], Sequence[bytes]] = lambda: ()


def task_of(kind: str) -> Callable[[Callable[[Any, Any, str], None]], Task]:
    """Make the task of a kind of job from a function that adds its result: task(workspace, request, identity).

    The task gets the resolved parameters as JSON, and returns the identity of the result. If an earlier job made the
    result, the function is not called.
    """
    row = KINDS[kind]

    def task_from(add: Callable[[Any, Any, str], None]) -> Task:
        @wraps(add)
        def task(workspace: Workspace, parameters: Mapping[str, object]) -> str:
            assert row.resolved is not None and row.identity is not None
            request = row.resolved.model_validate(parameters)
            identity = row.identity(request)
            if not workspace.has(row.result, identity):
                add(workspace, request, identity)
            return identity

        return task

    return task_from


class Workspace(ABC):
    """What every task may use.

    Attributes
    ----------
    report
        Function of a stage, a step and the number of steps that reports progress; it raises an exception if the job
        must stop.
    times
        The timer of the reported stages. If the pieces of a job report their own stages, the time of these stages is
        measured instead.
    anew
        Whether the job is a rerun, which must compute everything again.
    """

    settings: Settings
    job_id: str
    report: Progress
    times: StageTimer
    anew: bool

    @property
    @abstractmethod
    def threads(self) -> int:
        """Threads of a computation."""

    @property
    @abstractmethod
    def limits(self) -> FitsLimits:
        """Limits for the FITS files that a task opens."""

    @abstractmethod
    def has(self, result: ResultType, identity: str) -> bool:
        """Whether an earlier job made this result, and all its files are there. If not, the task makes the result."""

    @abstractmethod
    def add(self, result: Result) -> None:
        """Add a result; the workspace writes its files, now or when they are asked for."""

    @abstractmethod
    def image_file(self, identity: str) -> Path:
        """The file of an uploaded image. Raises DataError "no-such-image"."""

    def shape_to_check(self, request: ResolvedDeconvolve) -> tuple[int, int] | None:
        """The shape (ny, nx) of an image that must fit into the free memory; None: this was checked when the job was
        submitted.
        """
        return None

    @abstractmethod
    def psf_source(self, request: ResolvedDeconvolve) -> PsfSource:
        """The PSF of a deconvolution, without its components. Raises DataError "no-such-psf"."""

    @abstractmethod
    def psf(self, identity: str, *, parts: bool = True) -> Psf:
        """The PSF with this id, with its components and errors if ``parts`` is True. Raises DataError "no-such-psf"."""

    def build(
        self, recipe: Recipe, mount_image: NDArray[np.floating] | None, progress: Callable[[int, int], None]
    ) -> tuple[Psf, Callable[[Path], object]]:
        """The PSF of a recipe, and a function that writes its file.

        Parameters
        ----------
        mount_image
            The pixels of the mask image of the instrument's mount, if it has one.
        """
        # Most jobs do not load the libraries of the diffraction.
        from psfcore.build import build_recipe
        from psfcore.fits.psfs import write_psf

        psf = build_recipe(recipe, mount_image=mount_image, threads=self.threads, progress=progress)
        return psf, partial(write_psf, psf=psf, instrument_file=recipe.text.encode())

    @abstractmethod
    def built_psf(self, build: PsfBuild) -> Psf:
        """The PSF of a recipe without its components; it is built if it does not exist."""

    @abstractmethod
    def unpacked(self, transit_id: str) -> AbstractContextManager[Path]:
        """A folder with the files of a transit. Begins the stage "reading". Raises DataError "no-such-transit"."""

    def inverter(self, request: ResolvedOnTransit) -> Inverter | None:
        """A function that gives the solution of the request's transit which an earlier job kept; None: it is
        computed.
        """
        return None

    def parts(self, identity: str, count: int, compute: Callable[[int, Progress], Json]) -> Sequence[Json]:
        """The results of all parts of a job: ``compute(number, progress)`` for each number below ``count``.

        Parameters
        ----------
        identity
            The identity of the job's result; other workers may compute parts of this result.
        """
        done: list[Json] = []
        for number in range(count):
            self.report(PARTS, number, count)
            done.append(compute(number, lambda *_: self.report(PARTS, len(done), count)))
        self.report(PARTS, count, count)
        return done
