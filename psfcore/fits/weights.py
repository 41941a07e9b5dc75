"""Check that a file can be a PSF before it is accepted: its header and its weights."""

from __future__ import annotations

import math
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import PRODUCT, HeaderSummary
from psfcore.limited import run_limited


def check_is_psf(path: str | Path, summary: HeaderSummary, limits: FitsLimits) -> None:
    """Raise DataError if a file is not a PSF. The weights are read in a process of its own.

    summary: the summary of the file's header. Codes: "image-as-psf" for a product; "psf-nonfinite", "psf-negative",
    "psf-sum", "psf-not-centred", "psf-off-centre" for weights that no PSF can have; "unreadable-pixels"; and the codes of
    HeaderError.
    """
    if summary.content == PRODUCT:
        raise DataError(
            "image-as-psf",
            "expected a PSF; the header (PSFID) says that the file is a deconvolved image: name the file of a PSF",
        )
    with open(os.devnull, "wb") as unused:
        run_limited(read_weights, path, unused, pixels=math.prod(summary.shape), limits=asdict(limits))


def read_weights(target: BinaryIO, *, path: str, limits: dict[str, int]) -> dict[str, Any]:
    """Read a PSF and check it. Nothing is written to ``target``. Raises the errors of `psfcore.fits.psfs.read_psf`."""
    from psfcore.fits.psfs import read_psf  # loads the numerical libraries

    read_psf(path, FitsLimits(**limits), parts=False)
    return {}
