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
    """Compute the PSF of an instrument: its ``kernel`` [y, x] on (size, size) px, with its ``components``.

    instrument: the name of a known one, such as "hri_euv", or the path of an instrument file (TOML); the mask image that the
    file names is read too. size: even, 64 to 4096 px. component: one component alone, such as "DIFFRACTION".
    progress(step, steps) is called after each step.

    Raises ``DataError`` "bad-size", "unknown-component", and as ``psfcore.instruments.model.load_instrument``.
    """
    known = load_instrument(instrument)
    mask = None
    if known.mount is not None and known.mount.mask_image is not None:
        mask = read_mask_image(Path(instrument).parent / known.mount.mask_image.file)
    return build.build_psf(
        known, size=size, component=component, mount_image=mask, threads=threads, progress=progress
    )


def read_psf(path: str | Path) -> Psf:
    """Read a PSF from a FITS file: its ``kernel`` [y, x] (weights, sum at most 1) and its ``components``, if any.

    Raises ``DataError``, such as "not-fits".
    """
    return psfs.read_psf(path, LIMITS)
