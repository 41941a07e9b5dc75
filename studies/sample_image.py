"""Make the sample image that the first page of the web site offers, and its pictures before and after deconvolution.

    python -m studies.sample_image

The scene is simulated and convolved with the PSF of HRI_EUV; the file is tile-compressed and small.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from PIL import Image

import heliopsf
from psfcore.build import build_psf
from psfcore.drawing.thumbnail import SOFTENING, TOP_PERCENTILE, euv_levels
from psfcore.instruments.model import load_instrument
from psfcore.simulate.scene import demo_image

SIZE_PX, PSF_PX, SEED = 512, 1024, 4
QUANTIZE = 1  # levels in one standard deviation of the noise; the dither keeps means unbiased
PAGES = Path(__file__).parents[1] / "service" / "pages"
FILE = PAGES / "sample.fits"
BEFORE, AFTER = PAGES / "static" / "sample-before.jpg", PAGES / "static" / "sample-after.jpg"
JPEG_QUALITY = 65


def make(path: Path = FILE) -> None:
    """Write the sample image."""
    psf = build_psf(load_instrument("hri_euv"), size=PSF_PX)
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.fits"
        demo_image(plain, psf, size=SIZE_PX, seed=SEED)
        with fits.open(plain) as hdus:
            packed = fits.CompImageHDU(
                hdus[0].data,
                hdus[0].header,
                compression_type="RICE_1",
                quantize_level=QUANTIZE,
                dither_seed=1,
            )
            packed.writeto(path, overwrite=True)


def draw(path: Path = FILE) -> dict[Path, Image.Image]:
    """The pictures of the sample image before and after its deconvolution, both with the stretch of the first."""
    result = heliopsf.deconvolve(path)
    top = np.percentile(result.image.pixels, TOP_PERCENTILE)
    return {BEFORE: _picture(result.image.pixels, top), AFTER: _picture(result.pixels, top)}


def _picture(pixels: NDArray[np.floating], top: float) -> Image.Image:
    stretched = np.arcsinh(np.clip(pixels / top, 0, 1) / SOFTENING) / np.arcsinh(1 / SOFTENING)
    palette = euv_levels()
    return Image.fromarray(palette[np.round(stretched * (len(palette) - 1)).astype(np.intp)][::-1])


if __name__ == "__main__":
    make()
    for place, drawn in draw().items():
        drawn.save(place, quality=JPEG_QUALITY)
