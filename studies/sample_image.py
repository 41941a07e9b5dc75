"""Make the sample image that the first page of the web site offers.

    python -m studies.sample_image

The scene is simulated and convolved with the PSF of HRI_EUV; the file is tile-compressed and small.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from astropy.io import fits

from psfcore.build import build_psf
from psfcore.instruments.model import load_instrument
from psfcore.simulate.scene import demo_image

SIZE_PX, PSF_PX, SEED = 512, 1024, 4
QUANTIZE = 1  # levels in one standard deviation of the noise; the dither keeps means unbiased
FILE = Path(__file__).parents[1] / "service" / "pages" / "sample.fits"


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


if __name__ == "__main__":
    make()
