"""The tasks, one a job kind: load, compute, save. They raise; ``workers.runner`` decides what that means."""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore import plots
from psfcore.build import build_psf
from psfcore.deconvolve.result import Deconvolved
from psfcore.deconvolve.richardson_lucy import richardson_lucy
from psfcore.errors import DataError
from psfcore.fits_io import read_image, read_psf, write_image, write_psf
from psfcore.header import FitsLimits
from psfcore.image import Image, MaskBit
from psfcore.instruments.model import Instrument, parse_instrument
from psfcore.psf import Psf, cumulative_curve
from workers.catalogue import Catalogue, ImageRow, ProductRow, PsfRow
from workers.contract import (
    PsfBuild,
    ResolvedDeconvolve,
    instrument_text,
    product_identity,
    psf_identity,
)
from workers.settings import Settings, software_version
from workers.store import Store

CURVE_RADII_PX = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


@dataclass(frozen=True)
class Context:
    """What a task may use: where things are, and how to say how far it is."""

    catalogue: Catalogue
    store: Store
    settings: Settings
    owner: str
    job_id: str
    report: Callable[[str, int, int], None]

    @property
    def limits(self) -> FitsLimits:
        """Limits of the files that are opened."""
        return FitsLimits(max_pixels=self.settings.max_pixels)


Task = Callable[[Context, Mapping[str, Any]], str]


def psf_build(context: Context, parameters: Mapping[str, Any]) -> str:
    """Build a PSF from an instrument file and add it to the catalogue; returns its id."""
    return _built_psf(context, PsfBuild.model_validate(parameters)).id


def deconvolve(context: Context, parameters: Mapping[str, Any]) -> str:
    """Deconvolve an uploaded image and add the product to the catalogue; returns its id."""
    request = ResolvedDeconvolve.model_validate(parameters)
    identity = product_identity(request.image_id, request.psf_id, request.method)
    if context.catalogue.get(ProductRow, identity, context.owner) is not None:
        return identity
    psf_row = _psf_of(context, request)
    upload = context.catalogue.get(ImageRow, request.image_id, context.owner)
    if upload is None:
        raise DataError("no-such-image", f"no image was uploaded with id {request.image_id}")
    context.report("reading", 0, request.method.steps)
    image = read_image(context.store.path(request.image_id), context.limits)
    psf = _read_psf_cached(context.store.path(psf_row.file_sha256), context.limits)
    result = richardson_lucy(
        image,
        psf,
        steps=request.method.steps,
        threads=context.settings.threads,
        progress=lambda step, steps: context.report("deconvolving", step, steps),
    )
    _save_product(context, identity, request, psf_row, image, result)
    return identity


TASKS: dict[str, Task] = {"psf-build": psf_build, "deconvolve": deconvolve}


# PSFs -----------------------------------------------------------------------------------------------


def _psf_of(context: Context, request: ResolvedDeconvolve) -> PsfRow:
    row = context.catalogue.get(PsfRow, request.psf_id, context.owner)
    if row is not None:
        return row
    if request.psf_recipe is None:
        raise DataError("no-such-psf", f"the catalogue holds no PSF with id {request.psf_id}")
    row = _built_psf(context, request.psf_recipe)
    if row.id != request.psf_id:
        raise DataError(
            "instrument-changed",
            f"the instrument file of {request.psf_recipe.instrument} changed since the job was taken: "
            f"expected PSF {request.psf_id}, got {row.id}; submit the job again",
        )
    return row


def _built_psf(context: Context, build: PsfBuild) -> PsfRow:
    identity = psf_identity(build)
    row = context.catalogue.get(PsfRow, identity, context.owner)
    if row is not None:
        return row
    text = instrument_text(build)
    instrument = parse_instrument(text, build.instrument or "instrument_file")
    psf = build_psf(
        instrument,
        size=build.size,
        component=build.component and build.component.upper(),
        mount_image=_mount_image(context, build, instrument),
        threads=context.settings.threads,
        progress=lambda step, steps: context.report("building the PSF", step, steps),
    )
    psf = dataclasses.replace(
        psf,
        version=f"{psf.version}+{identity[:8]}",
        provenance={
            **psf.provenance,
            "psf_id": identity,
            "instrument_file_sha256": hashlib.sha256(text.encode()).hexdigest(),
            "parameters": build.model_dump(mode="json", exclude={"instrument_file"}, exclude_none=True),
            "algorithm_version": build.algorithm_version,
            "software_version": software_version(),
        },
    )
    with context.store.temporary() as path, context.store.temporary() as picture:
        write_psf(path, psf, instrument_file=text.encode())
        plots.psf_png(psf, picture)
        row = psf_row(
            psf,
            identity,
            context.owner,
            origin="built",
            file_sha256=context.store.keep(path),
            store=context.store,
            preview_sha256=context.store.keep(picture),
        )
    return context.catalogue.add(row)[0]


def _mount_image(context: Context, build: PsfBuild, instrument: Instrument) -> NDArray[np.float64] | None:
    """The pixels of the mask image that the instrument's mount names, which the user uploaded."""
    named = None if instrument.mount is None else instrument.mount.mask_image
    if named is None and build.mask_id is None:
        return None
    if named is None:
        raise DataError(
            "mask-not-named", "mask_id: expected an instrument file with mount.mask_image; got none"
        )
    if build.mask_id is None:
        raise DataError(
            "mask-missing",
            f"mount.mask_image: expected {named.file} to be uploaded and its id given as mask_id; got none",
        )
    return read_image(context.store.path(build.mask_id), context.limits).pixels


