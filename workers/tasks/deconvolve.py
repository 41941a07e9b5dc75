"""The task ``deconvolve``: deconvolves an uploaded image with a PSF; the result is a product."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

from psfcore.deconvolve.assess.changes import measure_changes
from psfcore.deconvolve.assess.error_planes import ErrorPlanes, error_planes, psf_error_plane, with_psf_error
from psfcore.deconvolve.assess.quality import quality_plane
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named
from psfcore.deconvolve.result import Deconvolved
from psfcore.errors import DataError
from psfcore.fits.channel import check_channel
from psfcore.fits.gain import noise_for
from psfcore.fits.header import check_not_deconvolved, content_of
from psfcore.fits.observation import read_observation
from psfcore.fits.psfs import read_psf
from psfcore.image import Image
from psfcore.instruments.model import load_instrument
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.psf_sampling import psf_for_image
from psfcore.scatter.samples import possible_psfs
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow
from workers.contract.identities import product_identity
from workers.contract.resolved import ResolvedDeconvolve
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
    made = make(context, request, psf_row, image)
    with context.store.temporary() as path:
        write(made, path)
        context.report("saving", 1, 1)
        keep(made, path)
    return identity


def _load_upload(context: Context, request: ResolvedDeconvolve) -> Image:
    upload = context.catalogue.get(ImageRow, request.image_id, context.owner)
    if upload is None:
        raise DataError(
            "no-such-image",
            f"expected the id of an uploaded image; got {request.image_id}, which is not in the catalogue: upload the "
            "image first",
        )
    return load(context, request, context.store.verified(request.image_id))


def load(context: Context, request: ResolvedDeconvolve, path: Path) -> Image:
    """Read an image file and mask its saturated pixels."""
    context.report("reading", 0, request.method.steps)
    image = read_observation(path, context.limits, saturation_dn=request.saturation_dn)
    # A rerun repeats what was allowed once, also by versions that did not check this.
    if not (request.again or context.anew):
        check_not_deconvolved(content_of(image.header))
    return image


@lru_cache(maxsize=1)
def _prepared(max_bytes: int) -> PreparedPsfs:
    """The prepared PSFs of this process. The jobs of a process run one after the other and often use the same PSF."""
    return PreparedPsfs(max_bytes)


@dataclass(frozen=True)
class _Work:
    """One deconvolution with its inputs. It runs once for the image, and again for each noise realisation and each possible PSF."""

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
        return self.prepared.on_pixels_of(self.inputs.image.header, digest, find, self.context.limits)

    @property
    def prepared(self) -> PreparedPsfs:
        """The PSFs that this process has prepared."""
        return _prepared(self.context.settings.psf_cache_mib * 2**20)

    def warnings(self) -> list[Warned]:
        """What the user must know about the inputs. Raises DataError "channel-mismatch"."""
        psf, row = self.psf, self.inputs.psf_row
        # The request of an upload may give an instrument and a channel that the file does not.
        if psf.instrument is None:
            psf = replace(psf, instrument=row.instrument)
        if psf.wavelength_angstrom is None and row.channel is not None and row.channel.isdecimal():
            psf = replace(psf, wavelength_angstrom=float(row.channel))
        # A rerun repeats what was allowed once, also by versions that did not compare channels.
        allowed = self.request.other_channel or self.context.anew
        found = {"channel": check_channel(psf, self.inputs.image.header, other_channel=allowed)}
        if self.inputs.image.saturation is not None:
            found["saturation"] = self.inputs.image.saturation.warning
        return [Warned(code, message) for code, message in found.items() if message is not None]

    @cached_property
    def noise(self) -> Noise | None:
        """The noise figures of the request; if there are none, the noise figures of the instrument that took the image."""
        if self.request.noise is not None:
            return self.request.noise.noise()
        recipe = self.request.psf_recipe
        instrument = self.request.picked_for if recipe is None else recipe.instrument
        return (
            None if instrument is None else noise_for(load_instrument(instrument), self.inputs.image.header)
        )

    @cached_property
    def possible_psfs(self) -> list[Psf]:
        """PSFs that differ from the PSF by its errors, on the image's pixels; empty if the file of the PSF contains no errors."""
        psf = read_psf(self.context.store.verified(self.inputs.psf_row.file_sha256), self.context.limits)
        if psf.fitted is None:
            return []
        possible = possible_psfs(psf, threads=self.context.settings.threads)
        return [psf_for_image(one, self.inputs.image.header) for one in possible]

    def run(self, image: Image, stage: str | None = None, psf: Psf | None = None) -> Deconvolved:
        """Run the method on an image of this shape. Progress is reported under ``stage``; None: no progress."""
        method = self.request.method
        conditions = Conditions(
            edges=method.edges,
            margin_px=method.margin_px,
            noise=self.noise,
            threads=self.context.settings.threads,
            progress=None if stage is None else self.progress(stage),
            engine_for=self.prepared.engine_for,
        )
        return method_named(method.name)(
            image, psf or self.psf, conditions, **method.model_dump(exclude=_CONDITIONS)
        )

    def progress(self, stage: str) -> Callable[[int, int], None]:
        """A progress function for code that counts its own steps."""
        return lambda step, steps: self.context.report(stage, step, steps)

    def errors(self, result: Deconvolved) -> ErrorPlanes | None:
        """The error planes, or None if the request does not ask for them. Raises DataError "no-noise-figures"."""
        if not self.request.error_draws:
            return None
        if self.noise is None:
            raise DataError(
                "no-noise-figures",
                "expected noise (photon_gain_dn and read_noise_dn) to simulate noise realisations; got none, and the "
                "instrument's figures are unknown: give them in the request, or set error_draws to 0",
            )
        self.context.times.begin("drawing errors")
        planes = error_planes(
            self.inputs.image,
            self.psf,
            lambda image: self.run(image).pixels,
            self.noise,
            estimate=result.pixels,
            draws=self.request.error_draws,
            edge_px=result.edge_band_px,
            threads=self.context.settings.threads,
            progress=self.progress("drawing errors"),
        )
        if not self.possible_psfs:
            return planes
        self.context.times.begin("errors of the PSF")
        from_psf = psf_error_plane(
            self.possible_psfs,
            lambda psf: self.run(self.inputs.image, psf=psf).pixels,
            chance=False,
            progress=self.progress("errors of the PSF"),
        )
        return with_psf_error(planes, from_psf)


