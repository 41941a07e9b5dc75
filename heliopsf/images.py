"""Deconvolve images in this process, and find their PSFs."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, overload

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from heliopsf.inputs import box_of, cut, header_of, image_of, is_many, shape_of
from heliopsf.outputs import Deconvolution, in_form_of
from heliopsf.progress import Steps, Told, told
from heliopsf.psfs import Psf, built_psf, read_psf
from psfcore.deconvolve.box import LARGEST_ERROR
from psfcore.deconvolve.conditions import PreparedPsfs
from psfcore.deconvolve.edges import Edges
from psfcore.deconvolve.methods.registry import may_be_negative
from psfcore.deconvolve.run import BUILDING, DECONVOLVING, Options, input_warnings, read_and_deconvolve
from psfcore.errors import DataError, DataWarning
from psfcore.fits.frame import frame_of
from psfcore.fits.header import seen_by
from psfcore.image import Image
from psfcore.instruments.unknown import unknown_instrument
from psfcore.noise import Noise
from psfcore.psf import Psf as CorePsf
from psfcore.psf_sampling import psf_for_image
from psfcore.scatter.total_psf import possible_on_pixels
from workers.machine import cores, free_bytes

if TYPE_CHECKING:
    from astropy.nddata import NDData

    Like = TypeVar("Like", NDData, NDArray[Any])
else:
    Like = TypeVar("Like")

AnyPsf = str | Path | CorePsf | NDArray[np.floating]


@overload
def deconvolve(smap: str | Path | Image, psf: AnyPsf | None = ..., **options: Any) -> Deconvolution: ...
@overload
def deconvolve(smap: Like, psf: AnyPsf | None = ..., **options: Any) -> Like: ...
@overload
def deconvolve(smap: Sequence[Any], psf: AnyPsf | None = ..., **options: Any) -> list[Any]: ...
def deconvolve(
    smap: Any,
    psf: AnyPsf | None = None,
    iterations: int | None = None,
    clip_negative: bool | None = None,
    use_gpu: bool = False,
    *,
    method: str = "richardson-lucy",
    noise: tuple[float, float] | None = None,
    error_draws: int = 0,
    saturation_dn: float | None = None,
    hdu: int | None = None,
    plate_scale_arcsec: float | None = None,
    edges: Edges | None = None,
    region: Any = None,
    region_error: float = LARGEST_ERROR,
    other_channel: bool = False,
    again: bool = False,
    full: bool = False,
    threads: int | None = None,
    progress: Told = None,
    **parameters: Any,
) -> Any:
    """Deconvolve an image with the PSF of its telescope. The result has the form of the image.

        >>> import heliopsf, sunpy.map
        >>> image = sunpy.map.Map("aia.fits")
        >>> sharp = heliopsf.deconvolve(image)

    The first parameters are the same as in ``aiapy.psf.deconvolve``, so calls of that function work unchanged.

    smap: the image. A sunpy Map, an NDData or a CCDData gives an object of the same class. An array gives an array, and
    needs ``psf``. A path of a FITS file or an ``Image`` gives a ``Deconvolution``. A list of these gives a list.
    Cut-outs work like whole images. Pixels that are NaN or masked are not used; they are NaN in the result.
    psf: a ``Psf``, a path of a FITS file, or an array whose centre is [ny // 2, nx // 2]; default: the PSF that is
    built for the telescope in the header, see ``psf_for``, but without its components. The PSF is rebinned if the
    image is binned.
    iterations: number of steps; default: the number of the method (Richardson-Lucy: 20; aiapy: 25).
    clip_negative: whether pixels below 0 count as 0; default: the rule of the method. The Richardson-Lucy methods
    always count these pixels as 0. For ``linear`` and ``basic-iterative`` the default is False.
    use_gpu: without effect, because heliopsf computes on the processor; ``threads`` is the number of threads.
    method: "richardson-lucy", "linear" or another method.
    noise: photon gain (DN per photon) and read noise (DN rms); default: the values of the instrument, if known.
    error_draws: number of noise realisations (2 to 64) for the standard deviation of each pixel: ``uncertainty`` of the
    result. Each realisation takes as long as one deconvolution. 0: no uncertainty.
    saturation_dn: pixels at or above this level (DN) are ignored; default: the level that the header or the instrument
    file gives, or that the pixels show.
    hdu: number of the HDU with the image, for a path of a FITS file; default: the first image.
    plate_scale_arcsec: plate scale of a PSF that gives none, arcsec/px.
    edges: "zero", "symmetric" or "extended"; default: the assumption that suits the method best.
    region: deconvolve only a box of the image, which gives nearly the same pixels as the whole image, in less time and
    memory: a text "x0:x1,y0:y1" in pixels, ``np.s_[y0:y1, x0:x1]``, or for a Map its two corners ``(bottom_left,
    top_right)`` as ``Map.submap`` takes them. The result is the box. Not together with ``error_draws`` and
    ``stop="discrepancy"``.
    region_error: the rim that is deconvolved around the region is so wide that the bound of the difference from the whole
    image is at most this share of the mean light of the region; if no rim is wide enough, the whole image is
    deconvolved. The card DCNVBERR has the bound.
    other_channel: whether the PSF may be of another telescope, channel or filter than the image.
    again: deconvolve the image even if its header says that it is a product or a PSF.
    full: return a ``Deconvolution`` for every form of image: pixels, QUALITY, errors, changes and plots.
    threads: default: all cores. The number does not change the result.
    progress: True, or a function that is called with (step, steps) after each step of the deconvolution.
    parameters: further parameters of the method, such as ``stop="discrepancy"``.

    A Map or NDData keeps its metadata. The result also has the cards of products (PSFID, PSFVERS, ...), HISTORY, and a
    mask of the pixels without a measurement (QUALITY 1 or 2: not finite, masked or saturated).

    Raises ``DataError``; its ``code`` is the reason, such as "no-psf-for-instrument", "not-fits", "already-deconvolved",
    "plate-scale-mismatch", "channel-mismatch" or "unknown-method". Gives a ``DataWarning`` with its ``code`` for
    everything that may make the result wrong (docs/products.md lists them).
    """
    options = Options(
        method=method,
        parameters=_with_steps(parameters, iterations),
        edges=edges,
        noise=None if noise is None else Noise(*noise),
        error_draws=error_draws,
        region_error=region_error,
        threads=threads or cores(),
    )

    def begin(stage: str, _steps: int) -> Steps | None:
        return told(progress if stage == DECONVOLVING else progress is True, stage)

    prepared = PreparedPsfs()
    given = None if psf is None else _given(psf)

    def one(image: Any) -> Any:
        box = None if region is None else box_of(region, image)
        product, _ = read_and_deconvolve(
            lambda: image_of(image, saturation_dn=saturation_dn, hdu=hdu),
            shape_of(image, hdu),
            given,
            options if box is None else replace(options, region=box),
            build=partial(_built_for, threads=options.threads, parts=False),
            possible_psfs=partial(possible_on_pixels, threads=options.threads),
            prepared=prepared,
            free_bytes=free_bytes(),
            plate_scale_arcsec=plate_scale_arcsec,
            other_channel=other_channel,
            again=again,
            clip=partial(_clipped, clip_negative=clip_negative, method=method),
            begin=begin,
            say=lambda code, message: warnings.warn(DataWarning(code, message), stacklevel=5),
        )
        result = Deconvolution(**vars(product) | {"psf": Psf.of(product.psf)})
        return result if full else in_form_of(image if box is None else cut(image, box), result)

    if not is_many(smap):
        return one(smap)
    images, results = list(smap), []
    for number, image in enumerate(images, start=1):
        try:
            results.append(one(image))
        except DataError as error:
            message = f"image {number} of {len(images)}: {error.message}"
            raise type(error)(error.code, message, error.fields) from error
    return results


def psf_for(
    image: Any,
    *,
    threads: int | None = None,
    progress: Told = None,
) -> Psf:
    """The PSF for an image, on the pixels of the image. A service without certified PSFs chooses the same PSF.

    image: as for ``deconvolve``, or a header (a ``Header`` of astropy, or a table of cards such as ``Map.meta``).
    The first call for a telescope takes up to a minute; the PSF is then kept in a cache (see ``heliopsf cache``).

    Raises ``DataError`` "no-psf-for-instrument", "channel-mismatch" or "plate-scale-mismatch".
    """
    header = header_of(image)
    psf = _built_for(header, told(progress is True, BUILDING), threads=threads or cores(), parts=True)
    for code, message in input_warnings(psf, _header_only(header), None, other_channel=False).items():
        warnings.warn(DataWarning(code, message), stacklevel=2)
    return Psf.of(psf_for_image(psf, header))


def _built_for(header: Header, progress: Steps | None, *, threads: int, parts: bool) -> Psf:
    """The PSF of the shipped instrument file that the header names. parts: whether it needs its components.

    Raises ``DataError`` "no-psf-for-instrument".
    """
    summary = seen_by(header)
    if summary["instrument"] is None:
        raise unknown_instrument(summary)
    return built_psf(
        summary["instrument"],
        turn_deg=frame_of(header).turn_to_build_deg,
        parts=parts,
        threads=threads,
        progress=progress,
    )


def _given(psf: AnyPsf) -> Psf:
    if isinstance(psf, CorePsf):
        return psf if isinstance(psf, Psf) else Psf.of(psf)
    if isinstance(psf, str | Path):
        return read_psf(psf)
    if isinstance(psf, np.ndarray):
        return Psf(
            kernel=np.asarray(psf, np.float64),
            name="array",
            version="unversioned",
            instrument=None,
            status="user",
        )
    raise DataError(
        "bad-input", f"psf: expected a Psf, a path of a FITS file or an array; got {type(psf).__name__}"
    )


def _clipped(image: Image, *, clip_negative: bool | None, method: str) -> Image:
    """The image; if ``clip_negative`` is true, with pixels below 0 set to 0. Raises ``DataError`` "negative-pixels"."""
    negative = image.valid & (image.pixels < 0)
    if clip_negative is None or not negative.any():
        return image
    if clip_negative:
        return replace(image, pixels=np.where(negative, 0.0, image.pixels))
    if not may_be_negative(method):
        raise DataError(
            "negative-pixels",
            f"clip_negative=False: expected an image without negative pixels, or a method whose results may be negative "
            f'("linear", "basic-iterative"); got {np.count_nonzero(negative)} negative pixels and {method!r}',
        )
    return image


def _with_steps(parameters: Mapping[str, Any], iterations: int | None) -> dict[str, Any]:
    if iterations is None:
        return dict(parameters)
    if "steps" in parameters:
        raise DataError(
            "bad-steps", "expected iterations or steps; got both, which mean the same: give only one of them"
        )
    return {**parameters, "steps": iterations}


def _header_only(header: Header) -> Image:
    """An image with this header, to compare channels when only the header is known."""
    pixels = np.ones((16, 16))
    return Image(pixels, np.zeros(pixels.shape, np.uint8), header, None, None)
