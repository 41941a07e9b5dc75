"""Commands with ``--local``: the requests to a service, answered in this process by the functions that a service and
Python use too, without catalogue and store.

`Local` reads the user's files where they are and gives them the ids that a service would give. A result is written only when
the command names a file for the result.
"""

from __future__ import annotations

import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from astropy.io.fits import Header
from pydantic import TypeAdapter, ValidationError

from psfcore import limited
from psfcore.compiled import listening
from psfcore.deconvolve import run
from psfcore.deconvolve.box import Box
from psfcore.deconvolve.conditions import PreparedPsfs
from psfcore.deconvolve.run import BUILDING, Identities, UsedPsf
from psfcore.errors import DataError, module_of_extra
from psfcore.files import sha256_of
from psfcore.fits.blocks import LIMITS
from psfcore.fits.frame import frame_of
from psfcore.fits.header import HeaderSummary, check_not_deconvolved, optional_text, read_summary
from psfcore.fits.observation import read_observation
from psfcore.fits.psfs import read_psf, stated_id
from psfcore.fits.stored_psf import check_no_product
from psfcore.gap.effect_sources import sha256_of_source
from psfcore.instruments.model import parse_instrument
from psfcore.instruments.unknown import channel_of, unknown_instrument
from psfcore.instruments.workload import check_workload
from psfcore.psf import Kernel, Psf, light_beyond_pct
from psfcore.psf_cache import built_file, kept_psf
from psfcore.transit.archive import ArchiveContents, list_archive, transit_in, unpack
from service.client.errors import ServiceError
from service.client.operations import Operations, Progress, named_instrument
from service.client.outputs import written
from workers.contract.identities import (
    build_for,
    check_noise,
    diffraction_build,
    instrument_text,
    product_identity,
    psf_identity,
    recipe_of,
)
from workers.contract.kinds import KINDS, JobRequest
from workers.contract.requests import (
    Deconvolve,
    GapDiagnose,
    PsfBuild,
    Report,
    ResolvedCrossValidate,
    ResolvedDeconvolve,
    ResolvedGapDiagnose,
    ResolvedOnTransit,
    ResolvedPsfFit,
    ResolvedReport,
    options_of,
)
from workers.contract.suggestions import explained
from workers.files.archive import safe_name
from workers.intake.costs import job_s
from workers.machine import cores, free_bytes, psf_cache
from workers.settings import Settings, software_version
from workers.stage_timer import StageTimer
from workers.versions import PsfStatus, instrument_of, name_of_upload

if TYPE_CHECKING:
    from psfcore.transit.prepare import Prepared
    from psfcore.transit.transit import Transit

COMPILING = "compiling kernels (only once)"
_NOW = "now"  # the context that a service without contexts has too
_Report = Callable[[str, int, int], None]


class _Files:
    """Files of the user. ``check`` raises OSError if one of them has changed since it was added."""

    def __init__(self, *files: Path) -> None:
        self._seen = {file: _state(file) for file in files}

    def only(self, files: Iterable[Path]) -> _Files:
        """Some of these files, with the state that was recorded first."""
        some = _Files()
        some._seen = {file: self._seen[file] for file in files}
        return some

    def check(self) -> None:
        for file, state in self._seen.items():
            if _state(file) != state:
                raise OSError(f"{file} changed while it was read; run the command again")


def _state(file: Path) -> tuple[int, int]:
    """Time of the last change (ns) and size (bytes) of a file."""
    return (found := file.stat()).st_mtime_ns, found.st_size


@dataclass(frozen=True)
class _Image:
    path: Path
    files: _Files
    sha256: str
    summary: HeaderSummary


@dataclass(frozen=True)
class _NamedPsf(_Image):
    """A PSF in a file. name: as products name it."""

    name: UsedPsf

    def seen_as(self, psf: Psf) -> Psf:
        """The PSF with the name, the instrument and the wavelength that an upload would get from the header."""
        instrument = psf.instrument or instrument_of(asdict(self.summary))
        channel = channel_of(instrument, self.summary.wavelnth) or ""
        angstrom = psf.wavelength_angstrom
        if angstrom is None and channel.isdecimal():
            angstrom = float(channel)
        return replace(psf, name=self.name.name, instrument=instrument, wavelength_angstrom=angstrom)


@dataclass(frozen=True)
class _NamedTransit:
    """A transit in a folder or in an archive."""

    path: Path
    files: _Files
    sha256: str
    bytes: int
    contents: ArchiveContents

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """A folder with its files: the user's own, or a temporary one with the files of the archive."""
        self.files.check()
        if self.path.is_dir():
            yield self.path
            self.files.check()
            return
        with TemporaryDirectory(prefix="heliopsf-") as folder:
            unpack(self.path, folder, Settings.apart(Path(folder)).archive_limits)
            yield Path(folder)


