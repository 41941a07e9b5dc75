"""What several tests of the physics share: real data where it is there, small PSFs, small images."""

from __future__ import annotations

import multiprocessing
import os
import pickle
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.build import build_psf
from psfcore.fits.blocks import FitsLimits
from psfcore.image import Image, MaskBit
from psfcore.instruments.model import load_instrument
from psfcore.psf import Psf, crop_centred
from tests.once_a_run import once_a_run

LIMITS = FitsLimits(max_pixels=4096 * 4096)


@pytest.fixture(scope="session")
def real() -> Callable[[str], Path]:
    """Path of a real data file; skips the test where it is not at hand."""
    shared = Path(os.environ.get("HELIOPSF_SHARED", Path(__file__).parents[3] / "shared"))

    def find(name: str) -> Path:
        path = shared / "data" / "real" / name
        if not path.exists():
            pytest.skip(f"real data not at hand: {path} (set HELIOPSF_SHARED)")
        return path

    return find


@pytest.fixture(scope="session")
def hri_psf(tmp_path_factory: pytest.TempPathFactory) -> Psf:
    """The PSF of HRI_EUV in full, with its components.

    A process of its own builds it, which takes 1 GiB of memory; here its arrays are mapped from files.
    """
    folder = once_a_run(lambda: _built_hri(tmp_path_factory.mktemp("hri_psf")), "hri_psf", tmp_path_factory)
    small: Psf = pickle.loads((folder / "without_arrays").read_bytes())
    kernels = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in small.provenance["arrays"]}
    return replace(small, kernel=kernels.pop("TOTAL"), components=kernels)


def _built_hri(folder: Path) -> Path:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        pool.submit(save_hri_psf, folder).result()
    return folder


def save_hri_psf(folder: Path) -> None:
    """Build the PSF of HRI_EUV, and write each of its arrays into a file."""
    psf = build_psf(load_instrument("hri_euv"), threads=2)
    arrays = {"TOTAL": psf.kernel, **psf.components}
    for name, kernel in arrays.items():
        np.save(folder / f"{name}.npy", kernel)
    small = crop_centred(psf.kernel, (64, 64))
    psf = replace(psf, kernel=small, components={}, provenance={**psf.provenance, "arrays": list(arrays)})
    (folder / "without_arrays").write_bytes(pickle.dumps(psf))


def gaussian(size: int, sigma_px: float) -> NDArray[np.float64]:
    r = np.arange(size) - size // 2
    line = np.exp(-(r**2) / (2 * sigma_px**2))
    kernel = np.outer(line, line)
    return kernel / kernel.sum()


def delta(size: int) -> NDArray[np.float64]:
    kernel = np.zeros((size, size))
    kernel[size // 2, size // 2] = 1.0
    return kernel


def make_psf(kernel: NDArray[np.float64], **changes: object) -> Psf:
    known: dict[str, object] = {"name": "t", "version": "1", "instrument": None, "status": "user"}
    return Psf(kernel=kernel, **(known | changes))  # type: ignore[arg-type]


def make_image(pixels: NDArray[np.float64], mask: NDArray[np.uint8] | None = None) -> Image:
    found = np.where(np.isfinite(pixels), 0, int(MaskBit.NONFINITE)).astype(np.uint8)
    return Image(pixels, found if mask is None else mask, fits.Header(), "DN/s", 1.0)
