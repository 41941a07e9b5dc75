"""Deconvolve images in this process, and find their PSFs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, overload

import numpy as np
from astropy import units
from astropy.io.fits import Header
from numpy.typing import NDArray

from heliopsf.inputs import (
    box_of,
    cut,
    header_of,
    image_of,
    is_many,
    is_sequence,
    on_disk,
    shape_of,
    uncertainty_of,
)
from heliopsf.outputs import Convolution, Deconvolution, in_form_of
from heliopsf.parameters import Number, Options, Progress, Steps, noise_of, number, reporter, whole
from heliopsf.psfs import AnyPsf, Psf, built_psf, given_psf, instrument_named
from psfcore.deconvolve.camera_noise import measured_noise
from psfcore.deconvolve.conditions import PreparedPsfs
from psfcore.deconvolve.declaration import KnownScene
from psfcore.deconvolve.doubts import input_warnings
from psfcore.deconvolve.forward import convolve_image
from psfcore.deconvolve.methods.registry import properties_of
from psfcore.deconvolve.run import BUILDING, DECONVOLVING, PsfSource, read_and_deconvolve
from psfcore.deconvolve.work import Options as WorkOptions
from psfcore.errors import DataError, DataWarning
from psfcore.fits.channel import PsfOrigin, check_channel
from psfcore.fits.frame import frame_of
from psfcore.fits.header import seen_by
from psfcore.image import Image
from psfcore.instruments.unknown import unknown_instrument
from psfcore.psf_sampling import psf_for_image
from psfcore.published_psfs import PUBLISHED_OF_IMAGE, published_of
from psfcore.scatter.total_psf import possible_on_pixels
from workers.machine import cores, free_bytes

if TYPE_CHECKING:
    from astropy.nddata import NDData

    Like = TypeVar("Like", NDData, NDArray[Any])
else:
    Like = TypeVar("Like")


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
    full: bool = False,
    **options: Any,
) -> Any:
    """Deconvolve an image with the PSF of its telescope. The result has the form of the image.

        >>> import heliopsf, sunpy.map
        >>> image = sunpy.map.Map("aia.fits")
        >>> sharp = heliopsf.deconvolve(image)
        >>> sharp = heliopsf.deconvolve(image, method="richardson-lucy-accelerated", steps=12, order=2, error_draws=8)

    The first five parameters are those of ``aiapy.psf.deconvolve``, so calls of that function work unchanged.

    Parameters
    ----------
    smap : Map, NDData, NDCube, array, (array, header), HDU, HDUList, path, bytes, Image or list
        The image. The result is of the same class; for a path, the bytes of a file or an ``Image`` it is a
        ``Deconvolution``, for a MapSequence a MapSequence. Pixels that are NaN or masked are not used; they are NaN in
        the result.
    psf : Psf, path, name, array, optional
        A PSF, its FITS file, the name of a known instrument, an instrument file (TOML), the name of a published PSF
        ("published": that of the image), or weights with their centre at [ny // 2, nx // 2]. Default: the PSF of the
        telescope in the header (``psf_for``), without its components. The PSF is rebinned if the image is binned.
    iterations : int, optional
        Number of steps, also called ``steps``. Default: that of the method (Richardson-Lucy: 20; aiapy: 25).
    clip_negative : bool, optional
        Whether pixels below 0 count as 0. The Richardson-Lucy methods always count them as 0; "linear" and
        "basic-iterative" do not by default.
    use_gpu : bool
        Without effect, because heliopsf computes on the processor.
    method : str
        "richardson-lucy", "linear" or another method (docs/choose.md).
    full : bool
        Return a ``Deconvolution`` for every form of image: pixels, QUALITY, errors, changes and plots.
    **options
        Parameters of the method: ``steps``, ``stop`` ("fixed", or "discrepancy": stop once the residual is like the
        ``noise``), and its own, such as ``order`` and ``smoothing``. All others are described by ``heliopsf.Options``:

        - the image: ``hdu``, ``saturation_dn``, ``plate_scale_arcsec``, ``noise``, ``other_channel``, ``again``
        - the result: ``region``, ``region_error``, ``error_draws``, ``edges``, ``margin_px``
        - the run: ``threads``, ``progress``

    Returns
    -------
    Map, NDData, array, HDU, HDUList, Deconvolution or list
        Metadata are kept, with the cards of products (PSFID, PSFVERS, ...), HISTORY, and a mask of the pixels without a
        measurement (QUALITY 1 or 2: not finite, masked or saturated).

    Raises
    ------
    DataError
        Its ``code`` is the reason, such as "no-psf-for-instrument", "no-such-file", "already-deconvolved",
        "plate-scale-mismatch", "channel-mismatch", "unknown-method" or "unknown-parameter".

    Warns
    -----
    DataWarning
        With its ``code``, for everything that may make the result wrong (docs/products.md lists the codes).
    """
    names = {one.name for one in fields(Options)}
    given = Options(**{name: value for name, value in options.items() if name in names})
    of_method = {name: value for name, value in options.items() if not (name in names or value is None)}
    if iterations is not None and "steps" in of_method:
        raise DataError(
            "bad-steps", "expected iterations or steps; got both, which mean the same: give only one of them"
        )
    if (steps := of_method.get("steps", iterations)) is not None:
        of_method["steps"] = whole("steps", steps, "bad-steps")
    work = WorkOptions(
        method=method,
        parameters=of_method,
        edges=given.edges,
        margin_px=given.margin_px,
        noise=noise_of(given.noise),
        error_draws=whole("error_draws", given.error_draws, "bad-draws"),
        region_error=number("region_error", given.region_error, units.dimensionless_unscaled),
        threads=cores() if given.threads is None else whole("threads", given.threads, "bad-threads"),
    )

    def begin(stage: str, _steps: int) -> Steps | None:
        return reporter(given.progress if stage == DECONVOLVING else given.progress is True, stage)

    of_image = _source_of(
        psf,
        plate_scale_arcsec=given.plate_scale_arcsec,
        other_channel=given.other_channel,
        threads=work.threads,
    )

    def one(image: object) -> object:
        box = None if given.region is None else box_of(given.region, image, given.hdu)
        sigma = None if work.noise is not None else uncertainty_of(image)
        if sigma is not None and not work.error_draws:
            message = "the uncertainty of the image is not used: error_draws=8 uses it as the noise, and gives it back"
            warnings.warn(DataWarning("uncertainty-dropped", message), stacklevel=3)
            sigma = None

        def read() -> Image:
            return image_of(image, saturation=given.saturation_dn, hdu=given.hdu)

        product, _ = read_and_deconvolve(
            read,
            of_image,
            replace(work, region=box, noise=work.noise if sigma is None else measured_noise(read(), sigma)),
            shape=shape_of(image, given.hdu),
            free_bytes=free_bytes(),
            again=given.again,
            clip=partial(_clipped, clip_negative=clip_negative, method=method),
            begin=begin,
            say=lambda code, message: warnings.warn(DataWarning(code, message), stacklevel=5),
        )
        result = Deconvolution(
            **vars(product) | {"psf": Psf.of(product.psf), "pixels": product.pixels.astype(np.float64)}
        )
        return result if full else in_form_of(image if box is None else cut(image, box, given.hdu), result)

    if not is_many(smap):
        with on_disk(smap) as image:
            return one(image)
    images, results = list(smap), []
    for count, image in enumerate(images, start=1):
        try:
            with on_disk(image) as there:
                results.append(one(there))
        except DataError as error:
            message = f"image {count} of {len(images)}: {error.message}"
            raise type(error)(error.code, message, error.fields) from error
    return type(smap)(*results) if is_sequence(smap) and not full else results


def convolve(
    smap: object,
    psf: AnyPsf | None = None,
    *,
    edges: KnownScene = "zero",
    full: bool = False,
    hdu: int | None = None,
    plate_scale_arcsec: Number | None = None,
    other_channel: bool = False,
    threads: int | None = None,
    progress: Progress = None,
) -> Any:
    """Convolve a model image with a PSF. The result has the form of the image.

        >>> recorded = heliopsf.convolve(model, "aia_171")

    Parameters
    ----------
    smap : Map, NDData, NDCube, array, (array, header), HDU, HDUList, path, bytes or Image
        The model image. For a path, the bytes of a file or an ``Image`` the result is a ``Convolution``. Pixels that
        are NaN or masked as not finite send no light; they are NaN in the result.
    psf : Psf, path, name, array, optional
        As for ``deconvolve``. The PSF is rebinned if the image is binned, and turned if it is turned.
    edges : {"zero", "symmetric"}
        The scene beyond the image: dark, or its mirror image.
    full : bool
        Return a ``Convolution`` for every form of image.
    hdu : int, optional
        Number of the HDU with the image. Default: the first image.
    plate_scale_arcsec : float or Quantity, optional
        Plate scale of a PSF that gives none, arcsec/px.
    other_channel : bool
        Whether the PSF may be of another telescope, channel or filter than the image.
    threads : int, optional
        Number of threads. Default: all cores.
    progress : bool, optional
        True: show a line while the PSF is built.

    Returns
    -------
    Map, NDData, array, HDU, HDUList or Convolution
        In the unit of the image, with the cards CNVPSFID, CNVPSFN, CNVPSFV and CNVEDGE, and HISTORY.

    Raises
    ------
    DataError
        "bad-edges", "no-signal", "all-masked", "too-much-memory", "no-psf-for-instrument", "channel-mismatch" or
        "plate-scale-mismatch", and the errors of reading.

    Warns
    -----
    DataWarning
        With its ``code``, for what may make the PSF wrong for this image.
    """
    count = cores() if threads is None else whole("threads", threads, "bad-threads")

    def begin(stage: str, _steps: int) -> Steps | None:
        return reporter(progress is True, stage)

    of_image = _source_of(
        psf, plate_scale_arcsec=plate_scale_arcsec, other_channel=other_channel, threads=count
    )
    with on_disk(smap) as there:
        image = image_of(there, saturation=None, hdu=hdu)
        found = convolve_image(
            image, of_image, edges=edges, threads=count, free_bytes=free_bytes(), begin=begin
        )
        for code, message in found.warnings.items():
            warnings.warn(DataWarning(code, message), stacklevel=2)
        result = Convolution(**vars(found) | {"psf": Psf.of(found.psf)})
        return result if full else in_form_of(there, result)


def psf_for(image: object, *, threads: int | None = None, progress: Progress = None) -> Psf:
    """Find the PSF for an image, on the pixels of the image.

    A service without certified PSFs chooses the same PSF. The first call for a telescope takes up to a minute; the PSF
    is then kept in a cache (see ``heliopsf cache``).

    Parameters
    ----------
    image : Map, NDData, NDCube, array, (array, header), HDU, HDUList, path, bytes, Image or header
        As for ``deconvolve``, or a header (a ``Header`` of astropy, or a table of cards such as ``Map.meta``).
    threads : int, optional
        Number of threads. Default: all cores.
    progress : bool, optional
        True: show a line while the PSF is built.

    Returns
    -------
    Psf
        With its ``kernel`` [y, x] and its ``components``.

    Raises
    ------
    DataError
        "no-psf-for-instrument", "channel-mismatch" or "plate-scale-mismatch", and the errors of reading a header.

    Warns
    -----
    DataWarning
        With its ``code``, for what may make the PSF wrong for this image.
    """
    with on_disk(image) as there:
        header = header_of(there)
    psf = _built_for(header, reporter(progress is True, BUILDING), threads=threads or cores(), parts=True)
    channel = check_channel(psf, header)
    for code, message in input_warnings(psf, _header_only(header), None, channel=channel).items():
        warnings.warn(DataWarning(code, message), stacklevel=2)
    return Psf.of(psf_for_image(psf, header))


def _source_of(
    psf: AnyPsf | None, *, plate_scale_arcsec: Number | None, other_channel: bool, threads: int
) -> PsfSource:
    """The PSF that a user gives, or that of the telescope in the header of each image (None). A PSF that must be built
    is built when it is needed.
    """
    scale = plate_scale_arcsec
    source = partial(
        PsfSource,
        possible_psfs=partial(possible_on_pixels, threads=threads),
        plate_scale_arcsec=None
        if scale is None
        else number("plate_scale_arcsec", scale, units.arcsec / units.pix, units.arcsec),
        prepared=PreparedPsfs(),
        other_channel=other_channel,
    )
    if psf is None:
        return source(partial(_built_for, threads=threads, parts=False))
    if isinstance(psf, str) and psf == PUBLISHED_OF_IMAGE and not Path(psf).exists():
        return source(lambda header, _: given_psf(published_of(header).name, threads=threads, progress=None))
    instrument = instrument_named(psf)
    if instrument is None:
        own = given_psf(psf, threads=threads, progress=None)
        return source(
            lambda *_: own, key=id(own), kernel_shape=own.kernel.shape, field_terms=len(own.field_terms)
        )
    return source(
        lambda _, progress: given_psf(psf, threads=threads, progress=progress),
        key=instrument.name,
        built=PsfOrigin.of_instrument(instrument),
    )


def _built_for(header: Header, progress: Steps | None, *, threads: int, parts: bool) -> Psf:
    """The PSF of the shipped instrument file that the header names.

    Raises ``DataError`` "no-psf-for-instrument".

    Parameters
    ----------
    parts
        Whether the PSF needs its components.
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


def _clipped(image: Image, *, clip_negative: bool | None, method: str) -> Image:
    """The image; if ``clip_negative`` is true, with pixels below 0 set to 0. Raises ``DataError`` "negative-pixels"."""
    negative = image.valid & (image.pixels < 0)
    if clip_negative is None or not negative.any():
        return image
    if clip_negative:
        return replace(image, pixels=np.where(negative, 0.0, image.pixels))
    if not properties_of(method).may_be_negative:
        raise DataError(
            "negative-pixels",
            "clip_negative=False: expected an image without negative pixels, or a method whose results may be "
            "negative "
            f'("linear", "basic-iterative"); got {np.count_nonzero(negative)} negative pixels and {method!r}: use '
            "clip_negative=True or another method",
        )
    return image


def _header_only(header: Header) -> Image:
    """An image with this header, to compare channels when only the header is known."""
    pixels = np.ones((16, 16))
    return Image(pixels, np.zeros(pixels.shape, np.uint8), header, None, None)