@dataclass
class Local(Operations):
    """The requests of a command. folder: for temporary files. gap_effects: files and modules that add effects to the gap
    library."""

    folder: Path
    gap_effects: str = ""
    times: StageTimer = field(default_factory=StageTimer)
    _images: dict[str, _Image] = field(default_factory=dict)
    _psfs: dict[str, _NamedPsf] = field(default_factory=dict)
    _builds: dict[str, PsfBuild] = field(default_factory=dict)  # PSFs that are built when they are needed
    _transits: dict[str, _NamedTransit] = field(default_factory=dict)
    _read_psfs: dict[tuple[str, bool], Psf] = field(default_factory=dict)
    _prepared: PreparedPsfs = field(default_factory=PreparedPsfs)
    _jobs: dict[str, Any] = field(default_factory=dict)  # resolved parameters
    _results: dict[str, dict[str, Any]] = field(default_factory=dict)  # descriptions by address
    _writers: dict[str, Callable[[Path], object]] = field(default_factory=dict)  # of files, by address

    def upload_image(self, path: str | Path) -> dict[str, Any]:
        """Add an image, after the same check of its header as in a service."""
        summary = read_summary(path, LIMITS)
        if summary.codec is not None:
            limited.prepare()
        files = _Files(Path(path))
        image = _Image(Path(path), files, sha256_of(Path(path)), summary)
        self._images[image.sha256] = image
        return {"id": image.sha256}

    def image_id(self, path: str | Path, sha256: str) -> str:
        """Add an image; returns its id."""
        identity: str = self.upload_image(path)["id"]
        return identity

    def upload_transit(self, path: str | Path) -> dict[str, Any]:
        """Add a transit, after the same check of its table of contents as in a service."""
        path = Path(path)
        if path.is_dir():
            path = path.resolve()
            files = _Files(*(file for file in path.iterdir() if file.is_file()))
            found = transit_in(path)
            files = files.only(path / name for name in found.contents.files)
            transit = _NamedTransit(path, files, found.sha256, found.bytes, found.contents)
        else:
            files = _Files(path)
            contents = list_archive(path, Settings.apart(self.folder).archive_limits)
            transit = _NamedTransit(path, files, sha256_of(path), path.stat().st_size, contents)
        self._transits[transit.sha256] = transit
        return {"id": transit.sha256}

    def upload_psf(self, path: str | Path, **described: Any) -> dict[str, Any]:
        """Add a PSF, and read it. As in a service, a PSF that heliopsf made keeps its id. No command describes the PSF anew."""
        assert not any(described.values())
        path = Path(path)
        summary = read_summary(path, LIMITS)
        check_no_product(summary)
        files = _Files(path)
        sha256 = sha256_of(path)
        identity = stated_id(path, LIMITS) or sha256
        used = UsedPsf(identity, *name_of_upload(summary, path.name, sha256), PsfStatus.DRAFT)
        self._psfs[identity] = _NamedPsf(path, files, sha256, summary, used)
        self._psf(identity, parts=False)
        return {"id": identity}

    def psf_of_instrument(self, instrument: str) -> str:
        """Add the PSF of an instrument, which a deconvolution builds without its components."""
        build = PsfBuild.model_validate(named_instrument(instrument))
        self._resolved_build(build)
        self._builds[psf_identity(build)] = build
        return psf_identity(build)

    def submit(self, kind: str, **parameters: Any) -> dict[str, Any]:
        """Check a request; ``wait`` computes its result."""
        job_id = uuid.uuid4().hex
        self._jobs[job_id] = self._resolved(kind, parameters)[0]
        return {"id": job_id, "kind": kind}

    def result_id(self, kind: str, **parameters: Any) -> str:
        """The id that the result of a request has. Nothing is computed."""
        return self._resolved(kind, parameters)[1]

    def wait(self, job: dict[str, Any], *, progress: Progress | None = None) -> dict[str, Any]:
        """Compute the result of a request. The progress of a job that counts several times is the percent of its estimated time."""
        request, started_s = self._jobs.pop(job["id"]), time.monotonic()
        expected_s = self._expected_s(job["kind"], request)

        def report(stage: str, step: int, steps: int) -> None:
            with self.times.step(stage, step):
                if progress is not None and expected_s is None:
                    progress(stage, step, max(steps, 1))
                elif progress is not None and expected_s is not None:
                    share = (time.monotonic() - started_s) / expected_s
                    progress(stage, min(round(100 * share), 99), 100)

        def compiling(done: bool) -> None:
            with self.times.step(COMPILING, int(done)):
                if not done and progress is not None:
                    progress(COMPILING, 0, 1)

        compute: Callable[[Any, str, _Report], str] = getattr(self, f"_{job['kind'].replace('-', '_')}")
        with listening(compiling):
            address = compute(request, job["id"], report)
        return job | {"result": address}

    def _expected_s(self, kind: str, request: Any) -> float | None:
        """The estimated time of a job on a transit, s; None for other jobs, whose steps count the whole job."""
        if KINDS[kind].counted_whole or getattr(request, "transit_id", None) not in self._transits:
            return None
        pixels = self._transits[request.transit_id].contents.pixels
        return job_s(kind, request.model_dump(), pixels) / cores()

    def get(self, address: str) -> dict[str, Any]:
        """The description of a result."""
        if address not in self._results:
            raise _no_such_psf(address.rpartition("/")[2])
        return self._results[address]

    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        """Write a file of a result to ``path``. The file appears there only when it is complete."""
        with written(path, overwrite=overwrite) as partial_file:
            self._writers[address](partial_file)

    def release(self, product: dict[str, Any]) -> None:
        """Forget a product, which would use memory otherwise."""
        del self._results[f"/v1/products/{product['id']}"]
        for name in ("file", "preview", "changes"):
            del self._writers[product[name]]

    def _resolved(self, kind: str, parameters: dict[str, Any]) -> tuple[Any, str]:
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
        assert of_kind.resolved is not None and of_kind.identity is not None
        fields = request.parameters.model_dump() | self._resolved_on_transit(request.parameters)
        resolved = of_kind.resolved.model_validate(fields)
        return resolved, of_kind.identity(resolved)

    @staticmethod
    def _resolved_build(build: PsfBuild) -> PsfBuild:
        label = build.instrument or "instrument_file"
        check_workload(parse_instrument(instrument_text(build), label), label)
        return build

    def _resolved_on_transit(self, request: Any) -> dict[str, Any]:
        """The further fields of a resolved request on a transit, as ``workers.intake.requests`` finds them in a catalogue."""
        manifest = vars(self._transits[request.transit_id].contents.manifest)
        if isinstance(request, Report) and request.psf_id is not None:
            check_noise(manifest, request.noise)
            return {"dark_offsets": False}  # no fit is made
        fields: dict[str, Any] = {"diffraction_recipe": diffraction_build(manifest, request.noise)}
        if isinstance(request, GapDiagnose):
            effects = Settings.apart(self.folder, gap_effects=self.gap_effects).added_effects
            hashes = tuple(map(sha256_of_source, effects))
            fields |= {"added_effects": effects, "added_effects_sha256": hashes}
        return fields

    def _resolved_deconvolution(self, request: Deconvolve) -> ResolvedDeconvolve:
        summary = self._summary(request)
        if not request.again:
            check_not_deconvolved(summary.content)
        if request.region is not None:
            Box.parse(request.region).checked(summary.shape)
        if request.context not in (None, _NOW):
            raise DataError(
                "no-such-context",
                f"expected the id or name of a context; got {request.context!r}, which does not exist: list the contexts",
            )
        psf: dict[str, Any] = {"psf_id": request.psf_id}
        if request.psf_id is None:
            if summary.instrument is None:
                raise unknown_instrument(asdict(summary))
            recipe = build_for(summary.instrument, frame_of(summary.cards).turn_to_build_deg)
            psf = {"psf_id": psf_identity(recipe), "psf_recipe": recipe}
        elif request.psf_id not in self._psfs | self._builds:
            raise _no_such_psf(request.psf_id)
        return ResolvedDeconvolve(**psf, **request.model_dump(exclude={"psf_id", "context"}))

    def _summary(self, request: Deconvolve | ResolvedDeconvolve) -> HeaderSummary:
        """The summary of the image that a request names."""
        image = self._images[request.image_id]
        return image.summary if request.hdu is None else read_summary(image.path, LIMITS, hdu=request.hdu)

    def _psf(self, identity: str, *, parts: bool) -> Psf:
        """The PSF of a file or an instrument; it is read once, because the prepared PSFs belong to this object."""
        key = identity, parts
        if key in self._read_psfs:
            return self._read_psfs[key]
        if identity in self._builds:
            recipe = recipe_of(self._builds[identity])
            psf = kept_psf(psf_cache(), recipe, LIMITS, parts=False, threads=cores())
        else:
            if identity not in self._psfs:
                raise _no_such_psf(identity)
            named = self._psfs[identity]
            named.files.check()
            psf = read_psf(named.path, LIMITS, parts=parts)
        return self._read_psfs.setdefault(key, psf)

    def _deconvolve(self, request: ResolvedDeconvolve, _job_id: str, report: _Report) -> str:
        image, named = self._images[request.image_id], self._psfs.get(request.psf_id)
        report("reading", 0, request.method.steps)
        image.files.check()
        summary = self._summary(request)

        def begin(stage: str, steps: int) -> Callable[[int, int], None]:
            if stage == run.DECONVOLVING:
                self.times.begin(stage)
            elif stage != BUILDING:
                report(stage, 0, steps)
            return lambda step, steps: report(stage, step, steps)

        def build(_header: Header, progress: Callable[[int, int], None] | None) -> Psf:
            assert request.psf_recipe is not None  # otherwise the request names a PSF
            recipe = recipe_of(request.psf_recipe)
            return kept_psf(psf_cache(), recipe, LIMITS, parts=False, threads=cores(), progress=progress)

        def possible_psfs(psf: Psf, header: Header) -> list[Psf]:
            from psfcore.scatter.total_psf import possible_on_pixels  # most deconvolutions compute no errors

            return possible_on_pixels(psf, header, threads=cores())

        product, psf = run.read_and_deconvolve(
            lambda: read_observation(
                image.path, LIMITS, saturation_dn=request.saturation_dn, hdu=request.hdu
            ),
            summary.shape,
            None if request.psf_recipe else self._psf(request.psf_id, parts=request.error_draws > 0),
            options_of(request, cores()),
            build=build,
            possible_psfs=possible_psfs,
            prepared=self._prepared,
            free_bytes=free_bytes(),
            plate_scale_arcsec=request.plate_scale_arcsec,
            other_channel=request.other_channel,
            again=request.again,
            seen_as=(lambda psf: psf) if named is None else named.seen_as,
            begin=begin,
        )
        report("saving", 0, 1)
        image.files.check()
        used = (
            UsedPsf(request.psf_id, psf.name, psf.version, PsfStatus.DRAFT) if named is None else named.name
        )
        identity = product_identity(request)
        name = optional_text(product.image.header, "FILENAME") or "heliopsf"
        ids = Identities(
            identity, request.image_id, request.method.algorithm_version, safe_name(name, identity)
        )
        details = product.details(used) | {"software_version": software_version()}
        result = {"psf_id": used.id, "psf_version": used.version, "details": details}
        return self._add(
            f"/v1/products/{identity}",
            result,
            file=lambda path: run.write(product, path, used, ids),
            preview=lambda path: run.draw_preview(product, used, path),
            changes=lambda path: run.draw_changes(product, used, path),
        )

    def _psf_build(self, request: PsfBuild, _job_id: str, report: _Report) -> str:
        from psfcore.fits.images import read_plane

        mask = None if request.mask_id is None else read_plane(self._images[request.mask_id].path, LIMITS)
        recipe, copy = recipe_of(request), self.folder / "psf.fits"
        progress = partial(report, BUILDING)
        with built_file(psf_cache(), recipe, mount_image=mask, threads=cores(), progress=progress) as (
            file,
            _,
        ):
            shutil.copyfile(file, copy)
        psf = read_psf(copy, LIMITS)
        return self._add_psf(
            psf,
            recipe.identity,
            {"cumulative_curve_pct": light_beyond_pct(psf.kernel)},
            file=partial(shutil.copyfile, copy),
            preview=lambda path: module_of_extra("psfcore.drawing.plots").psf_png(psf, path),
        )

    def _psf_fit(self, request: ResolvedPsfFit, job_id: str, report: _Report) -> str:
        from psfcore.fits.psfs import write_psf
        from workers.tasks import psf_fit
        from workers.tasks.results import Means, write_json

        fitted = psf_fit.fit(request, *self._transit(request, report), Means(job_id, cores(), report))
        return self._add_psf(
            fitted.psf,
            fitted.psf.provenance["psf_id"],
            {"fit": fitted.details},
            file=lambda path: write_psf(path, fitted.psf),
            preview=fitted.draw,
            report=lambda path: write_json(path, fitted.report),
        )

    def _cross_validate(self, request: ResolvedCrossValidate, job_id: str, report: _Report) -> str:
        from psfcore.scatter.inversion import invert
        from psfcore.scatter.shapes import shape_named
        from psfcore.scatter.validation.cross_validation import bootstrap_samples, exact_fit, shared_fits
        from workers.tasks import crossval

        transit, _ = self._transit(request, report)
        samples = bootstrap_samples(len(transit.frames), runs=request.runs, seed=request.seed)
        shape = shape_named(request.shape)
        solution = invert(transit, shape, start=None, threads=cores(), progress=report)
        if request.scheme == "shared":
            fits = shared_fits(solution, samples, progress=report)
        else:
            count = len(samples)
            report("folds", 0, count)
            found = []
            for done, sample in enumerate(samples):
                told = lambda stage, step, steps, done=done: report("folds", done, count)  # noqa: E731
                found.append(exact_fit(solution, sample, progress=told))
                report("folds", done + 1, count)
            fits = tuple(found)
        return self._add_report(crossval.report_of(request, transit, fits, job_id=job_id))

    def _report(self, request: ResolvedReport, job_id: str, report: _Report) -> str:
        from workers.tasks import report as task
        from workers.tasks.results import Means

        psf = None if request.psf_id is None else self._psf(request.psf_id, parts=True)
        transit = self._transit(request, report, None if psf is None else task.point())
        return self._add_report(task.make(request, *transit, psf, Means(job_id, cores(), report)))

    def _gap_diagnose(self, request: ResolvedGapDiagnose, job_id: str, report: _Report) -> str:
        from psfcore.fits.psfs import write_psf
        from psfcore.gap.library.registry import added_effects
        from workers.tasks.gap import diagnosis_of
        from workers.tasks.results import Means

        added = added_effects(request.added_effects)
        parent = None if request.psf_id is None else self._psf(request.psf_id, parts=True)
        transit, _ = self._transit(request, report)
        means = Means(job_id, cores(), report)
        found, corrected = diagnosis_of(request, transit, parent, added, means)
        if corrected is not None:
            address = f"/v1/psfs/{corrected.provenance['psf_id']}"
            self._add(address, {}, file=lambda path: write_psf(path, corrected))
        return self._add_report(found)

    def _transit(
        self, request: ResolvedOnTransit, report: _Report, diffraction: Kernel | None = None
    ) -> tuple[Transit, Prepared]:
        """Read the transit of a request. diffraction: as for ``workers.tasks.transits.load_transit``."""
        from psfcore.transit.folder import read_prepared

        transit = self._transits[request.transit_id]
        report("reading", 0, len(transit.contents.manifest.images))

        def known(_instrument: str | None, _shape: tuple[int, int]) -> Kernel:
            if diffraction is not None:
                return diffraction
            assert request.diffraction_recipe is not None  # otherwise the transit contains the PSF
            recipe, progress = recipe_of(request.diffraction_recipe), partial(report, BUILDING)
            with built_file(psf_cache(), recipe, threads=cores(), progress=progress) as (file, _):
                return read_psf(file, LIMITS, parts=False).kernel

        with transit.folder() as folder:
            return read_prepared(
                folder,
                LIMITS,
                progress=partial(report, "reading"),
                diffraction=known,
                noise=None if request.noise is None else request.noise.noise(),
                saturation_dn=request.saturation_dn,
            )

    def _add_psf(
        self, psf: Psf, identity: str, details: dict[str, Any], **files: Callable[[Path], object]
    ) -> str:
        described = {"name": psf.name, "version": psf.version, "status": PsfStatus.DRAFT, "details": details}
        return self._add(f"/v1/psfs/{identity}", described, **files)

    def _add_report(self, report: Any) -> str:
        """Add a finished report (`workers.tasks.results.Finished`)."""
        from workers.tasks.results import write_json

        return self._add(
            f"/v1/reports/{uuid.uuid4().hex}",
            {"details": report.details},
            file=lambda path: write_json(path, report.content),
            preview=report.draw,
            html=lambda path: path.write_text(report.page(), "utf-8"),
        )

    def _add(self, address: str, described: dict[str, Any], **files: Callable[[Path], object]) -> str:
        """Add a result and the functions that write its files; returns its address."""
        addresses = {name: f"{address}/{name}" for name in files}
        self._results[address] = {"id": address.rpartition("/")[2], **described, **addresses}
        self._writers |= {addresses[name]: write for name, write in files.items()}
        return address


def _no_such_psf(identity: str) -> DataError:
    from workers.rows import no_such

    return no_such("psf", identity)


@contextmanager
def local(*, gap_effects: str = "") -> Iterator[Local]:
    """The operations of a command with ``--local``. gap_effects: as in the setting HELIOPSF_GAP_EFFECTS."""
    with TemporaryDirectory(prefix="heliopsf-") as folder:
        yield Local(Path(folder), gap_effects)