def psf_row(
    psf: Psf,
    identity: str,
    owner: str,
    *,
    origin: str,
    file_sha256: str,
    store: Store,
    preview_sha256: str | None,
) -> PsfRow:
    """The catalogue's row of a PSF whose file is in the store."""
    curve = cumulative_curve(psf.kernel, np.array(CURVE_RADII_PX, dtype=float))
    return PsfRow(
        owner=owner,
        id=identity,
        created_at=time.time(),
        name=psf.name,
        version=psf.version,
        instrument=psf.instrument,
        status=psf.status,
        origin=origin,
        file_sha256=file_sha256,
        bytes=store.path(file_sha256).stat().st_size,
        preview_sha256=preview_sha256,
        details={
            "shape": list(psf.kernel.shape),
            "sum": float(psf.kernel.sum()),
            "plate_scale_arcsec": psf.plate_scale_arcsec,
            "wavelength_angstrom": psf.wavelength_angstrom,
            "components": sorted(psf.components),
            "cumulative_curve_pct": {str(r): float(c) for r, c in zip(CURVE_RADII_PX, curve, strict=True)},
            "provenance": psf.provenance,
        },
    )


@lru_cache(maxsize=2)
def _read_psf_cached(path: Path, limits: FitsLimits) -> Psf:
    """A PSF that this process read before is not read again; its file never changes."""
    return read_psf(path, limits, parts=False)


# Products -------------------------------------------------------------------------------------------


def _save_product(
    context: Context,
    identity: str,
    request: ResolvedDeconvolve,
    psf: PsfRow,
    image: Image,
    result: Deconvolved,
) -> None:
    product = dataclasses.replace(image, pixels=result.pixels)
    # A hash fills its card: there is no room for a comment beside it.
    cards: dict[str, tuple[Any, str]] = {
        "PRODID": (identity, ""),
        "PSFID": (psf.id, ""),
        "PSFVERS": (psf.version, "PSF version"),
        "PSFNAME": (psf.name, "PSF name"),
        "PSFSTAT": (psf.status, "PSF status"),
        "DCNVMETH": (request.method.name, "deconvolution method"),
        "DCNVITER": (result.steps_done, "deconvolution steps done"),
        "DCNVSTOP": (result.stopped_because, "why the iteration stopped"),
        "DCNVALGV": (request.method.algorithm_version, "algorithm version"),
        "SWHELIO": (software_version(), "heliopsf version"),
        "INPSHA": (request.image_id, ""),
    }
    history = [
        f"heliopsf {software_version()}: {request.method.name}, {result.steps_done} steps, "
        f"PSF {psf.name} {psf.version} ({psf.status})"
    ]
    context.report("saving", request.method.steps, request.method.steps)
    with context.store.temporary() as path, context.store.temporary() as picture:
        write_image(path, product, cards=cards, history=history, mask=image.mask)
        plots.preview_png(image.pixels, result.pixels, picture, title=_title(image, psf))
        file_sha256 = context.store.keep(path)
        preview_sha256 = context.store.keep(picture)
    context.catalogue.add(
        ProductRow(
            owner=context.owner,
            id=identity,
            created_at=time.time(),
            kind="deconvolved-image",
            image_id=request.image_id,
            psf_id=psf.id,
            psf_version=psf.version,
            file_sha256=file_sha256,
            bytes=context.store.path(file_sha256).stat().st_size,
            preview_sha256=preview_sha256,
            details={
                "method": request.method.model_dump(mode="json"),
                "algorithm_version": request.method.algorithm_version,
                "software_version": software_version(),
                "stopped_because": result.stopped_because,
                "job_id": context.job_id,
                **_statistics(image, result),
            },
        )
    )


def _title(image: Image, psf: PsfRow) -> str:
    parts = [image.header.get("DETECTOR") or image.header.get("INSTRUME") or "image"]
    parts += [str(image.header[key]) for key in ("DATE-BEG", "DATE-OBS") if image.header.get(key)][:1]
    return f"{' '.join(map(str, parts))}   PSF {psf.name} {psf.version}"


def _statistics(image: Image, result: Deconvolved) -> dict[str, Any]:
    """What changed: flux of the frame (negative pixels count as 0), and the change in bright and in dark pixels.

    Bright and dark are the pixels at and above the 99th percentile of the input, and at and below the first.
    """
    before, after = image.pixels[image.valid], result.pixels[image.valid]
    low, high = np.percentile(before, [1, 99])
    dark, bright = before <= low, before >= high
    return {
        "flux_change_pct": 100 * (result.flux_out / result.flux_in - 1),
        "last_step_change": result.last_change,
        "negative_pixels": result.negative_pixels,
        "bright_change_pct": _change_pct(before[bright], after[bright]),
        "dark_change_pct": _change_pct(before[dark], after[dark]),
        "masked_pixels": {
            str(bit.name).lower(): int(np.count_nonzero(image.mask & bit.value)) for bit in MaskBit
        },
    }


def _change_pct(before: np.ndarray, after: np.ndarray) -> float | None:
    """Change of the summed intensity; None where the input's own sum is not positive."""
    total = float(before.sum())
    return 100 * (float(after.sum()) / total - 1) if total > 0 else None
