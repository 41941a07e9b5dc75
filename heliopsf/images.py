"""Deconvolve images in this process, and find their PSFs."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast, overload

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from heliopsf.inputs import header_of, image_of, is_many, shape_of
from heliopsf.outputs import Deconvolution, in_form_of
from heliopsf.progress import Told, told
from heliopsf.psfs import Psf, built_psf, read_psf
from heliopsf.regions import box_of, cut
from psfcore.deconvolve.box import EXPECTED_RIM_PX, LARGEST_ERROR, Box, region_without_errors
from psfcore.deconvolve.conditions import Conditions, EngineCache
from psfcore.deconvolve.edges import Edges
from psfcore.deconvolve.kernels import compiling_beside
from psfcore.deconvolve.memory import Asked, check_memory, deconvolution_bytes
from psfcore.deconvolve.methods.registry import may_be_negative
from psfcore.deconvolve.region import BoxWork, box_work
from psfcore.deconvolve.result import Deconvolved
from psfcore.deconvolve.whole import Work, input_warnings, known_noise
from psfcore.errors import DataError, DataWarning
from psfcore.fits.frame import frame_of
from psfcore.fits.header import seen_by
from psfcore.fits.observation import check_exposure_of_sun
from psfcore.image import Image
from psfcore.instruments.unknown import unknown_instrument
from psfcore.noise import Noise
from psfcore.psf import REACH_GRID_PX
from psfcore.psf import Psf as CorePsf
from psfcore.psf_sampling import psf_for_image, with_scale
from psfcore.scatter.total_psf import possible_psfs
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
    options: dict[str, Any] = {
        "iterations": iterations,
        "clip_negative": clip_negative,
        "method": method,
        "noise": noise,
        "error_draws": error_draws,
        "saturation_dn": saturation_dn,
        "hdu": hdu,
        "plate_scale_arcsec": plate_scale_arcsec,
        "edges": edges,
        "region_error": region_error,
        "other_channel": other_channel,
        "again": again,
        "threads": threads or cores(),
        "progress": progress,
        "parameters": parameters,
    }
    options["engines"] = EngineCache()
    if not is_many(smap):
        return _in_form(smap, psf, region, full, options)
    images = list(smap)
    given = None if psf is None else _given(psf)
    results = []
    for number, image in enumerate(images, start=1):
        try:
            results.append(_in_form(image, given, region, full, options))
        except DataError as error:
            told_which = f"image {number} of {len(images)}: {error.message}"
            raise type(error)(error.code, told_which, error.fields) from error
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
    psf = _built_for(header, threads or cores(), progress, parts=True)
    for code, message in input_warnings(psf, _header_only(header), None, other_channel=False).items():
        warnings.warn(DataWarning(code, message), stacklevel=2)
    return _on_pixels(psf, header)


def _in_form(image: Any, psf: AnyPsf | None, region: Any, full: bool, options: dict[str, Any]) -> Any:
    """The deconvolved image or region, in the form of the image or as a ``Deconvolution``."""
    box = None if region is None else box_of(region, image)
    result = _deconvolved(image, psf, box=box, **options)
    if full:
        return result
    return in_form_of(image if box is None else cut(image, box), result)


def _deconvolved(
    image: Any,
    psf: AnyPsf | None,
    *,
    box: Box | None,
    region_error: float,
    iterations: int | None,
    clip_negative: bool | None,
    method: str,
    noise: tuple[float, float] | None,
    error_draws: int,
    saturation_dn: float | None,
    hdu: int | None,
    plate_scale_arcsec: float | None,
    edges: Edges | None,
    other_channel: bool,
    again: bool,
    threads: int,
    progress: Told,
    engines: EngineCache,
    parameters: Mapping[str, Any],
) -> Deconvolution:
    if box is not None and error_draws:
        raise region_without_errors(error_draws)
    given = None if psf is None else cast(Psf, with_scale(_given(psf), plate_scale_arcsec))
    shape = shape_of(image, hdu)
    asked = Asked(
        method,
        shape if box is None else box.wider(EXPECTED_RIM_PX, shape).shape,
        (REACH_GRID_PX, REACH_GRID_PX) if given is None else (given.kernel.shape[0], given.kernel.shape[1]),
        edges=edges,
        draws=error_draws,
    )
    check_memory(asked.image, deconvolution_bytes(asked), free_bytes())
    observed = image_of(image, saturation_dn=saturation_dn, hdu=hdu)
    if not again:
        check_exposure_of_sun(observed.header)
    if given is None:
        with compiling_beside(method, (observed.pixels.shape[0], observed.pixels.shape[1])):
            found = _built_for(observed.header, threads, progress, parts=False)
    else:
        found = given
    said = input_warnings(found, observed, method, other_channel=other_channel)
    for code, message in said.items():
        warnings.warn(DataWarning(code, message), stacklevel=3)
    fitted = _on_pixels(found, observed.header)
    known = found.instrument if psf is None else None
    whole = Work(
        _clipped(observed, clip_negative, method),
        fitted,
        method,
        Conditions(
            edges=edges,
            noise=known_noise(known, observed.header) if noise is None else Noise(*noise),
            threads=threads,
            engine_for=engines,
        ),
        _with_steps(parameters, iterations),
    )
    work: Work | BoxWork = whole
    if box is not None:
        work = box_work(whole, box, largest_error=region_error)
        # The width of the rim is known only now.
        asked = replace(asked, image=work.rim.shape)
        check_memory(asked.image, deconvolution_bytes(asked), free_bytes())
        observed = work.image
    result = work.run(progress=told(progress, "deconvolving"))
    _check_draws(error_draws)
    errors = work.errors(
        result,
        error_draws,
        possible_psfs=lambda: _possible(found, observed.header, threads),
        begin=lambda stage, _: told(progress is True, stage),
    )
    return Deconvolution(
        **{one.name: getattr(result, one.name) for one in fields(Deconvolved)},
        image=observed,
        psf=fitted,
        errors=errors,
        warnings=said,
        work=work,
    )


def _built_for(header: Header, threads: int, progress: Told, *, parts: bool) -> Psf:
    """The PSF of the shipped instrument file that the header names. parts: whether it needs its components.

    Raises ``DataError`` "no-psf-for-instrument".
    """
    summary = seen_by(header)
    if summary["instrument"] is None:
        raise unknown_instrument(summary)
    turn_deg = frame_of(header).turn_to_build_deg
    return built_psf(
        summary["instrument"], turn_deg=turn_deg, parts=parts, threads=threads, progress=progress is True
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


def _on_pixels(psf: Psf, header: Header) -> Psf:
    return cast(Psf, psf_for_image(psf, header))  # a changed copy has the class of the original


def _possible(psf: Psf, header: Header, threads: int) -> list[CorePsf]:
    if psf.fitted is None:
        return []
    return [psf_for_image(one, header) for one in possible_psfs(psf, threads=threads)]


def _clipped(image: Image, clip_negative: bool | None, method: str) -> Image:
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


def _check_draws(draws: int) -> None:
    if draws and not 2 <= draws <= 64:
        raise DataError("bad-draws", f"error_draws: expected 0, or 2 to 64; got {draws}")


def _header_only(header: Header) -> Image:
    """An image with this header, to compare channels when only the header is known."""
    pixels = np.ones((16, 16))
    return Image(pixels, np.zeros(pixels.shape, np.uint8), header, None, None)
