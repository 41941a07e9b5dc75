"""The product of a deconvolution: its FITS file, its pictures, and its row in the catalogue."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess.changes import Changes
from psfcore.deconvolve.assess.quality import MEANINGS
from psfcore.deconvolve.cards import UsedPsf, deconvolution_cards, deconvolution_history
from psfcore.deconvolve.result import Deconvolved, OfBox
from psfcore.drawing.thumbnail import write_thumbnail
from psfcore.drawing.units import unit_label
from psfcore.fits.cards import optional_text
from psfcore.fits.images import described, write_image
from psfcore.image import Image, MaskBit
from workers.catalogue.tables import ProductRow, PsfRow
from workers.contract.identities import product_identity
from workers.contract.requests import ResolvedDeconvolve
from workers.files.archive import safe_name
from workers.settings import library_versions, software_version
from workers.tasks.context import Context

if TYPE_CHECKING:
    from psfcore.deconvolve.assess.error_planes import ErrorPlanes


@dataclass(frozen=True)
class Inputs:
    """What a product is made from: the request, the PSF's row, and the image that was read."""

    context: Context
    request: ResolvedDeconvolve
    psf_row: PsfRow
    image: Image


@dataclass(frozen=True)
class Warned:
    """A warning for users of the product: a short code and a sentence."""

    code: str
    message: str


@dataclass(frozen=True)
class Made:
    """A finished deconvolution whose file is not yet written. preview_sha256: None if no preview was drawn."""

    inputs: Inputs
    result: Deconvolved
    errors: ErrorPlanes | None
    found: Changes
    quality: NDArray[np.uint8]
    warnings: Sequence[Warned]
    details: dict[str, Any]
    preview_sha256: str | None

    @property
    def identity(self) -> str:
        """The product's id."""
        return product_identity(self.inputs.request)


def write(made: Made, path: Path) -> None:
    """Write the product as a FITS file."""
    inputs, result, errors = made.inputs, made.result, made.errors
    planes: dict[str, NDArray[Any]] = {"QUALITY": made.quality}
    if errors is not None:
        planes["ERROR"] = errors.error
        if errors.psf_error is not None:
            planes["PSF_ERROR"] = errors.psf_error
    own = described(
        inputs.image.header,
        filename=filename_of(inputs),
        creator=f"heliopsf {software_version()}",
        sha256=inputs.request.image_id,
    )
    write_image(
        path,
        dataclasses.replace(inputs.image, pixels=result.pixels, header=own.header),
        cards=own.cards | _cards(inputs, made.identity, result, errors, made.warnings),
        history=_history(inputs, result, made.warnings) + own.history,
        planes=planes,
        plane_bits={"QUALITY": MEANINGS},
    )


def filename_of(inputs: Inputs) -> str:
    """The name in the product's header: it depends only on the content of the input and on the request."""
    name = optional_text(inputs.image.header, "FILENAME") or "heliopsf"
    return safe_name(name, product_identity(inputs.request))


def keep(made: Made, path: Path) -> ProductRow:
    """Move a written product file into the store and add the product to the catalogue."""
    inputs, context = made.inputs, made.inputs.context
    size_bytes = path.stat().st_size
    file_sha256 = context.store.keep(path)
    picture = _save_changes_picture(made) if inputs.request.changes_picture else None
    thumbnail = _save_thumbnail(made)
    row = ProductRow(
        owner=context.owner,
        id=made.identity,
        created_at=time.time(),
        kind="deconvolved-image",
        image_id=inputs.request.image_id,
        psf_id=inputs.psf_row.id,
        psf_version=inputs.psf_row.version,
        file_sha256=file_sha256,
        bytes=size_bytes,
        preview_sha256=made.preview_sha256 or thumbnail,
        details=made.details | {"changes_picture_sha256": picture, "thumbnail_sha256": thumbnail},
    )
    return context.add(row)


def save_preview(inputs: Inputs, result: Deconvolved) -> str:
    """Draw the preview (before, after, change) into the store; returns its SHA-256."""
    from psfcore.drawing import plots  # matplotlib is loaded only if a picture is drawn

    with inputs.context.store.temporary() as picture:
        image = inputs.image
        plots.preview_png(image.pixels, result.pixels, picture, title=_title(inputs), unit=unit_label(image))
        return inputs.context.store.keep(picture)


def _save_thumbnail(made: Made) -> str:
    store = made.inputs.context.store
    with store.temporary() as picture:
        write_thumbnail(made.result.pixels, picture)
        return store.keep(picture)


