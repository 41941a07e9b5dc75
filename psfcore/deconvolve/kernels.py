"""Compile the kernels of a deconvolution in a process of its own, while this process builds the PSF.

On a new installation both take long. numba compiles in one thread at a time and keeps the interpreter busy, so a thread
would not help. The process finds out which kernels are needed by deconvolving a small image, and compiles the passes of
the transforms for the shape of the real image; `psfcore.kernel_files` keeps all of them on disk.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from astropy.io.fits import Header

from psfcore.compiled import is_kept
from psfcore.convolution import kernels
from psfcore.convolution.fft_kernels import make_plan
from psfcore.convolution.lengths import LARGEST_LENGTH, good_length
from psfcore.deconvolve.assess.changes import measure_changes
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named
from psfcore.image import Image
from psfcore.kernel_files import folder_of_kernels
from psfcore.psf import REACH_GRID_PX, Psf
from psfcore.psf_field import FieldTerm, Place

SIZE_PX = 32


@contextmanager
def compiling_beside(method: str, shape: tuple[int, int]) -> Iterator[None]:
    """In the block, another process compiles the kernels of a method, if they are not kept on disk yet, but can be.

    The block ends when the process has ended. If the process fails, this process compiles the kernels later.

    Parameters
    ----------
    shape
        Shape (ny, nx) of the image.
    """
    if is_kept(kernels.rows_forward) or not folder_of_kernels()[1]:
        yield
        return
    quiet = subprocess.DEVNULL
    command = [sys.executable, "-m", __name__, method, *map(str, shape)]
    process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)
    try:
        yield
        process.wait()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def compile_kernels(method: str, shape: tuple[int, int], *, changing: bool = False) -> None:
    """Compile the kernels that a method needs for an image of this shape, if they are not kept on disk.

    The margin of the image, and so the length of its transforms, depends on the PSF, which does not exist yet. The
    usual length is taken; if another one is needed, at most two passes are compiled later.

    Parameters
    ----------
    changing
        Whether the PSF changes over the field, which needs further kernels.
    """
    weights = np.ones((SIZE_PX, SIZE_PX))
    weights[SIZE_PX // 2, SIZE_PX // 2] = SIZE_PX**2
    weights /= weights.sum()
    term = np.zeros_like(weights)
    term[0, 0], term[-1, -1] = weights[0, 0] / 2, -weights[0, 0] / 2
    psf = Psf(
        kernel=weights,
        name="small",
        version="0",
        instrument=None,
        status="user",
        field_terms=(FieldTerm(term, 1, 0),) if changing else (),
        place=Place.of_detector(SIZE_PX, SIZE_PX) if changing else None,
    )
    pixels = np.full((SIZE_PX, SIZE_PX), 100.0)
    image = Image(pixels, np.zeros(pixels.shape, np.uint8), Header(), "DN/s", 1.0)
    measure_changes(image, method_named(method)(image, psf, Conditions(), steps=2).pixels, psf)
    for size in set(shape):
        make_plan(good_length(min(size + min(size, REACH_GRID_PX // 2), LARGEST_LENGTH)))


if __name__ == "__main__":
    compile_kernels(sys.argv[1], (int(sys.argv[2]), int(sys.argv[3])))
