"""The workspace of a command with ``--local``: the user's files where they are, the user's cache of built PSFs, and
results whose files are written when the command asks for them.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from psfcore.deconvolve.conditions import PreparedPsfs
from psfcore.deconvolve.run import BUILDING, PsfSource, UsedPsf
from psfcore.fits.blocks import LIMITS, FitsLimits
from psfcore.fits.channel import PsfOrigin
from psfcore.fits.header import HeaderSummary, read_summary
from psfcore.fits.psfs import read_psf
from psfcore.instruments.unknown import channel_of
from psfcore.psf import Psf
from psfcore.psf_cache import built_file, kept_psf
from workers.contract.documents import header_json
from workers.contract.identities import instrument_of_build, recipe_of
from workers.contract.kinds import ResultType
from workers.contract.requests import Deconvolve, PsfBuild, ResolvedDeconvolve
from workers.lookup import no_such
from workers.machine import cores, psf_cache
from workers.settings import Settings
from workers.stage_timer import StageTimer
from workers.tasks.deconvolve import possible_psfs
from workers.tasks.workspace import Progress, Result, Workspace
from workers.versions import PsfStatus, instrument_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from psfcore.recipe import Recipe
    from psfcore.transit.archive import ArchiveContents


States = dict[Path, tuple[int, int]]  # time of the last change (ns) and size (bytes) of the user's files


def states_of(*files: Path) -> States:
    """The present states of files."""
    return {file: _state(file) for file in files}


def check_unchanged(states: States) -> None:
    """Raise OSError if one of the files has changed since its state was recorded."""
    for file, state in states.items():
        if _state(file) != state:
            raise OSError(f"{file} changed while it was read; run the command again")


def _state(file: Path) -> tuple[int, int]:
    return (found := file.stat()).st_mtime_ns, found.st_size


@dataclass(frozen=True)
class ImageFile:
    """An image in a file."""

    path: Path
    states: States
    sha256: str
    summary: HeaderSummary


@dataclass(frozen=True)
class PsfFile(ImageFile):
    """A PSF in a file, with the name and the version by which products name the PSF."""

    name: str
    version: str

    def seen_as(self, psf: Psf) -> Psf:
        """The PSF with the name, the instrument and the wavelength that an upload would get from the header."""
        instrument = psf.instrument or instrument_of(header_json(asdict(self.summary)))
        channel = channel_of(instrument, self.summary.wavelnth) or ""
        angstrom = psf.wavelength_angstrom
        if angstrom is None and channel.isdecimal():
            angstrom = float(channel)
        return replace(psf, name=self.name, instrument=instrument, wavelength_angstrom=angstrom)


@dataclass(frozen=True)
class TransitFiles:
    """A transit in a folder or in an archive."""

    path: Path
    states: States
    sha256: str
    contents: ArchiveContents

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """A folder with its files: the user's own, or a temporary one with the files of the archive."""
        check_unchanged(self.states)
        if self.path.is_dir():
            yield self.path
            check_unchanged(self.states)
            return
        from psfcore.transit.archive import unpack

        with TemporaryDirectory(prefix="heliopsf-") as folder:
            unpack(self.path, folder, Settings.apart(Path(folder)).archive_limits)
            yield Path(folder)


@dataclass
class Inputs:
    """What the user added to a command, and what was made of it, by the ids that a service would give.

    Attributes
    ----------
    builds
        PSFs that are built when they are needed.
    psfs_read
        PSFs that were read, by their id and whether they have their components; a PSF is read once.
    results
        The results that were made, by type and id.
    """

    images: dict[str, ImageFile] = field(default_factory=dict)
    psfs: dict[str, PsfFile] = field(default_factory=dict)
    builds: dict[str, PsfBuild] = field(default_factory=dict)
    transits: dict[str, TransitFiles] = field(default_factory=dict)
    psfs_read: dict[tuple[str, bool], Psf] = field(default_factory=dict)
    prepared: PreparedPsfs = field(default_factory=PreparedPsfs)
    results: dict[tuple[ResultType, str], Result] = field(default_factory=dict)


