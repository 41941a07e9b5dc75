"""Deconvolve an image in this process."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from heliopsf.psfs import LIMITS, read_psf
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.edges import Edges
from psfcore.deconvolve.methods.registry import method_named
from psfcore.deconvolve.result import Deconvolved
from psfcore.fits.channel import check_channel
from psfcore.fits.header import check_not_deconvolved, content_of
from psfcore.fits.observation import read_observation
from psfcore.image import Image
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.psf_sampling import psf_for_image


def deconvolve(
    image: str | Path | Image,
    psf: str | Path | Psf,
    *,
    method: str = "richardson-lucy",
    noise: tuple[float, float] | None = None,
    saturation_dn: float | None = None,
    edges: Edges | None = None,
    other_channel: bool = False,
    again: bool = False,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    **parameters: Any,
) -> Deconvolved:
    """Deconvolve an image with a PSF. The result's ``pixels`` [y, x] have the shape and the unit of the image.

    image: a FITS file, or an ``Image`` (pixels [y, x] with their unit, and a mask).
    psf: a FITS file, or a ``Psf``. The PSF is rebinned if the image is binned.
    noise: photon gain (DN per photon) and read noise (DN rms).
    saturation_dn: pixels at or above this level (DN) are ignored; default: the level that the header or the instrument
    file gives, or that the pixels show. The level is used only if ``image`` is a file.
    edges: "zero", "symmetric" or "extended"; default: the assumption that suits the method best.
    other_channel: whether the PSF may be of another telescope, channel or filter than the image.
    again: deconvolve the image even if its header says that it is a product or a PSF.
    progress(step, steps) is called after each step.
    parameters: parameters of the method, such as ``steps=20``.

    Raises ``DataError``; its ``code`` is the reason, such as "not-fits", "already-deconvolved", "plate-scale-mismatch",
    "channel-mismatch" or "unknown-method". Gives a ``UserWarning`` if saturated pixels may be missed, or if the channels
    cannot be compared.
    """
    if not isinstance(image, Image):
        image = read_observation(image, LIMITS, saturation_dn=saturation_dn)
    if not again:
        check_not_deconvolved(content_of(image.header))
    if not isinstance(psf, Psf):
        psf = read_psf(psf)
    said = [check_channel(psf, image.header, other_channel=other_channel)]
    said += [None if image.saturation is None else image.saturation.warning]
    for warning in said:
        if warning is not None:
            warnings.warn(warning, stacklevel=2)
    conditions = Conditions(
        edges=edges,
        noise=None if noise is None else Noise(*noise),
        threads=threads,
        progress=progress,
    )
    return method_named(method)(image, psf_for_image(psf, image.header), conditions, **parameters)
