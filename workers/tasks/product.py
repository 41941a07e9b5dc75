"""The task ``deconvolve``: an uploaded image and a PSF in, an image product out."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.deconvolve.assess.changes import Effects, effects
from psfcore.deconvolve.assess.error_planes import ErrorPlanes, error_planes, psf_error_plane, with_psf_error
from psfcore.deconvolve.assess.plots import effects_png
from psfcore.deconvolve.assess.quality import QualityBit, quality_plane
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named
from psfcore.deconvolve.result import Deconvolved
from psfcore.drawing import plots
from psfcore.errors import DataError
from psfcore.fits.fits_io import read_image, read_psf, write_image
from psfcore.fits.gain import noise_for, saturation_for
from psfcore.image import Image, MaskBit
from psfcore.instruments.model import load_instrument
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.psf_sampling import psf_for_image
from psfcore.scatter.samples import possible_psfs
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow
from workers.contract.contract import ResolvedDeconvolve, product_identity
from workers.settings import library_versions, software_version
from workers.tasks.context import Context
from workers.tasks.prepared_psfs import PreparedPsfs
from workers.tasks.psf_build import psf_of

# What a method itself takes, beside what stands in its conditions.
_CONDITIONS = {"name", "edges", "margin_px"}


def deconvolve(context: Context, parameters: Mapping[str, Any]) -> str:
    """Deconvolve an uploaded image and add the product to the catalogue; returns its id."""
    request = ResolvedDeconvolve.model_validate(parameters)
    identity = product_identity(request)
    if context.catalogue.get(ProductRow, identity, context.owner) is not None:
        return identity
    psf_row = psf_of(context, request)
    image = _load(context, request)
    made = make(context, request, psf_row, image)
    with context.store.temporary() as path:
        write(made, path)
        context.report("saving", 1, 1)
        keep(made, path)
    return identity


def _load(context: Context, request: ResolvedDeconvolve) -> Image:
    upload = context.catalogue.get(ImageRow, request.image_id, context.owner)
    if upload is None:
        raise DataError("no-such-image", f"no image was uploaded with id {request.image_id}")
    return load(context, request, context.store.path(request.image_id), upload.summary)


def load(context: Context, request: ResolvedDeconvolve, path: Path, summary: Mapping[str, Any]) -> Image:
    """The image in a file whose header says what ``summary`` does."""
    context.report("reading", 0, request.method.steps)
    level = request.saturation_dn or _known_saturation_dn(summary)
    return read_image(path, context.limits, saturation_dn=level)


def _known_saturation_dn(summary: Mapping[str, Any]) -> float | None:
    """The level of the instrument's gain mode, by what the upload's header said; None where it is not known."""
    if summary["instrument"] is None or summary["gain_mode"] is None:
        return None
    return saturation_for(load_instrument(summary["instrument"]), Header({"GAINCOMB": summary["gain_mode"]}))


@lru_cache(maxsize=1)
def _prepared(max_bytes: int) -> PreparedPsfs:
    """Those of this process; its jobs run one after the other, and often with the same PSF."""
    return PreparedPsfs(max_bytes)


@dataclass(frozen=True)
class _Work:
    """One deconvolution: what goes in, and how it is run, once or over and over for its errors."""

    context: Context
    request: ResolvedDeconvolve
    psf_row: PsfRow
    image: Image

    @cached_property
    def psf(self) -> Psf:
        """The PSF on the image's pixels."""
        path = self.context.store.path(self.psf_row.file_sha256)
        return self.prepared.on_pixels_of(self.image.header, path, self.context.limits)

    @property
    def prepared(self) -> PreparedPsfs:
        """PSFs that were prepared before."""
        return _prepared(self.context.settings.psf_cache_mib * 2**20)

    @cached_property
    def noise(self) -> Noise | None:
        """The noise figures asked for, or those of the instrument that made the image."""
        if self.request.noise is not None:
            return Noise(**self.request.noise.model_dump())
        recipe = self.request.psf_recipe
        instrument = self.request.picked_for if recipe is None else recipe.instrument
        return None if instrument is None else noise_for(load_instrument(instrument), self.image.header)

    @cached_property
    def possible_psfs(self) -> list[Psf]:
        """What the PSF might be instead, on the image's pixels; none where its file does not say how well it is known."""
        psf = read_psf(self.context.store.path(self.psf_row.file_sha256), self.context.limits)
        if psf.fitted is None:
            return []
        possible = possible_psfs(psf, threads=self.context.settings.threads)
        return [psf_for_image(one, self.image.header) for one in possible]

    def run(self, image: Image, stage: str | None = None, psf: Psf | None = None) -> Deconvolved:
        """The method on an image of this shape; ``stage`` names its progress, none is silent."""
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
        """Progress of a stage, for what counts its own steps."""
        return lambda step, steps: self.context.report(stage, step, steps)

    def errors(self, result: Deconvolved) -> ErrorPlanes | None:
        """The planes of errors, where they were asked for."""
        if not self.request.error_draws:
            return None
        if self.noise is None:
            raise DataError(
                "no-noise-figures",
                "expected noise (photon_gain_dn and read_noise_dn) to draw errors from; got none, and the "
                "instrument's are not known",
            )
        self.context.times.begin("drawing errors")
        planes = error_planes(
            self.image,
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
            lambda psf: self.run(self.image, psf=psf).pixels,
            chance=False,
            progress=self.progress("errors of the PSF"),
        )
        return with_psf_error(planes, from_psf)


