"""The jobs of a service in the process of a test: it accepts the same requests and runs the same tasks, without
HTTP."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from psfcore.files import sha256_of
from psfcore.fits.header import read_summary
from psfcore.fits.psfs import stated_id
from psfcore.fits.stored_psf import check_is_psf
from psfcore.tables import lookup
from psfcore.transit.archive import list_archive, pack
from service.client.operations import Operations, Progress
from service.client.outputs import written
from service.views import JobView, ProductView, PsfView, ReportView
from tests.workers.jobs import run_job
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow, PsfRow, ReportRow
from workers.contract.jobs import Phase
from workers.contract.kinds import JobRequest
from workers.files.store import Store
from workers.intake.compatibility import details_now
from workers.intake.requests import resolve
from workers.intake.uploads import Upload, image_row, transit_row, uploaded_psf_row
from workers.lookup import row_of
from workers.run.attempt import Attempt
from workers.run.runner import Runner
from workers.settings import Settings

_TABLES: dict[str, Any] = {"products": ProductRow, "reports": ReportRow, "psfs": PsfRow}


@contextmanager
def _reports_to(progress: Progress | None) -> Iterator[None]:
    """Pass on what tasks report while the block runs."""
    report = Attempt.report

    def also_tell(attempt: Attempt, stage: str, step: int, steps: int) -> None:
        report(attempt, stage, step, steps)
        if progress is not None:
            progress(stage, step, max(steps, 1))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Attempt, "report", also_tell)
        yield


class InProcess(Operations):
    """A service that runs a job when a test waits for it. Every error is that of the task, or of the request."""

    def __init__(self, settings: Settings) -> None:
        self.settings, self.store = settings, Store(settings.data_dir)
        self.catalogue = Catalogue(settings.catalogue_url)
        self.catalogue.upgrade()
        self._runner = Runner(settings, self.catalogue, self.store)
        self._limits = settings.image_limits

    def close(self) -> None:
        self.catalogue.close()

    def _kept(self, path: Path) -> Upload:
        """Copy a file into the store."""
        with self.store.temporary() as copy:
            shutil.copyfile(path, copy)
            return Upload(DEFAULT_OWNER, self.store.keep(copy), path.stat().st_size, path.name)

    def upload_image(self, path: str | Path) -> dict[str, Any]:
        row = image_row(self._kept(Path(path)), read_summary(path, self._limits))
        self.catalogue.add(row)
        return {"id": row.id, "header": row.summary}

    def upload_transit(self, path: str | Path) -> dict[str, Any]:
        archive = Path(path)
        if archive.is_dir():
            archive = self.settings.data_dir / f"{archive.name}.tar"
            pack(path, archive)
        row = transit_row(self._kept(archive), list_archive(archive, self.settings.archive_limits))
        return {"id": self.catalogue.add(row)[0].id}

    def upload_psf(self, path: str | Path, **described: Any) -> dict[str, Any]:
        summary = read_summary(path, self._limits)
        check_is_psf(path, summary, self._limits)
        row = uploaded_psf_row(self._kept(Path(path)), summary, **described)
        if not any(described.values()):
            row.id = stated_id(path, self._limits) or row.id
        return PsfView.of(self.catalogue.add(row)[0]).model_dump(mode="json")

    def image_id(self, path: str | Path, sha256: str) -> str:
        assert sha256 == sha256_of(Path(path))
        return str(self.upload_image(path)["id"])

    def _resolved(self, kind: str, parameters: dict[str, Any]) -> tuple[dict[str, Any], str]:
        request = TypeAdapter[JobRequest](JobRequest).validate_python(
            {"kind": kind, "parameters": parameters}
        )
        effects = self.settings.added_effects
        return resolve(request, self.catalogue, DEFAULT_OWNER, added_effects=effects)

    def result_id(self, kind: str, **parameters: Any) -> str:
        return self._resolved(kind, parameters)[1]

    def submit(self, kind: str, **parameters: Any) -> dict[str, Any]:
        row, _ = self.catalogue.jobs.submit(kind, *self._resolved(kind, parameters), DEFAULT_OWNER)
        return JobView.of(row).model_dump(mode="json")

    def wait(self, job: dict[str, Any], *, progress: Progress | None = None) -> dict[str, Any]:
        while not Phase(job["phase"]).ended:
            with _reports_to(progress):
                run_job(self._runner, self.catalogue, job["id"])
            row = self.catalogue.jobs.get(job["id"])
            assert row is not None
            job = JobView.of(row).model_dump(mode="json")
        return self._ended(job)

    def release(self, product: dict[str, Any]) -> None:
        pass

    def _row(self, address: str) -> Any:
        _, collection, identity = address.rsplit("/", 2)
        return row_of(self.catalogue, _TABLES[collection], identity, DEFAULT_OWNER)

    def get(self, address: str) -> dict[str, Any]:
        row = self._row(address)
        if isinstance(row, ProductRow):
            return ProductView.of(row, details_now(self.catalogue, row)).model_dump(mode="json")
        view: Any = ReportView if isinstance(row, ReportRow) else PsfView
        described: dict[str, Any] = view.of(row).model_dump(mode="json")
        return described

    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        description, _, part = address.rpartition("/")
        row = self._row(description)
        names = {"changes": "changes_picture_sha256"}
        column = {"file": row.file_sha256, "preview": row.preview_sha256}.get(part)
        digest = column or row.details[names.get(part, f"{part}_sha256")]
        with written(path, overwrite=overwrite) as partial:
            shutil.copyfile(self.store.verified(digest), partial)

    def ask(self, psf_id: str, question: str, **query: Any) -> dict[str, Any]:
        """The answer of a PSF's tables to a question."""
        digest = self._row(f"/v1/psfs/{psf_id}").details["tables_sha256"]
        return lookup.QUESTIONS[question](json.loads(self.store.path(digest).read_bytes()), **query)
