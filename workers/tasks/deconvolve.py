"""The task ``deconvolve``: deconvolves an uploaded image with a PSF; the result is a product."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

from psfcore.deconvolve.box import Box
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.region import BoxWork, box_work
from psfcore.deconvolve.whole import Work, input_warnings
from psfcore.fits.gain import no_noise_figures
from psfcore.fits.observation import check_exposure_of_sun, read_observation
from psfcore.fits.psfs import read_psf
from psfcore.image import Image
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.psf_sampling import psf_for_image
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow
from workers.contract.identities import product_identity
from workers.contract.requests import ResolvedDeconvolve
from workers.intake.compatibility import noise_of, of_upload
from workers.intake.deprecated import CODE, deprecated_warning
from workers.rows import row_of
from workers.tasks.context import Context
from workers.tasks.data.prepared_psfs import PreparedPsfs
from workers.tasks.data.product import Inputs, Made, Warned, details_of, keep, save_preview, write
from workers.tasks.psf_build import requested_psf

# Fields of a request's method that go into Conditions; all other fields are arguments of the method itself.
_CONDITIONS = {"name", "edges", "margin_px"}


def deconvolve(context: Context, parameters: Mapping[str, Any]) -> str:
    """Deconvolve an uploaded image and add the product to the catalogue; returns the product's id.

    Raises DataError "no-such-image", "no-such-psf", "instrument-changed", "channel-mismatch", "no-noise-figures",
    "already-deconvolved", "psf-as-image", and the errors of reading the image and of the method.
    """
    request = ResolvedDeconvolve.model_validate(parameters)
    identity = product_identity(request)
    if context.made(ProductRow, identity) is not None:
        return identity
    psf_row = requested_psf(context, request)
    image = _load_upload(context, request)
    made = make(context, request, psf_row, image, preview=context.previews)
    with context.store.temporary() as path:
        write(made, path)
        context.report("saving", 1, 1)
        keep(made, path)
    return identity


def _load_upload(context: Context, request: ResolvedDeconvolve) -> Image:
    row_of(context.catalogue, ImageRow, request.image_id, context.owner)
    return load(context, request, context.store.verified(request.image_id))


def load(context: Context, request: ResolvedDeconvolve, path: Path) -> Image:
    """Read an image file and mask its saturated pixels."""
    context.report("reading", 0, request.method.steps)
    image = read_observation(path, context.limits, saturation_dn=request.saturation_dn, hdu=request.hdu)
    # A rerun repeats an earlier deconvolution, even if it was made by a version that did not check this.
    if not (request.again or context.anew):
        check_exposure_of_sun(image.header)
    return image


@lru_cache(maxsize=1)
def _prepared(max_bytes: int) -> PreparedPsfs:
    """The prepared PSFs of this process. The jobs of a process run one after the other and often use the same PSF."""
    return PreparedPsfs(max_bytes)


@dataclass(frozen=True)
class _Asked:
    """A request for a deconvolution, with its inputs."""

    inputs: Inputs

    @property
    def context(self) -> Context:
        return self.inputs.context

    @property
    def request(self) -> ResolvedDeconvolve:
        return self.inputs.request

    @cached_property
    def psf(self) -> Psf:
        """The PSF on the image's pixels."""
        digest = self.inputs.psf_row.file_sha256
        find = partial(self.context.store.verified, digest)
        return self.prepared.on_pixels_of(
            self.inputs.image.header,
            digest,
            find,
            self.context.limits,
            plate_scale_arcsec=self.request.plate_scale_arcsec,
        )

    @property
    def prepared(self) -> PreparedPsfs:
        """The PSFs that this process has prepared."""
        return _prepared(self.context.settings.psf_cache_mib * 2**20)

    def warnings(self) -> list[Warned]:
        """The warnings about the inputs. Raises DataError "channel-mismatch"."""
        psf, row = self.psf, self.inputs.psf_row
        # The request of an upload may give an instrument and a channel that the file does not contain.
        instrument, angstrom = of_upload(row, psf.instrument, psf.wavelength_angstrom)
        psf = replace(psf, instrument=instrument, wavelength_angstrom=angstrom)
        # A rerun repeats an earlier deconvolution, even if it was made by a version that did not compare channels.
        allowed = self.request.other_channel or self.context.anew
        warning = deprecated_warning(self.context.catalogue, row)
        found = {} if warning is None else {CODE: warning}
        found |= input_warnings(psf, self.inputs.image, self.request.method.name, other_channel=allowed)
        return [Warned(code, message) for code, message in found.items()]

    @cached_property
    def noise(self) -> Noise | None:
        """The noise figures of the request; if there are none, the noise figures of the instrument that took the image."""
        figures = noise_of(self.request, self.inputs.image.header)
        return None if figures is None else figures.noise()

    def possible_psfs(self) -> list[Psf]:
        """Variants of the PSF within its errors, on the image's pixels; empty if the file of the PSF contains no
        errors."""
        psf = read_psf(self.context.store.verified(self.inputs.psf_row.file_sha256), self.context.limits)
        if psf.fitted is None:
            return []
        from psfcore.scatter.total_psf import possible_psfs  # most deconvolutions compute no errors

        possible = possible_psfs(psf, threads=self.context.settings.threads)
        return [psf_for_image(one, self.inputs.image.header) for one in possible]

    @cached_property
    def work(self) -> Work:
        """The deconvolution, with the engines that this process has prepared."""
        method = self.request.method
        return Work(
            self.inputs.image,
            self.psf,
            method.name,
            Conditions(
                edges=method.edges,
                margin_px=method.margin_px,
                noise=self.noise,
                threads=self.context.settings.threads,
                engine_for=self.prepared.engine_for,
            ),
            method.model_dump(exclude=_CONDITIONS),
        )

    def begin(self, stage: str, steps: int) -> Callable[[int, int], None]:
        """Report that a stage begins; returns a progress function for code that counts its own steps."""
        self.context.report(stage, 0, steps)
        return self.progress(stage)

    def progress(self, stage: str) -> Callable[[int, int], None]:
        """A progress function for code that counts its own steps."""
        return lambda step, steps: self.context.report(stage, step, steps)


def make(
    context: Context, request: ResolvedDeconvolve, psf_row: PsfRow, image: Image, *, preview: bool = True
) -> Made:
    """Deconvolve an image and measure the changes. ``preview``: also draw the preview picture."""
    inputs = Inputs(context, request, psf_row, image)
    asked = _Asked(inputs)
    work: Work | BoxWork = asked.work
    warnings = asked.warnings()
    if request.error_draws and asked.work.conditions.noise is None:
        raise no_noise_figures()
    context.times.begin("deconvolving")
    if request.region is not None:
        work = box_work(asked.work, Box.parse(request.region), largest_error=request.region_error)
        inputs = replace(inputs, image=work.image)
    result = work.run(progress=asked.progress("deconvolving"))
    errors = work.errors(result, request.error_draws, possible_psfs=asked.possible_psfs, begin=asked.begin)
    context.report("saving", 0, 1)
    draw = partial(save_preview, inputs, result)
    with ThreadPoolExecutor(1) as beside:
        # A worker with one thread draws the picture in this thread: a second thread would slow down the other workers.
        picture = beside.submit(draw).result if preview and context.settings.threads > 1 else draw
        assessed = work.assess(result, errors)
        details = details_of(inputs, result, errors, assessed.found, warnings)
        preview_sha256 = picture() if preview else None
    return Made(inputs, result, errors, assessed.found, assessed.quality, warnings, details, preview_sha256)
