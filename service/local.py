"""The service's work in this process, for ``--local``: the same tasks on a catalogue of its own."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pydantic import TypeAdapter, ValidationError

from psfcore.errors import DataError
from psfcore.fits.cutout import cutout
from psfcore.fits.header import FitsLimits, read_summary
from psfcore.tables import lookup as psf_lookup
from psfcore.transit.archive import list_archive
from service.api.jobs import JobView
from service.api.products import ProductView
from service.api.psfs.versions import PsfView
from service.api.reports import ReportView
from service.api.transits import TransitDetails
from service.client.http import Operations, Progress, ServiceError, as_archive
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow, PsfRow, ReportRow
from workers.contract.kinds import JobRequest
from workers.contract.phases import Phase
from workers.contract.suggestions import explained
from workers.files.store import Store
from workers.intake.requests import resolve
from workers.intake.uploads import image_row, transit_row, uploaded_psf_row
from workers.run.runner import Runner
from workers.settings import Settings


class LocalService(Operations):
    """The operations of a service, done here and now."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._store = Store(settings.data_dir)
        self._catalogue = Catalogue(settings.catalogue_url)
        self._catalogue.upgrade()
        self._runner = Runner(settings, self._catalogue, self._store)

    def close(self) -> None:
        """Close the catalogue."""
        self._catalogue.close()

    def upload_image(self, path: str | Path) -> dict[str, Any]:
        """Take an image in; its header is checked as a service would."""
        source = Path(path)
        summary = read_summary(source, FitsLimits(max_pixels=self._settings.max_pixels))
        sha256 = self._keep(source)
        row = image_row(DEFAULT_OWNER, sha256, source.stat().st_size, source.name, summary)
        self._catalogue.add(row)
        return {"id": row.id, "header": row.summary}

    def upload_transit(self, path: str | Path) -> dict[str, Any]:
        """Take a transit in; its archive's table of contents is checked as a service would."""
        with as_archive(Path(path)) as source:
            contents = list_archive(source, self._settings.archive_limits)
            sha256 = self._keep(source)
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
        """Take a PSF in."""
        source = Path(path)
        summary = read_summary(source, FitsLimits(max_pixels=self._settings.max_pixels))
        sha256 = self._keep(source)
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
        return PsfView.of(self._catalogue.add(row)[0]).model_dump(mode="json")

    def submit(self, kind: str, **parameters: Any) -> dict[str, Any]:
        """Write a job down; ``wait`` runs it."""
        body = {"kind": kind, "parameters": parameters}
        try:
            request = TypeAdapter[JobRequest](JobRequest).validate_python(body)
        except ValidationError as error:
            told = explained(error.errors(), JobRequest)
            faults = (f"{'/'.join(map(str, e['loc'][1:])) or 'kind'}: {said}" for e, said in told)
            raise ServiceError("; ".join(faults)) from error
        resolved = resolve(
            request, self._catalogue, DEFAULT_OWNER, added_effects=self._settings.added_effects
        )
        row, _ = self._catalogue.jobs.submit(kind, *resolved, DEFAULT_OWNER)
        return JobView.of(row).model_dump(mode="json")

    def wait(self, job: dict[str, Any], *, progress: Progress | None = None) -> dict[str, Any]:
        """Run the job here; returns it completed, or raises ``ServiceError``."""
        while not Phase(job["phase"]).ended:  # a passing failure is tried again, as often as the settings say
            self._runner.run(job["id"], progress)
            row = self._catalogue.jobs.get(job["id"])
            assert row is not None
            job = JobView.of(row).model_dump(mode="json")
        return self._ended(job)

    def get(self, address: str) -> dict[str, Any]:
        """The description at an address of the service."""
        row = self._row(address)
        match row:
            case ProductRow():
                return ProductView.of(row).model_dump(mode="json")
            case ReportRow():
                return ReportView.of(row).model_dump(mode="json")
            case _:
                return PsfView.of(row).model_dump(mode="json")

    def download(self, address: str, path: str | Path) -> None:
        """Copy a file out."""
        description, _, part = address.rpartition("/")
        row = self._row(description)
        digests = {
            "file": row.file_sha256,
            "preview": row.preview_sha256,
            "changes": row.details.get("changes_picture_sha256"),
            "report": row.details.get("report_sha256"),
            "output": row.details.get("output_sha256"),
            "page": row.details.get("page_sha256"),
        }
        digest = digests[part]
        assert digest is not None
        shutil.copyfile(self._store.path(digest), path)

    def ask(self, psf_id: str, question: str, **query: Any) -> dict[str, Any]:
        """The answer of the tables that are kept here."""
        name, _, other = question.partition("/")
        tables = [self._tables(one) for one in (psf_id, other) if one]
        try:
            return psf_lookup.compare(*tables) if other else psf_lookup.QUESTIONS[name](*tables, **query)
        except DataError as error:
            raise ServiceError(error.message, code=error.code) from error

    def psf_cutout(self, psf_id: str, size: int, output: str | Path) -> None:
        """Cut the middle out of a PSF that is kept here."""
        row = self._psf(psf_id)
        limits = FitsLimits(max_pixels=self._settings.max_pixels)
        try:
            Path(output).write_bytes(cutout(self._store.path(row.file_sha256), size, limits))
        except DataError as error:
            raise ServiceError(error.message, code=error.code) from error

    def _tables(self, psf_id: str) -> dict[str, Any]:
        digest = self._psf(psf_id).details.get("tables_sha256")
        if digest is None:
            raise ServiceError(f"PSF {psf_id} has no tables yet", code="no-tables")
        tables: dict[str, Any] = json.loads(self._store.path(digest).read_bytes())
        return tables

    def _psf(self, psf_id: str) -> PsfRow:
        row = self._catalogue.get(PsfRow, psf_id, DEFAULT_OWNER)
        if row is None:
            raise ServiceError(f"the catalogue holds no PSF with id {psf_id}", code="no-such-psf")
        return row

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

    def _keep(self, source: Path) -> str:
        with self._store.temporary() as copy:
            shutil.copyfile(source, copy)
            return self._store.keep(copy)


@contextmanager
def local_service(*, gap_effects: str = "") -> Iterator[LocalService]:
    """A local service on a folder that is gone afterwards. gap_effects: as the setting of that name."""
    with TemporaryDirectory(prefix="heliopsf-") as folder:
        service = LocalService(Settings.apart(Path(folder), gap_effects=gap_effects))
        try:
            yield service
        finally:
            service.close()
