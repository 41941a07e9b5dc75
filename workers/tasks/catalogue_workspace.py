"""The workspace of a job of the service: the catalogue, the store, the settings, and functions of the runner."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from workers.catalogue.catalogue import AnyResult, Catalogue, Row
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import ImageRow, PartRow, ProductRow, PsfRow, ReportRow, TransitRow
from workers.contract.identities import interpolated_psf_identity
from workers.contract.jobs import JobError
from workers.contract.kinds import KINDS, ResultType
from workers.contract.requests import PsfBuild, ResolvedDeconvolve, ResolvedOnTransit
from workers.files.garbage import ENTRIES, intact, intact_row
from workers.files.store import Store
from workers.intake.compatibility import DEPRECATED_CODE, deprecated_warning, of_upload
from workers.intake.repair import TABLES
from workers.lookup import row_of
from workers.settings import Settings
from workers.stage_timer import StageTimer
from workers.tasks.workspace import PARTS, Json, Progress, Result, Workspace
from workers.versions import PsfStatus

if TYPE_CHECKING:
    from astropy.io.fits import Header

    from psfcore.deconvolve.run import PsfSource
    from psfcore.psf import Psf
    from psfcore.scatter.inversion import Inverter

ResultRow = ProductRow | PsfRow | ReportRow
WAIT_S = 0.5
MOST_HELPERS = 16


def _not_alone(_work: Callable[[], None]) -> JobError | None:
    raise NotImplementedError("only the runner of a job turns an exception into a job error")


@dataclass(frozen=True)
class CatalogueWorkspace(Workspace):
    """The workspace of a job of the service.

    Attributes
    ----------
    call_for_help
        Function of a number n that asks up to n idle workers to share the parts of the job.
    guarded
        Function that runs one piece of a job that has many pieces; returns the error of the piece, or None.
    others_wait
        Function that returns True if other jobs wait, so that a job of many pieces should raise ``TurnOver``.
    lease
        The lease under which a job takes its pieces.
    """

    catalogue: Catalogue
    store: Store
    settings: Settings
    owner: str
    job_id: str
    report: Progress
    call_for_help: Callable[[int], None] = lambda workers: None
    guarded: Callable[[Callable[[], None]], JobError | None] = _not_alone
    others_wait: Callable[[], bool] = lambda: False
    lease: Lease | None = None
    times: StageTimer = field(default_factory=StageTimer)
    anew: bool = False

    @property
    def threads(self) -> int:
        return self.settings.threads

    @property
    def limits(self) -> FitsLimits:
        return self.settings.image_limits

    # Inputs -------------------------------------------------------------------------------------------

    def row(self, table: type[Row], identity: str) -> Row:
        """The owner's row with this id. Raises DataError "no-such-image", "no-such-psf", ... if there is none."""
        return row_of(self.catalogue, table, identity, self.owner)

    def image_file(self, identity: str) -> Path:
        return self.store.verified(self.row(ImageRow, identity).id)

    def psf(self, identity: str, *, parts: bool = True) -> Psf:
        return self.psf_of(self.row(PsfRow, identity), parts=parts)

    def psf_of(self, row: PsfRow, *, parts: bool = True) -> Psf:
        """The PSF of a row."""
        from psfcore.fits.psfs import read_psf  # loads numerical libraries

        return read_psf(self.store.verified(row.file_sha256), self.settings.psf_limits, parts=parts)

    def psf_source(self, request: ResolvedDeconvolve) -> PsfSource:
        # A worker loads numerical libraries with its first job.
        from psfcore.deconvolve.run import PsfSource, UsedPsf
        from psfcore.psf_sampling import with_scale
        from workers.tasks.deconvolve import possible_psfs, prepared_psfs

        row, scale = self._requested_psf(request), request.plate_scale_arcsec

        def seen_as(psf: Psf) -> Psf:
            # The request of an upload or of a certification may say what the file does not contain.
            instrument, angstrom = of_upload(row, psf.instrument, psf.wavelength_angstrom)
            return replace(psf, instrument=instrument, wavelength_angstrom=angstrom)

        def possible(_psf: Psf, header: Header) -> Sequence[Psf]:
            return possible_psfs(with_scale(self.psf_of(row), scale), header, threads=self.threads)

        deprecated = deprecated_warning(self.catalogue, row)
        return PsfSource(
            lambda *_: self.psf_of(row, parts=False),
            possible,
            key=(row.file_sha256, self.settings.psf_limits),
            seen_as=seen_as,
            used=UsedPsf(row.id, row.name, row.version, row.status),
            provenance=row.details.get("provenance"),
            plate_scale_arcsec=scale,
            prepared=prepared_psfs(self.settings.psf_cache_mib * 2**20),
            # A rerun repeats an earlier deconvolution, even if it was made by a version that did not compare channels.
            other_channel=request.other_channel or self.anew,
            warnings={} if deprecated is None else {DEPRECATED_CODE: deprecated},
        )

    def _requested_psf(self, request: ResolvedDeconvolve) -> PsfRow:
        """The row of the PSF that a deconvolution names. If the catalogue does not contain this PSF, it is made first:
        built from its recipe, or interpolated between two PSFs, if the request says how.

        Raises DataError "no-such-psf", "instrument-changed" if the recipe now gives another PSF,
        "interpolation-changed" if this version interpolates in another way, and the errors of
        ``workers.tasks.interpolation``.
        """
        recipe, interpolation = request.psf_recipe, request.psf_interpolation
        made = self.made(PsfRow, request.psf_id) if recipe or interpolation else None
        if made is not None:
            return made
        if interpolation is not None:
            if interpolated_psf_identity(interpolation) != request.psf_id:
                raise DataError(
                    "interpolation-changed",
                    f"expected the interpolation that gave PSF {request.psf_id} when the job was submitted; this "
                    "version interpolates in another way: submit the job again",
                )
            KINDS["psf-interpolate"].load_task()(self, interpolation.model_dump())
        elif recipe is not None:
            identity = KINDS["psf-build"].load_task()(self, recipe.model_dump())
            if identity != request.psf_id:
                raise DataError(
                    "instrument-changed",
                    f"expected PSF {request.psf_id} from the instrument file of {recipe.instrument}; got {identity}: "
                    "the file changed after the job was submitted; submit the job again",
                )
        return self.row(PsfRow, request.psf_id)

    def built_psf(self, build: PsfBuild) -> Psf:
        return self.psf(KINDS["psf-build"].load_task()(self, build.model_dump()), parts=False)

    @contextmanager
    def unpacked(self, transit_id: str) -> Iterator[Path]:
        images = int(self.row(TransitRow, transit_id).summary["images"])
        self.report("reading", 0, images)
        with self.store.unpacked(transit_id, self.settings.archive_limits) as folder:
            yield folder

    def inverter(self, request: ResolvedOnTransit) -> Inverter:
        # A deconvolution does not load what an inversion needs.
        from workers.tasks.solutions import KeptSolutions

        kept = KeptSolutions(self.catalogue, self.store, self.settings, self.owner, self.job_id, self.anew)
        return partial(kept.solved, request)

    # Results ------------------------------------------------------------------------------------------

    def made(self, table: type[AnyResult], identity: str) -> AnyResult | None:
        """The row of the result of an earlier job; None if there is none or if one of its files is lost."""
        return intact_row(self.catalogue, self.store, table, identity, self.owner)

    def has(self, result: ResultType, identity: str) -> bool:
        return self.made(TABLES[result], identity) is not None

    def add(self, result: Result) -> None:
        row = self.stored(result)
        if result.type == ResultType.PRODUCT:
            self.report(
                "saving", 1, 1
            )  # raises an exception if the job must stop, so that no product is kept
        self.add_row(row)

    def keep(self, result: Result) -> ResultRow:
        """Write the files of a result into the store and add its row; returns the row in the catalogue."""
        return self.add_row(self.stored(result))

    def add_row(self, row: Any) -> ResultRow:
        """Add the row of a result, whose files are in the store; returns the row in the catalogue.

        If an earlier result has this identity and has lost a file, its row gets the new files. Raises DataError
        "psf-not-the-same" if this would change the content of a PSF that was certified.
        """
        earlier, new = self.catalogue.add(row)
        kept: ResultRow = earlier
        if new or intact(self.store, kept):
            return kept
        if (
            isinstance(kept, PsfRow)
            and kept.status != PsfStatus.DRAFT
            and kept.file_sha256 != row.file_sha256
        ):
            raise DataError(
                "psf-not-the-same",
                f"expected the lost file of PSF {kept.id} to be made again bit for bit, because the PSF was "
                "certified; this version of the software makes another file: ask the operator to restore the store "
                "from a backup",
            )
        refiled: ResultRow = self.catalogue.refile(row)
        return refiled

    def stored(self, result: Result) -> ResultRow:
        """The row of a result, with its files in the store. The row is not in the catalogue."""
        files = dict(result.files)
        write, draw = files.pop("file"), files.pop("preview", None)
        with ThreadPoolExecutor(1) as beside:
            # A worker with one thread draws the picture in this thread: a second thread would slow down the other
            # workers.
            drawn = beside.submit(self.write, draw) if draw is not None and self.threads > 1 else None
            file_sha256, size_bytes = self.write(write)
        if draw is not None:
            preview = (self.write(draw) if drawn is None else drawn.result())[0]
        entries: dict[str, object] = {ENTRIES[name]: self.write(write)[0] for name, write in files.items()}
        figures = [self.write(partial(Path.write_bytes, data=png))[0] for png in result.figures()]
        if figures:
            entries["figures_sha256"] = figures
        row: ResultRow = TABLES[result.type](
            owner=self.owner,
            id=result.id,
            created_at=time.time(),
            file_sha256=file_sha256,
            bytes=size_bytes,
            preview_sha256=entries.get(ENTRIES["thumbnail"]) if draw is None else preview,
            details={**result.details, **entries},
            **result.columns,
        )
        return row

    def write(self, write: Callable[[Path], object]) -> tuple[str, int]:
        """Write a file into the store; returns its SHA-256 and its size in bytes."""
        with self.store.temporary() as path:
            write(path)
            size_bytes = path.stat().st_size
            return self.store.keep(path), size_bytes

    # Parts that several workers compute ---------------------------------------------------------------

    def parts(self, identity: str, count: int, compute: Callable[[int, Progress], Json]) -> Sequence[Json]:
        self.catalogue.parts.open(self.owner, identity, count)
        self.call_for_help(min(MOST_HELPERS, count - 1))
        while True:
            done = self.catalogue.parts.results(self.owner, identity)
            self.report(PARTS, len(done), count)
            if len(done) == count:
                return done
            part = self._part(identity)
            if part is None:
                time.sleep(WAIT_S)  # other workers compute the remaining parts
            else:
                self._compute(part, compute, len(done), count)

    def has_parts_left(self, identity: str) -> bool:
        """Whether no worker has taken some part of a job."""
        part = self._part(identity)
        if part is not None:
            self.catalogue.parts.release(part)
        return part is not None

    def assist(self, identity: str, count: int, compute: Callable[[int, Progress], Json]) -> None:
        """Compute parts of a job that another worker runs, until none is left."""
        while (part := self._part(identity)) is not None:
            self._compute(part, compute, 0, count)

    def _part(self, identity: str) -> PartRow | None:
        return self.catalogue.parts.take(self.owner, identity, self.settings.lease_s)

    def _compute(
        self, part: PartRow, compute: Callable[[int, Progress], Json], done: int, count: int
    ) -> None:
        """Compute one part, and renew its lease meanwhile. After an exception the part is released for another
        worker.
        """
        last = time.monotonic()

        def report(_stage: str, _step: int, _steps: int) -> None:
            nonlocal last
            self.report(PARTS, done, count)
            if time.monotonic() - last > self.settings.heartbeat_s:
                last = time.monotonic()
                self.catalogue.parts.heartbeat(part)

        try:
            result = compute(part.number, report)
        except BaseException:
            self.catalogue.parts.release(part)
            raise
        self.catalogue.parts.finish(part, result)