@dataclass(frozen=True)
class LocalWorkspace(Workspace):
    """The workspace of one job of a command."""

    inputs: Inputs
    settings: Settings
    job_id: str
    report: Progress
    times: StageTimer
    anew: bool = False

    @property
    def threads(self) -> int:
        return cores()

    @property
    def limits(self) -> FitsLimits:
        return LIMITS

    def has(self, result: ResultType, identity: str) -> bool:
        return (result, identity) in self.inputs.results

    def add(self, result: Result) -> None:
        image = self.inputs.images.get(result.columns.get("image_id", ""))
        if image is not None:
            check_unchanged(image.states)
        self.inputs.results[result.type, result.id] = result

    def image_file(self, identity: str) -> Path:
        image = self.inputs.images[identity]
        check_unchanged(image.states)
        return image.path

    def summary(self, request: Deconvolve | ResolvedDeconvolve) -> HeaderSummary:
        """The summary of the image that a request names."""
        image = self.inputs.images[request.image_id]
        return image.summary if request.hdu is None else read_summary(image.path, LIMITS, hdu=request.hdu)

    def shape_to_check(self, request: ResolvedDeconvolve) -> tuple[int, int]:
        return self.summary(request).shape

    def psf_source(self, request: ResolvedDeconvolve) -> PsfSource:
        source = partial(
            PsfSource,
            possible_psfs=partial(possible_psfs, threads=self.threads),
            plate_scale_arcsec=request.plate_scale_arcsec,
            prepared=self.inputs.prepared,
            other_channel=request.other_channel,
        )
        named_build = self.inputs.builds.get(request.psf_id)
        build = request.psf_recipe or named_build
        if build is not None:
            recipe = recipe_of(build)
            source = partial(source, lambda _, progress: self._kept(recipe, progress, parts=False))
            if named_build is None:  # of the telescope in the header
                return source()
            return source(key=request.psf_id, built=PsfOrigin.of_instrument(instrument_of_build(named_build)))
        parts, named = request.error_draws > 0, self.inputs.psfs.get(request.psf_id)
        psf = self.psf(request.psf_id, parts=parts)
        source = partial(
            source,
            lambda *_: psf,
            key=(request.psf_id, parts),
            kernel_shape=psf.kernel.shape,
            field_terms=len(psf.field_terms),
        )
        if named is None:
            return source()
        return source(
            seen_as=named.seen_as, used=UsedPsf(request.psf_id, named.name, named.version, PsfStatus.DRAFT)
        )

    def psf(self, identity: str, *, parts: bool = True) -> Psf:
        key = identity, parts
        if key in self.inputs.psfs_read:
            return self.inputs.psfs_read[key]
        build, named = self.inputs.builds.get(identity), self.inputs.psfs.get(identity)
        if build is not None:
            psf = self._kept(recipe_of(build), parts=False)
        elif named is not None:
            check_unchanged(named.states)
            psf = read_psf(named.path, LIMITS, parts=parts)
        else:
            raise no_such("psf", identity)
        return self.inputs.psfs_read.setdefault(key, psf)

    def built_psf(self, build: PsfBuild) -> Psf:
        return self._kept(recipe_of(build), partial(self.report, BUILDING))

    def build(
        self, recipe: Recipe, mount_image: NDArray[np.floating] | None, progress: Callable[[int, int], None]
    ) -> tuple[Psf, Callable[[Path], object]]:
        copy = self.settings.data_dir / f"{recipe.identity}.fits"
        with built_file(
            psf_cache(), recipe, mount_image=mount_image, threads=self.threads, progress=progress
        ) as (file, _):
            shutil.copyfile(file, copy)
        return read_psf(copy, LIMITS), partial(shutil.copyfile, copy)

    def _kept(
        self, recipe: Recipe, progress: Callable[[int, int], None] | None = None, *, parts: bool = True
    ) -> Psf:
        return kept_psf(psf_cache(), recipe, LIMITS, threads=self.threads, progress=progress, parts=parts)

    @contextmanager
    def unpacked(self, transit_id: str) -> Iterator[Path]:
        transit = self.inputs.transits[transit_id]
        self.report("reading", 0, len(transit.contents.manifest.images))
        with transit.folder() as folder:
            yield folder
