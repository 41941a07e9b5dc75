"""What a telescope records of a model image: the image convolved with the PSF of the telescope, on its own pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from psfcore import software_version
from psfcore.deconvolve.conditions import Progress, new_engine
from psfcore.deconvolve.declaration import KnownScene
from psfcore.deconvolve.doubts import input_warnings
from psfcore.deconvolve.edges import lay_out, margin_for, share_from_beyond
from psfcore.deconvolve.memory import check_memory, convolution_bytes
from psfcore.deconvolve.run import BUILDING, Cards, PsfSource, UsedPsf
from psfcore.errors import DataError
from psfcore.fits.images import write_image
from psfcore.image import Image
from psfcore.instruments.psf_statements import caveats, title
from psfcore.psf import Psf


@dataclass(frozen=True, kw_only=True)
class Convolved:
    """A model image as a telescope records it.

    Attributes
    ----------
    pixels
        Recorded light [y, x] in the unit of the image; NaN where the image has no finite value.
    image
        The model image.
    psf
        The PSF on the pixels of the image.
    edges
        The assumed scene beyond the image.
    warnings
        Sentences by their codes.
    """

    pixels: NDArray[np.float64]
    image: Image
    psf: Psf
    edges: KnownScene
    warnings: Mapping[str, str]

    def title(self, psf: UsedPsf) -> str:
        """Name the PSF and the edges, for the title of a picture.

        Parameters
        ----------
        psf : UsedPsf
            The PSF as the cards of the result name it.

        Returns
        -------
        str
            One line.
        """
        return f"convolved with {title(psf.name, psf.version, psf.status)}, edges {self.edges}"


def cards(found: Convolved, psf: UsedPsf) -> Cards:
    """The cards that say how the image was convolved. They differ from those of a product, so that the result can be
    deconvolved as an image of the telescope.

    Parameters
    ----------
    psf
        The PSF as the cards name it.
    """
    return {
        "CNVPSFID": (psf.id, ""),
        "CNVPSFN": (psf.name, "name of the PSF of the convolution"),
        "CNVPSFV": (psf.version, "version of this PSF"),
        "CNVEDGE": (found.edges, "assumed scene beyond the edges"),
        "SWHELIO": (software_version(), "heliopsf version"),
    }


def history(found: Convolved, psf: UsedPsf) -> list[str]:
    """The lines of HISTORY."""
    return [
        f"heliopsf {software_version()}: {found.title(psf)}",
        *(f"WARNING ({code}): {message}" for code, message in found.warnings.items()),
    ]


def lines(found: Convolved, psf: UsedPsf) -> list[str]:
    """The PSF and the edges; the caveats of the PSF, if it has some; the shape, the brightest pixel and the light that
    stays in the field.
    """
    ny, nx = found.pixels.shape
    before, after = (plane[found.image.finite] for plane in (found.image.pixels, found.pixels))
    kept = (
        f"; {100 * after.sum() / before.sum():.4g} % of the light stays in the field"
        if before.sum() > 0
        else ""
    )
    doubts = caveats(found.psf.name, found.psf.instrument, found.psf.provenance, convolved=True)
    return [
        found.title(psf),
        *([f"caveats of the PSF: {'; '.join(doubts)}"] if doubts else []),
        f"{nx} x {ny} px; brightest pixel {before.max():.4g} before, {after.max():.4g} after{kept}",
    ]


def write(found: Convolved, path: Path, psf: UsedPsf) -> None:
    """Write a FITS file whose cards name the PSF as `psf` does."""
    image = replace(found.image, pixels=found.pixels)
    write_image(path, image, cards=cards(found, psf), history=history(found, psf))


def convolve(image: Image, psf: Psf, *, edges: KnownScene = "zero", threads: int = 1) -> NDArray[np.float64]:
    """Convolve an image with a PSF: H x of Eq. (1) in `psfcore.convolution.convolver`. Returns the pixels [y, x].

    Pixels without a value send no light, and stay without a value. Raises DataError "bad-edges", "all-masked" and
    "no-signal".

    Parameters
    ----------
    psf
        The PSF on the pixels of the image.
    edges
        The scene beyond the image: "zero", or "symmetric" (the mirror image of the image, as far as light reaches).
    """
    if edges not in (known := get_args(KnownScene)):
        raise DataError(
            "bad-edges", f"expected edges {' or '.join(known)}, the scene beyond the image; got {edges!r:.60}"
        )
    ny, nx = image.pixels.shape
    margin_px = margin_for(share_from_beyond(psf), (ny, nx), share=0.0)
    domain = lay_out(image, edges=edges, margin_px=margin_px)
    engine = new_engine(psf, domain.shape, domain.shape, threads, domain.margin_px)
    pixels = domain.cut([(0, engine.apply(domain.pixels))])
    pixels[~image.finite] = np.nan
    return pixels.astype(np.float64)


def convolve_image(
    image: Image,
    source: PsfSource,
    *,
    edges: KnownScene = "zero",
    threads: int = 1,
    free_bytes: int | None = None,
    begin: Callable[[str, int], Progress | None] = lambda stage, steps: None,
) -> Convolved:
    """Convolve an image with the PSF of a source, which is brought onto the pixels of the image.

    Raises DataError "too-much-memory" before the PSF is built, "plate-scale-known", "plate-scale-mismatch",
    "channel-mismatch", and the errors of the source and of `convolve`.

    Parameters
    ----------
    free_bytes
        The free memory, into which the work must fit, bytes; None: not known.
    begin
        Function that is called when a stage begins, see `psfcore.deconvolve.work.Work.errors`.
    """
    if free_bytes is not None:
        (ny, nx), (rows, columns) = image.pixels.shape, source.kernel_shape
        needed = convolution_bytes((ny, nx), (rows, columns), edges)
        check_memory((ny, nx), needed, free_bytes, task="convolution", advice="use a smaller model image")
    ny, nx = image.pixels.shape
    _, fitted, channel = source.on_pixels_of(
        image.header, (ny, nx), lambda: source.load(image.header, begin(BUILDING, 1))
    )
    warnings = {**source.warnings, **input_warnings(source.seen_as(fitted), image, None, channel=channel)}
    pixels = convolve(image, fitted, edges=edges, threads=threads)
    return Convolved(pixels=pixels, image=image, psf=fitted, edges=edges, warnings=warnings)
