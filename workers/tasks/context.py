"""The context of a task: the catalogue, the store, the settings, and functions of the runner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import ProductRow, PsfRow, ReportRow
from workers.contract.jobs import JobError
from workers.files.collection import intact
from workers.files.store import Store
from workers.settings import Settings
from workers.stage_timer import StageTimer
from workers.versions import PsfStatus

Result = TypeVar("Result", ProductRow, PsfRow, ReportRow)


class TurnOver(Exception):
    """A turn of a bulk run ends before all images are done, so that other jobs can run. The job of the turn is queued
    again as if it had not started."""


def _not_alone(_work: Callable[[], None]) -> JobError | None:
    raise NotImplementedError("only the runner of a job turns an exception into a job error")


@dataclass(frozen=True)
class Context:
    """The objects and functions that a task may use.

    report(stage, step, steps): reports progress; raises an exception if the job must stop.
    call_for_help(n): asks up to n idle workers to share the parts of the job.
    guarded(work): runs one piece of a job that has many pieces; returns the error of the piece, or None.
    others_wait(): True if other jobs wait, so that a job of many pieces should raise ``TurnOver``.
    lease: the lease under which a job takes its pieces.
    times: measures the time of the reported stages. If the pieces of a job report their own stages, the time of these
    stages is measured instead.
    anew: True for a rerun: compute everything again, and use no solution that an earlier job kept.
    """

    catalogue: Catalogue
    store: Store
    settings: Settings
    owner: str
    job_id: str
    report: Callable[[str, int, int], None]
    call_for_help: Callable[[int], None] = lambda workers: None
    guarded: Callable[[Callable[[], None]], JobError | None] = _not_alone
    others_wait: Callable[[], bool] = lambda: False
    lease: Lease | None = None
    times: StageTimer = field(default_factory=StageTimer)
    anew: bool = False

    @property
    def limits(self) -> FitsLimits:
        """Limits for the FITS files that a task opens."""
        return FitsLimits(max_pixels=self.settings.max_pixels)

    def made(self, table: type[Result], identity: str) -> Result | None:
        """The result of an earlier job; None if there is no such result or if one of its files is lost. If the
        answer is None, the task makes the result.
        """
        row = self.catalogue.get(table, identity, self.owner)
        return row if row is not None and intact(self.store, row) else None

    def add(self, row: Result) -> Result:
        """Add a result, whose files are in the store; returns the row in the catalogue.

        If an earlier result has this identity and has lost a file, its row gets the new files. Raises DataError
        "psf-not-the-same" if this would change the content of a PSF that was certified.
        """
        there, new = self.catalogue.add(row)
        if new or intact(self.store, there):
            return there
        if (
            isinstance(there, PsfRow)
            and there.status != PsfStatus.DRAFT
            and there.file_sha256 != row.file_sha256
        ):
            raise DataError(
                "psf-not-the-same",
                f"expected the lost file of PSF {there.id} to be made again bit for bit, because the PSF was certified; this "
                "version of the software makes another file: ask the operator to restore the store from a backup",
            )
        return self.catalogue.refile(row)