@dataclass(frozen=True)
class Made:
    """A deconvolution that is done, and what it did; not yet written."""

    work: _Work
    result: Deconvolved
    errors: ErrorPlanes | None
    found: Effects
    quality: NDArray[np.uint8]
    details: dict[str, Any]
    preview_sha256: str | None

    @property
    def identity(self) -> str:
        """Of the product."""
        return product_identity(self.work.request)


def make(
    context: Context, request: ResolvedDeconvolve, psf_row: PsfRow, image: Image, *, preview: bool = True
) -> Made:
    """Deconvolve an image that was read, and look at what that did."""
    work = _Work(context, request, psf_row, image)
    context.times.begin("deconvolving")
    result = work.run(image, "deconvolving")
    errors = work.errors(result)
    context.report("saving", 0, 1)
    edge_px = min(result.edge_band_px, min(result.pixels.shape) // 4)
    draw = partial(_preview, work, result)
    with ThreadPoolExecutor(1) as beside:
        # A worker of one thread draws in turn: another thread would take the time of the worker next to it.
        picture = beside.submit(draw).result if preview and context.settings.threads > 1 else draw
        found = effects(image, result.pixels, work.psf, noise=work.noise, edge_px=edge_px)
        quality = quality_plane(
            image,
            result.pixels,
            edge_px=edge_px,
            suspected=found.artefacts.suspected,
            error=None if errors is None else errors.error,
        )
        details = _details(work, result, errors, found)
        preview_sha256 = picture() if preview else None
    return Made(work, result, errors, found, quality, details, preview_sha256)


def write(made: Made, path: Path) -> None:
    """Write a product's file."""
    work, result, errors = made.work, made.result, made.errors
    planes: dict[str, NDArray[Any]] = {"QUALITY": made.quality}
    if errors is not None:
        planes["ERROR"] = errors.error
        if errors.psf_error is not None:
            planes["PSF_ERROR"] = errors.psf_error
    write_image(
        path,
        dataclasses.replace(work.image, pixels=result.pixels),
        cards=_cards(work, made.identity, result, errors),
        history=_history(work, result),
        mask=work.image.mask,
        planes=planes,
        plane_bits={"QUALITY": QualityBit},
    )


def keep(made: Made, path: Path) -> ProductRow:
    """Move a product's file, written already, into the store, and add it to the catalogue."""
    work, context = made.work, made.work.context
    size_bytes = path.stat().st_size
    file_sha256 = context.store.keep(path)
    picture = _effects_picture(work, made.result, made.found) if work.request.effects_picture else None
    assert made.preview_sha256 is not None
    row = ProductRow(
        owner=context.owner,
        id=made.identity,
        created_at=time.time(),
        kind="deconvolved-image",
        image_id=work.request.image_id,
        psf_id=work.psf_row.id,
        psf_version=work.psf_row.version,
        file_sha256=file_sha256,
        bytes=size_bytes,
        preview_sha256=made.preview_sha256,
        details=made.details | {"effects_picture_sha256": picture},
    )
    return context.catalogue.add(row)[0]


def _preview(work: _Work, result: Deconvolved) -> str:
    with work.context.store.temporary() as picture:
        plots.preview_png(work.image.pixels, result.pixels, picture, title=_title(work))
        return work.context.store.keep(picture)


def _effects_picture(work: _Work, result: Deconvolved, found: Effects) -> str:
    with work.context.store.temporary() as picture:
        effects_png(work.image.pixels, result.pixels, found, picture, title=_title(work))
        return work.context.store.keep(picture)


def _cards(
    work: _Work, identity: str, result: Deconvolved, errors: ErrorPlanes | None
) -> dict[str, tuple[Any, str]]:
    # A hash fills its card: there is no room for a comment beside it.
    cards: dict[str, tuple[Any, str]] = {
        "PRODID": (identity, ""),
        "PSFID": (work.psf_row.id, ""),
        "PSFVERS": (work.psf_row.version, "PSF version"),
        "PSFNAME": (work.psf_row.name, "PSF name"),
        "PSFSTAT": (work.psf_row.status, "PSF status"),
        "DCNVMETH": (work.request.method.name, "deconvolution method"),
        "DCNVITER": (result.steps_done, "deconvolution steps done"),
        "DCNVSTOP": (result.stopped_because, "why it stopped"),
        "DCNVEDGE": (result.edges, "what was taken beyond the edges"),
        "DCNVBAND": (result.edge_band_px, "[px] edge band that leans on it"),
        "DCNVALGV": (work.request.method.algorithm_version, "algorithm version"),
        "SWHELIO": (software_version(), "heliopsf version"),
        "INPSHA": (work.request.image_id, ""),
    }
    if errors is not None and errors.amplification is not None:
        cards["DCNVAMPL"] = (errors.amplification, "noise of the result over that of the input")
    return cards


def _history(work: _Work, result: Deconvolved) -> list[str]:
    psf = work.psf_row
    return [
        f"heliopsf {software_version()}: {work.request.method.name}, {result.steps_done} steps, "
        f"edges {result.edges}, PSF {psf.name} {psf.version} ({psf.status})"
    ]


def _title(work: _Work) -> str:
    header = work.image.header
    parts = [header.get("DETECTOR") or header.get("INSTRUME") or "image"]
    parts += [str(header[key]) for key in ("DATE-BEG", "DATE-OBS") if header.get(key)][:1]
    return f"{' '.join(map(str, parts))}   PSF {work.psf_row.name} {work.psf_row.version}"


def _details(work: _Work, result: Deconvolved, errors: ErrorPlanes | None, found: Effects) -> dict[str, Any]:
    """What the catalogue keeps: how it was made, and what changed.

    Bright and dark are the pixels at and above the 99th percentile of the input, and at and below the first.
    """
    image = work.image
    before, after = image.pixels[image.valid], result.pixels[image.valid]
    low, high = np.percentile(before, [1, 99])
    dark, bright = before <= low, before >= high
    details = {
        "method": work.request.method.model_dump(mode="json"),
        "algorithm_version": work.request.method.algorithm_version,
        "software_version": software_version(),
        "libraries": library_versions(),
        "parameters": work.request.model_dump(mode="json", exclude_none=True),
        "job_id": work.context.job_id,
        "steps_done": result.steps_done,
        "stopped_because": result.stopped_because,
        "last_step_change": result.last_change,
        "edges": result.edges,
        "edge_band_px": result.edge_band_px,
        "noise_amplification": result.noise_amplification if errors is None else errors.amplification,
        "chi2_per_pixel": result.chi2_per_pixel,
        "flux_change_pct": 100 * (result.flux_out / result.flux_in - 1),
        "bright_change_pct": _change_pct(before[bright], after[bright]),
        "dark_change_pct": _change_pct(before[dark], after[dark]),
        "negative_pixels": result.negative_pixels,
        "masked_pixels": {
            str(bit.name).lower(): int(np.count_nonzero(image.mask & bit.value)) for bit in MaskBit
        },
        "effects": found.as_json(),
    }
    return details


def _change_pct(before: NDArray[np.float64], after: NDArray[np.float64]) -> float | None:
    """Change of the summed intensity; None where the input's own sum is not positive."""
    total = float(before.sum())
    return 100 * (float(after.sum()) / total - 1) if total > 0 else None
