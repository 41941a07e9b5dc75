"""Commands with ``--local``: the requests to a service, answered in this process by the functions that a service and
Python use too, without catalogue and store.

`Local` reads the user's files where they are and gives them the ids that a service would give. A result is written only
when the command names a file for the result.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from pydantic import BaseModel, TypeAdapter, ValidationError

from psfcore import limited
from psfcore.deconvolve.box import Box
from psfcore.deconvolve.declaration import KnownScene, check_stop
from psfcore.deconvolve.forward import Convolved, convolve_image
from psfcore.deconvolve.run import UsedPsf
from psfcore.errors import DataError
from psfcore.files import sha256_of
from psfcore.fits.blocks import LIMITS
from psfcore.fits.frame import frame_of
from psfcore.fits.header import check_not_deconvolved, read_summary
from psfcore.fits.observation import read_observation
from psfcore.fits.psfs import stated_id
from psfcore.fits.stored_psf import check_no_product
from psfcore.gap.effect_sources import sha256_of_source
from psfcore.instruments.unknown import unknown_instrument
from psfcore.instruments.workload import check_workload
from psfcore.kernel_files import listening
from service.cli.local_workspace import ImageFile, Inputs, LocalWorkspace, PsfFile, TransitFiles, states_of
from service.client.answers import Ended, Json, Submitted, Uploaded
from service.client.errors import ServiceError
from service.client.operations import Operations, Progress, named_instrument
from service.client.outputs import written
from workers.contract.documents import header_json
from workers.contract.identities import (
    build_for,
    check_noise,
    diffraction_build,
    instrument_of_build,
    product_identity,
    psf_identity,
)
from workers.contract.kinds import KINDS, JobRequest, ResultType
from workers.contract.requests import (
    CrossValidate,
    Deconvolve,
    GapDiagnose,
    PsfBuild,
    PsfFit,
    Report,
    ResolvedDeconvolve,
)
from workers.contract.suggestions import explained
from workers.intake.costs import job_s
from workers.lookup import no_such
from workers.machine import cores, free_bytes
from workers.settings import Settings
from workers.stage_timer import StageTimer
from workers.versions import name_of_upload

COMPILING = "compiling kernels (only once)"
_NOW = "now"  # the context that a service without contexts has too


@dataclass
class Local(Operations):
    """The requests of a command.

    Attributes
    ----------
    folder
        A folder for temporary files.
    gap_effects
        Files and modules that add effects to the gap library.
    """

    folder: Path
    gap_effects: str = ""
    times: StageTimer = field(default_factory=StageTimer)
    inputs: Inputs = field(default_factory=Inputs)
    _jobs: dict[str, BaseModel] = field(default_factory=dict)  # resolved parameters

    def upload_image(self, path: str | Path) -> Uploaded:
        """Add an image, after the same check of its header as in a service."""
        summary = read_summary(path, LIMITS)
        if summary.codec is not None:
            limited.prepare()
        states = states_of(Path(path))
        image = ImageFile(Path(path), states, sha256_of(Path(path)), summary)
        self.inputs.images[image.sha256] = image
        return {"id": image.sha256}

    def image_id(self, path: str | Path, sha256: str) -> str:
        """Add an image; returns its id."""
        return self.upload_image(path)["id"]

    def upload_transit(self, path: str | Path) -> Uploaded:
        """Add a transit, after the same check of its table of contents as in a service."""
        from psfcore.transit.archive import list_archive, transit_in  # a deconvolution does not need it

        path = Path(path)
        if path.is_dir():
            path = path.resolve()
            states = states_of(*(file for file in path.iterdir() if file.is_file()))
            found = transit_in(path)
            states = {path / name: states[path / name] for name in found.contents.files}
            transit = TransitFiles(path, states, found.sha256, found.contents)
        else:
            states = states_of(path)
            contents = list_archive(path, self._settings.archive_limits)
            transit = TransitFiles(path, states, sha256_of(path), contents)
        self.inputs.transits[transit.sha256] = transit
        return {"id": transit.sha256}

    def upload_psf(self, path: str | Path, **described: str | None) -> Uploaded:
        """Add a PSF, and read it. As in a service, a PSF that heliopsf made keeps its id. No command describes the PSF
        anew.
        """
        assert not any(described.values())
        path = Path(path)
        summary = read_summary(path, LIMITS)
        check_no_product(summary)
        states = states_of(path)
        sha256 = sha256_of(path)
        identity = stated_id(path, LIMITS) or sha256
        named = name_of_upload(summary, path.name, sha256)
        self.inputs.psfs[identity] = PsfFile(path, states, sha256, summary, *named)
        self._workspace(identity).psf(identity, parts=False)
        return {"id": identity}

    def psf_of_instrument(self, instrument: str) -> str:
        """Add the PSF of an instrument, which a deconvolution builds without its components."""
        build = PsfBuild.model_validate(named_instrument(instrument))
        self._resolved_build(build)
        self.inputs.builds[psf_identity(build)] = build
        return psf_identity(build)

    def submit(self, kind: str, **parameters: object) -> Submitted:
        """Check a request; ``wait`` computes its result."""
        job_id = uuid.uuid4().hex
        self._jobs[job_id] = self._resolved(kind, parameters)[0]
        return {"id": job_id, "kind": kind}

    def result_id(self, kind: str, **parameters: object) -> str:
        """The id that the result of a request has. Nothing is computed."""
        return self._resolved(kind, parameters)[1]

    def wait(self, job: Submitted, *, progress: Progress | None = None) -> Ended:
        """Compute the result of a request. The progress of a job that counts several times is the percent of its
        estimated time, and after this time the steps of its stage.
        """
        request, started_s = self._jobs.pop(job["id"]), time.monotonic()
        expected_s = self._expected_s(job["kind"], request)

        def report(stage: str, step: int, steps: int) -> None:
            with self.times.step(stage, step):
                share = None if expected_s is None else (time.monotonic() - started_s) / expected_s
                if progress is not None and share is not None and share < 1:
                    progress(stage, int(100 * share), 100)
                elif progress is not None:
                    progress(stage, step, max(steps, 1))

        def compiling(done: bool) -> None:
            with self.times.step(COMPILING, int(done)):
                if not done and progress is not None:
                    progress(COMPILING, 0, 1)

        kind = KINDS[job["kind"]]
        with listening(compiling):
            identity = kind.load_task()(self._workspace(job["id"], report), request.model_dump())
        return {"result": f"{kind.result}/{identity}"}

    def _workspace(self, job_id: str, report: Progress = lambda *_: None) -> LocalWorkspace:
        return LocalWorkspace(self.inputs, self._settings, job_id, report, self.times)

    @property
    def _settings(self) -> Settings:
        return Settings.apart(self.folder, gap_effects=self.gap_effects)

    def _expected_s(self, kind: str, request: BaseModel) -> float | None:
        """The estimated time of a job on a transit, s; None for other jobs, whose steps count the whole job."""
        transit = self.inputs.transits.get(getattr(request, "transit_id", ""))
        if KINDS[kind].counted_whole or transit is None:
            return None
        pixels = transit.contents.pixels
        return job_s(kind, request.model_dump(), pixels) / cores()

    def get(self, address: str) -> dict[str, Json]:
        """The description of a result."""
        beginning, _, identity = address.rpartition("/")
        result = self.inputs.results.get((ResultType(beginning), identity))
        if result is None:
            raise no_such("psf", identity)
        addresses = {name: f"{address}/{name}" for name in result.files}
        return {"id": identity, **result.columns, "details": result.details, **addresses}

    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        """Write a file of a result to ``path``. The file appears there only when it is complete."""
        beginning, identity, name = address.rsplit("/", 2)
        with written(path, overwrite=overwrite) as partial_file:
            self.inputs.results[ResultType(beginning), identity].files[name](partial_file)

    def release(self, product: Uploaded) -> None:
        """Forget a product, which would use memory otherwise."""
        del self.inputs.results[ResultType.PRODUCT, product["id"]]

    def convolve(
        self, image_id: str, edges: KnownScene, report: Progress, **named: object
    ) -> tuple[Convolved, UsedPsf]:
        """Convolve an image with a PSF; returns also how cards name the PSF.

        Parameters
        ----------
        edges
            The scene beyond the edges of the image: "zero" or "symmetric".
        **named
            Further fields of the request for a deconvolution of the image, such as ``psf_id``.
        """
        request = self._resolved_deconvolution(
            Deconvolve.model_validate({"image_id": image_id, "again": True, **named})
        )
        workspace = self._workspace(image_id, report)
        source = workspace.psf_source(request)
        image = read_observation(workspace.image_file(image_id), LIMITS, hdu=request.hdu)
        found = convolve_image(
            image,
            source,
            edges=edges,
            threads=cores(),
            free_bytes=free_bytes(),
            begin=lambda stage, _: partial(report, stage),
        )
        psf = found.psf
        return found, source.used or UsedPsf(request.psf_id, psf.name, psf.version, psf.status)

    def _resolved(self, kind: str, parameters: dict[str, object]) -> tuple[BaseModel, str]:
        """The resolved parameters of a request, and the id of its result."""
        body = {"kind": kind, "parameters": parameters}
        try:
            request = TypeAdapter[JobRequest](JobRequest).validate_python(body)
        except ValidationError as error:
            told = explained(error.errors(), JobRequest)
            faults = (f"{'/'.join(map(str, e['loc'][1:])) or 'kind'}: {said}" for e, said in told)
            raise ServiceError("; ".join(faults)) from error
        if isinstance(request.parameters, Deconvolve):
            deconvolution = self._resolved_deconvolution(request.parameters)
            return deconvolution, product_identity(deconvolution)
        if isinstance(request.parameters, PsfBuild):
            return self._resolved_build(request.parameters), psf_identity(request.parameters)
        of_kind = KINDS[kind]
        assert isinstance(request.parameters, PsfFit | CrossValidate | GapDiagnose | Report)
        assert of_kind.resolved is not None and of_kind.identity is not None
        fields = request.parameters.model_dump() | self._resolved_on_transit(request.parameters)
        resolved = of_kind.resolved.model_validate(fields)
        return resolved, of_kind.identity(resolved)

    @staticmethod
    def _resolved_build(build: PsfBuild) -> PsfBuild:
        check_workload(instrument_of_build(build), build.instrument or "instrument_file")
        return build

    def _resolved_on_transit(
        self, request: PsfFit | CrossValidate | GapDiagnose | Report
    ) -> dict[str, object]:
        """The further fields of a resolved request on a transit, as ``workers.intake.requests`` finds them in a
        catalogue.
        """
        manifest = vars(self.inputs.transits[request.transit_id].contents.manifest)
        if isinstance(request, Report) and request.psf_id is not None:
            check_noise(manifest, request.noise)
            return {"dark_offsets": False}  # no fit is made
        fields: dict[str, object] = {"diffraction_recipe": diffraction_build(manifest, request.noise)}
        if isinstance(request, GapDiagnose):
            effects = self._settings.added_effects
            hashes = tuple(map(sha256_of_source, effects))
            fields |= {"added_effects": effects, "added_effects_sha256": hashes}
        return fields

    def _resolved_deconvolution(self, request: Deconvolve) -> ResolvedDeconvolve:
        summary = self._workspace(request.image_id).summary(request)
        if not request.again:
            check_not_deconvolved(summary.content)
        check_stop(request.method.stop, noise_is_known=request.noise is not None)
        if request.region is not None:
            Box.parse(request.region).checked(summary.shape)
        if request.context not in (None, _NOW):
            raise DataError(
                "no-such-context",
                f"expected no context, because only a service has contexts; got {request.context!r}: leave it out, or "
                "leave out --local",
            )
        psf: dict[str, object] = {"psf_id": request.psf_id}
        if request.psf_id is None:
            if summary.instrument is None:
                raise unknown_instrument(header_json(asdict(summary)))
            recipe = build_for(summary.instrument, frame_of(summary.cards).turn_to_build_deg)
            psf = {"psf_id": psf_identity(recipe), "psf_recipe": recipe}
        elif request.psf_id not in self.inputs.psfs | self.inputs.builds:
            raise no_such("psf", request.psf_id)
        return ResolvedDeconvolve.model_validate(psf | request.model_dump(exclude={"psf_id", "context"}))


@contextmanager
def local(*, gap_effects: str = "") -> Iterator[Local]:
    """The operations of a command with ``--local``; ``gap_effects`` is as in the setting HELIOPSF_GAP_EFFECTS."""
    with TemporaryDirectory(prefix="heliopsf-") as folder:
        yield Local(Path(folder), gap_effects)