def _save_changes_picture(made: Made) -> str:
    from psfcore.deconvolve.assess.plots import changes_png

    inputs = made.inputs
    with inputs.context.store.temporary() as picture:
        changes_png(
            inputs.image.pixels,
            made.result.pixels,
            made.found,
            picture,
            title=_title(inputs),
            unit=unit_label(inputs.image),
        )
        return inputs.context.store.keep(picture)


def _cards(
    inputs: Inputs,
    identity: str,
    result: Deconvolved,
    errors: ErrorPlanes | None,
    warnings: Sequence[Warned],
) -> dict[str, tuple[Any, str]]:
    cards = deconvolution_cards(
        _used_psf(inputs),
        result,
        saturation=inputs.image.saturation,
        amplification=None if errors is None else errors.amplification,
        warnings=[one.code for one in warnings],
    )
    # The order of the cards must not change, because equal requests must give equal bytes.
    ordered: dict[str, tuple[Any, str]] = {"PRODID": (identity, "")}
    for key, card in cards.items():
        if key == "SWHELIO":
            ordered["DCNVALGV"] = (inputs.request.method.algorithm_version, "algorithm version")
        ordered[key] = card
        if key == "SWHELIO":
            ordered["INPSHA"] = (inputs.request.image_id, "")
    return ordered


def _used_psf(inputs: Inputs) -> UsedPsf:
    psf = inputs.psf_row
    return UsedPsf(psf.id, psf.name, psf.version, psf.status)


def _history(inputs: Inputs, result: Deconvolved, warnings: Sequence[Warned]) -> list[str]:
    return deconvolution_history(_used_psf(inputs), result, {one.code: one.message for one in warnings})


def _title(inputs: Inputs) -> str:
    header = inputs.image.header
    seen_by = optional_text(header, "DETECTOR", "INSTRUME") or "image"
    date = optional_text(header, "DATE-BEG", "DATE-OBS", "DATE_OBS")
    return f"{seen_by}{f' {date}' if date else ''}   PSF {inputs.psf_row.name} {inputs.psf_row.version}"


def details_of(
    inputs: Inputs,
    result: Deconvolved,
    errors: ErrorPlanes | None,
    found: Changes,
    warnings: Sequence[Warned],
) -> dict[str, Any]:
    """The details of the product's row: how the product was made, the measured changes, and the warnings.

    A bright pixel is at or above the 99th percentile of the input; a dark pixel is at or below the first percentile.
    """
    image = inputs.image
    before, after = image.pixels[image.valid], result.pixels[image.valid]
    low, high = np.percentile(before, [1, 99])
    dark, bright = before <= low, before >= high
    details = {
        "filename": filename_of(inputs),
        "method": inputs.request.method.model_dump(mode="json"),
        "algorithm_version": inputs.request.method.algorithm_version,
        "software_version": software_version(),
        "libraries": library_versions(),
        "parameters": inputs.request.model_dump(mode="json", exclude_none=True),
        "job_id": inputs.context.job_id,
        "steps_done": result.steps_done,
        "stopped_because": result.stopped_because,
        "last_step_change": result.last_change,
        "edges": result.edges,
        "edge_band_px": result.edge_band_px,
        "noise_amplification": result.noise_amplification if errors is None else errors.amplification,
        "chi2_per_pixel": result.chi2_per_pixel,
        "region": None if result.of_box is None else _region(result.of_box),
        "flux_change_pct": result.flux_change_pct,
        "bright_change_pct": _change_pct(before[bright], after[bright]),
        "dark_change_pct": _change_pct(before[dark], after[dark]),
        "negative_pixels": result.negative_pixels,
        "masked_pixels": {
            str(bit.name).lower(): int(np.count_nonzero(image.mask & bit.value)) for bit in MaskBit
        },
        "saturation": _saturation(image),
        "warnings": [dataclasses.asdict(one) for one in warnings],
        "changes": found.as_json(),
    }
    return details


def _region(found: OfBox) -> dict[str, Any]:
    """The region that was deconvolved alone, the rim around it, and the bound of the error in the unit of the image."""
    return {"box": str(found.box), "rim_px": found.rim_px, "error": found.error}


def _saturation(image: Image) -> dict[str, Any] | None:
    """The saturation level in the unit of the image, and the source of this level; None if the level is not known."""
    found = image.saturation
    return None if found is None else {"level": found.level, "unit": image.unit, "found": found.found}


def _change_pct(before: NDArray[np.float64], after: NDArray[np.float64]) -> float | None:
    """Change of the summed intensity, in percent; None if the sum of the input is not positive."""
    total = float(before.sum())
    return 100 * (float(after.sum()) / total - 1) if total > 0 else None
