"""A service in this process, for ``--local``: it accepts the same requests and runs the same tasks, with a temporary catalogue.

Images, PSFs and transits are read from the user's paths and are not copied.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pydantic import TypeAdapter, ValidationError

from psfcore import limited
from psfcore.built.cache import PsfCache
from psfcore.deconvolve.memory import MIB, check_memory
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import read_summary
from psfcore.fits.psfs import stated_id
from psfcore.fits.stored_psf import check_is_psf, cutout
from psfcore.tables import lookup
from psfcore.transit.archive import ArchiveLimits, FolderTransit, list_archive, transit_in
from service.client.errors import ServiceError
from service.client.operations import Operations, Progress
from service.client.outputs import written
from service.views import JobView, ProductView, PsfView, ReportView, TransitDetails
from workers.cache_folder import psf_cache
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ImageRow, ProductRow, PsfRow, ReportRow
from workers.contract.kinds import JobRequest
from workers.contract.phases import Phase
from workers.contract.requests import PsfBuild
from workers.contract.suggestions import explained
from workers.files.collection import files_of
from workers.files.store import Store, sha256_of
from workers.intake import estimates
from workers.intake.deprecated import details_now
from workers.intake.estimates import COSTS
from workers.intake.requests import resolve
from workers.intake.uploads import image_row, transit_row, uploaded_psf_row
from workers.machine import free_bytes
from workers.rows import row_of
from workers.run import runner
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks.data.cached_psfs import CachedPsfs, recipes_in

# The functions in Python read images of this size too. The memory is checked before an image is deconvolved.
MOST_PIXELS = 2**26
_Seen = dict[Path, tuple[int, int]]


class LocalStore(Store):
    """A store that also contains files and folders of the user, without copying them.

    Each file or folder is found by its SHA-256. If it has changed since it was added, reading it raises OSError.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._files: dict[str, _Seen] = {}
        self._folders: dict[str, tuple[FolderTransit, _Seen]] = {}

    def add_file(self, file: Path) -> str:
        """Add a file; returns its SHA-256."""
        file = file.resolve()
        seen = _states(file)
        digest = sha256_of(file)
        _check(seen)
        self._files[digest] = seen
        return digest

    def add_checked(self, file: Path, digest: str) -> None:
        """Add a file whose SHA-256 was just checked."""
        self._files[digest] = _states(file)

    def add_folder(self, folder: Path) -> FolderTransit:
        """Add the transit in a folder. Raises the same DataError as ``transit_in``."""
        before = _states(*(path for path in folder.resolve().iterdir() if path.is_file()))
        found = transit_in(folder)
        seen = {path: before[path] for path in (found.folder / name for name in found.contents.files)}
        _check(seen)
        self._folders[found.sha256] = found, seen
        return found

    def path(self, digest: str) -> Path:
        """Path of a stored file, or of a file of the user."""
        seen = self._files.get(digest)
        if seen is None:
            return super().path(digest)
        _check(seen)
        return next(iter(seen))

    def keep(self, temporary: Path, digest: str | None = None) -> str:
        """Store a file. If the user has a file with this content, the store uses that file and does not change it."""
        digest = digest or sha256_of(temporary)
        return digest if digest in self._files else super().keep(temporary, digest)

    def _force(self, path: Path) -> None:
        """Do nothing: the folder is removed when the command ends."""

    def discard(self, digest: str) -> None:
        """Delete the store's own copy of a file. A file of the user with the same content stays."""
        super().path(digest).unlink(missing_ok=True)

    def verified(self, digest: str) -> Path:
        """As ``Store.verified``. A file of the user is checked as in ``path``, which is quicker."""
        return self.path(digest) if digest in self._files else super().verified(digest)

    @contextmanager
    def unpacked(self, digest: str, limits: ArchiveLimits) -> Iterator[Path]:
        """A folder with the files of a transit: the user's own folder, or an archive that is unpacked."""
        if digest not in self._folders:
            with super().unpacked(digest, limits) as folder:
                yield folder
            return
        found, seen = self._folders[digest]
        _check(seen)
        yield found.folder
        _check(seen)