def make(
    context: Context, request: ResolvedDeconvolve, psf_row: PsfRow, image: Image, *, preview: bool = True
) -> Made:
    """Deconvolve an image and measure what changed in it. ``preview``: also draw the preview picture."""
    inputs = Inputs(context, request, psf_row, image)
    work = _Work(inputs)
    warnings = work.warnings()
    context.times.begin("deconvolving")
    result = work.run(image, "deconvolving")
    errors = work.errors(result)
    context.report("saving", 0, 1)
    edge_px = min(result.edge_band_px, min(result.pixels.shape) // 4)
    draw = partial(save_preview, inputs, result)
    with ThreadPoolExecutor(1) as beside:
        # A worker with one thread draws the picture in this thread: a second thread would slow down the other workers.
        picture = beside.submit(draw).result if preview and context.settings.threads > 1 else draw
        found = measure_changes(image, result.pixels, work.psf, noise=work.noise, edge_px=edge_px)
        quality = quality_plane(
            image,
            result.pixels,
            edge_px=edge_px,
            suspected=found.artefacts.suspected,
            error=None if errors is None else errors.error,
        )
        details = details_of(inputs, result, errors, found, warnings)
        preview_sha256 = picture() if preview else None
    return Made(inputs, result, errors, found, quality, warnings, details, preview_sha256)
