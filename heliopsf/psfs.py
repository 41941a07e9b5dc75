"""Build and read PSFs in this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from psfcore import build
from psfcore.fits import psfs
from psfcore.fits.header import FitsLimits
from psfcore.fits.mask_file import read_mask_image
from psfcore.instruments.model import load_instrument
from psfcore.psf import Psf

LIMITS = FitsLimits(max_pixels=2**26)


def build_psf(
    instrument: str | Path,
    *,
    size: int = 2048,
    component: str | None = None,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Psf:
    """Compute the PSF of an instrument: a ``kernel`` [y, x] of (size, size) px, and its ``components``.

    instrument: the name of a known instrument, such as "hri_euv", or the path of an instrument file (TOML). If the file
    names a mask image of the mount, that image is read too.
    size: an even number from 64 to 4096 (px).
    component: compute only this component, such as "DIFFRACTION".
    progress(step, steps) is called after each step.

    Raises ``DataError`` "bad-size", "unknown-component" or "bad-mount", and the errors of
    ``psfcore.instruments.model.load_instrument``.
    """
    known = load_instrument(instrument)
    mask = None
    if known.mount is not None and known.mount.mask_image is not None:
        mask = read_mask_image(Path(instrument).parent / known.mount.mask_image.file)
    return build.build_psf(
        known, size=size, component=component, mount_image=mask, threads=threads, progress=progress
    )


def read_psf(path: str | Path) -> Psf:
    """Read a PSF from a FITS file: its ``kernel`` [y, x] and its ``components``, if it has any.

    The weights of the kernel sum to 1 over the reach, and to less on a smaller array.
    Raises ``DataError``, for example "not-fits".
    """
    return psfs.read_psf(path, LIMITS)