def _states(*files: Path) -> _Seen:
    """Time of the last change (ns) and size (bytes) of each file."""
    return {file: ((found := file.stat()).st_mtime_ns, found.st_size) for file in files}


def _check(seen: _Seen) -> None:
    """Raise OSError if a file has changed since ``seen`` was recorded."""
    for file, state in _states(*seen).items():
        if state != seen[file]:
            raise OSError(f"{file} changed while it was read; run the command again")


class LocalService(Operations):
    """The requests to a service, which are executed in this process."""

    def __init__(self, settings: Settings, cache: PsfCache | None = None, *, previews: bool = True) -> None:
        """cache: keeps built PSFs for later commands; None: built PSFs are not kept. previews: False if the caller
        downloads no preview of a product, so that none is drawn."""
        self._settings = settings
        self._recipes: dict[str, list[PsfBuild]] = {}  # recipes of the PSFs that a job may build, by its id
        self._store = LocalStore(settings.data_dir)
        self._catalogue = Catalogue(settings.catalogue_url)
        self._catalogue.schema.create()
        self._runner = Runner(
            settings, self._catalogue, self._store, previews=previews, compile_beside=True, total_psfs=True
        )
        self._built = (
            None
            if cache is None
            else CachedPsfs(
                cache,
                self._catalogue,
                self._store,
                DEFAULT_OWNER,
                limits=FitsLimits(max_pixels=settings.max_pixels),
                threads=settings.threads,
                adopt=self._store.add_checked,
            )
        )

    def close(self) -> None:
        """Close the catalogue."""
        self._catalogue.close()

    def upload_image(self, path: str | Path) -> dict[str, Any]:
        """Add an image, after the same check of its header as in a service."""
        source = Path(path)
        summary = read_summary(source, FitsLimits(max_pixels=self._settings.max_pixels))
        if summary.codec is not None:
            limited.prepare()
        sha256 = self._store.add_file(source)
        row = image_row(DEFAULT_OWNER, sha256, source.stat().st_size, source.name, summary)
        self._catalogue.add(row)
        return {"id": row.id, "header": row.summary}

    def upload_transit(self, path: str | Path) -> dict[str, Any]:
        """Add a transit, after the same check of its table of contents as in a service."""
        source = Path(path)
        if source.is_dir():
            try:
                found = self._store.add_folder(source)
            except DataError as error:
                raise ServiceError(error.message, code=error.code) from error
            name = f"{found.folder.name}.tar"
            row = transit_row(DEFAULT_OWNER, found.sha256, found.bytes, name, found.contents)
        else:
            contents = list_archive(source, self._settings.archive_limits)
            sha256 = self._store.add_file(source)
            row = transit_row(DEFAULT_OWNER, sha256, source.stat().st_size, source.name, contents)
        return TransitDetails.of(self._catalogue.add(row)[0]).model_dump(mode="json")

    def upload_psf(
        self,
        path: str | Path,
        *,
        name: str | None = None,
        version: str | None = None,
        instrument: str | None = None,
        channel: str | None = None,
        kind: str | None = None,
    ) -> dict[str, Any]:
        """Add a PSF. As in a service, a PSF that heliopsf made keeps its id. If name, version, instrument, channel or
        kind is given, the PSF gets a new id."""
        source = Path(path)
        limits = FitsLimits(max_pixels=self._settings.max_pixels)
        summary = read_summary(source, limits)
        check_is_psf(source, summary, limits)
        sha256 = self._store.add_file(source)
        row = uploaded_psf_row(
            DEFAULT_OWNER,
            sha256,
            source.stat().st_size,
            source.name,
            summary,
            name=name,
            version=version,
            instrument=instrument,
            channel=channel,
            kind=kind,
        )
        if not any((name, version, instrument, channel, kind)):
            row.id = stated_id(source, limits) or row.id
        return PsfView.of(self._catalogue.add(row)[0]).model_dump(mode="json")

    def image_id(self, path: str | Path, sha256: str) -> str:
        """Add an image; returns its id."""
        identity: str = self.upload_image(path)["id"]
        return identity

    def result_id(self, kind: str, **parameters: Any) -> str:
        """The id that the result of a job with these parameters has or would have. No job is started."""
        return self._resolved(kind, parameters)[1]

    def release(self, product: dict[str, Any]) -> None:
        """Delete a product from the temporary store. Otherwise its files would stay until the service is closed."""
        row = self._row(f"/v1/products/{product['id']}")
        self._catalogue.delete_product(row.id, DEFAULT_OWNER)
        for digest, _ in files_of(row):
            self._store.discard(digest)

    def submit(self, kind: str, **parameters: Any) -> dict[str, Any]:
        """Add a job; ``wait`` runs it."""
        resolved = self._resolved(kind, parameters)
        self._check_memory(kind, resolved[0])
        row, _ = self._catalogue.jobs.submit(kind, *resolved, DEFAULT_OWNER)
        if self._built is not None:
            self._recipes[row.id] = recipes_in(kind, resolved[0])
            for recipe in self._recipes[row.id]:
                self._built.recall(recipe, whole=kind != "deconvolve")
        return JobView.of(row).model_dump(mode="json")

    def _check_memory(self, kind: str, resolved: dict[str, Any]) -> None:
        """Raise DataError "too-much-memory" if a deconvolution needs more than the free memory of this machine."""
        if kind != "deconvolve":
            return
        needed = estimates.estimate(kind, resolved, self._catalogue, DEFAULT_OWNER, self._settings.threads)
        image = self._catalogue.get(ImageRow, resolved["image_id"], DEFAULT_OWNER)
        assert image is not None  # otherwise the request was refused
        # This process already holds the libraries.
        needed_bytes = MIB * (needed.memory_mib - COSTS.worker_mib)
        check_memory(tuple(image.summary["shape"]), needed_bytes, free_bytes())

    def _resolved(self, kind: str, parameters: dict[str, Any]) -> tuple[dict[str, Any], str]:
        """The resolved parameters of a job, and the id of its result."""
        body = {"kind": kind, "parameters": parameters}
        try:
            request = TypeAdapter[JobRequest](JobRequest).validate_python(body)
        except ValidationError as error:
            told = explained(error.errors(), JobRequest)
            faults = (f"{'/'.join(map(str, e['loc'][1:])) or 'kind'}: {said}" for e, said in told)
            raise ServiceError("; ".join(faults)) from error
        return resolve(request, self._catalogue, DEFAULT_OWNER, added_effects=self._settings.added_effects)

    def wait(self, job: dict[str, Any], *, progress: Progress | None = None) -> dict[str, Any]:
        """Run the job; returns its description. Raises ``ServiceError`` if it fails."""
        # After a transient fault the job is tried again, at most max_attempts times.
        while not Phase(job["phase"]).ended:
            self._runner.run(job["id"], progress)
            row = self._catalogue.jobs.get(job["id"])
            assert row is not None
            job = JobView.of(row).model_dump(mode="json")
        for recipe in self._recipes.pop(job["id"], ()):
            assert self._built is not None
            self._built.remember(recipe)
        return self._ended(job)

    def stage_seconds(self) -> dict[str, float]:
        """The time of each stage of all jobs that ran, s, in alphabetical order."""
        spent: dict[str, float] = {}
        for (_, stage), one in self._catalogue.stage_times.all().items():
            spent[stage] = spent.get(stage, 0.0) + one.seconds
        return spent

    def get(self, address: str) -> dict[str, Any]:
        """The description at an address of the service."""
        row = self._row(address)
        match row:
            case ProductRow():
                return ProductView.of(row, details_now(self._catalogue, row)).model_dump(mode="json")
            case ReportRow():
                return ReportView.of(row).model_dump(mode="json")
            case _:
                return PsfView.of(row).model_dump(mode="json")

    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        """Copy a file of the service to ``path``. The file appears there only when it is complete."""
        description, _, part = address.rpartition("/")
        row = self._row(description)
        digests = {
            "file": row.file_sha256,
            "preview": row.preview_sha256,
            "changes": row.details.get("changes_picture_sha256"),
            "thumbnail": row.details.get("thumbnail_sha256"),
            "report": row.details.get("report_sha256"),
            "output": row.details.get("output_sha256"),
            "page": row.details.get("page_sha256"),
        }
        digest = digests[part]
        assert digest is not None
        with written(path, overwrite=overwrite) as partial:
            shutil.copyfile(self._store.verified(digest), partial)

    def ask(self, psf_id: str, question: str, **query: Any) -> dict[str, Any]:
        """The answer to a query from the tables of the PSF."""
        name, _, other = question.partition("/")
        tables = [self._tables(one) for one in (psf_id, other) if one]
        try:
            return lookup.compare(*tables) if other else lookup.QUESTIONS[name](*tables, **query)
        except DataError as error:
            raise ServiceError(error.message, code=error.code) from error

    def psf_cutout(self, psf_id: str, size: int, output: str | Path, *, overwrite: bool = False) -> None:
        """Write the central part of a PSF."""
        row = self._psf(psf_id)
        limits = FitsLimits(max_pixels=self._settings.max_pixels)
        try:
            part = cutout(self._store.verified(row.file_sha256), size, limits)
        except DataError as error:
            raise ServiceError(error.message, code=error.code) from error
        with written(output, overwrite=overwrite) as partial:
            part.write(partial)

    def _tables(self, psf_id: str) -> dict[str, Any]:
        digest = self._psf(psf_id).details.get("tables_sha256")
        if digest is None:
            raise ServiceError(f"expected a PSF with tables; PSF {psf_id} has none", code="no-tables")
        tables: dict[str, Any] = json.loads(self._store.path(digest).read_bytes())
        return tables

    def _psf(self, psf_id: str) -> PsfRow:
        try:
            return row_of(self._catalogue, PsfRow, psf_id, DEFAULT_OWNER)
        except DataError as error:
            raise ServiceError(error.message, code=error.code) from error

    def _row(self, address: str) -> ProductRow | PsfRow | ReportRow:
        _, collection, identity = address.rsplit("/", 2)
        row: ProductRow | PsfRow | ReportRow | None
        if collection == "products":
            row = self._catalogue.get(ProductRow, identity, DEFAULT_OWNER)
        elif collection == "reports":
            row = self._catalogue.get(ReportRow, identity, DEFAULT_OWNER)
        else:
            row = self._catalogue.get(PsfRow, identity, DEFAULT_OWNER)
        assert row is not None
        return row


def _says_more(record: logging.LogRecord) -> bool:
    """Whether a log line says more than that a job failed. The caller gets the error of a failed job anyway."""
    return record.msg != runner.FAILED


@contextmanager
def local_service(*, gap_effects: str = "", previews: bool = True) -> Iterator[LocalService]:
    """A local service on a temporary folder, with the user's cache of built PSFs.

    gap_effects: files and modules that add effects to the library, as in the setting HELIOPSF_GAP_EFFECTS.
    previews: see ``LocalService``.
    """
    with TemporaryDirectory(prefix="heliopsf-") as folder:
        settings = Settings.apart(Path(folder), gap_effects=gap_effects)
        settings = settings.model_copy(update={"max_pixels": MOST_PIXELS})
        service = LocalService(settings, psf_cache(), previews=previews)
        jobs = logging.getLogger(runner.__name__)
        jobs.addFilter(_says_more)
        try:
            yield service
        finally:
            jobs.removeFilter(_says_more)
            service.close()
