"""Products that the tests of the viewer look at: made by the service itself, from simulated images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from service.client.http import Client
from tests.conftest import write_psf

# A rotated field beside the centre of the Sun, as instruments write it.
COORDINATES = {
    **{"CTYPE1": "HPLN-TAN", "CTYPE2": "HPLT-TAN", "CUNIT1": "arcsec", "CUNIT2": "arcsec", "CROTA2": 12.5},
    **{"CRPIX1": 120.25, "CRPIX2": 80.5, "CRVAL1": -412.3, "CRVAL2": 655.1, "CDELT1": 4.4, "CDELT2": 4.5},
}


@dataclass(frozen=True)
class Looked:
    """A product: its id, that of its image, and the pixels [y, x] of both files."""

    id: str
    image_id: str
    before: NDArray[np.float32]
    after: NDArray[np.float32]
    file: Path

    @property
    def page(self) -> str:
        """Address of its page."""
        return f"/products/{self.id}"


def write_sun(path: Path, shape: tuple[int, int], *, nan: bool = True, **cards: Any) -> None:
    """An image in DN/s with a bright loop, noise, and a patch without values."""
    rng = np.random.default_rng(11)
    y, x = np.indices(shape)
    loop = np.exp(-0.5 * ((np.hypot(x - shape[1] / 2, y - shape[0] / 3) - shape[0] / 4) / 3) ** 2)
    pixels = rng.poisson(4 * (30 + 2000 * loop)).astype("f4") / 4
    if nan:
        pixels[20:26, 30:41] = np.nan
    header = fits.Header({"TELESCOP": "TEST", "BUNIT": "DN/s", "XPOSURE": 2.0, **cards})
    fits.PrimaryHDU(pixels, header).writeto(path, overwrite=True)


def made(
    client: Client, folder: Path, shape: tuple[int, int], *, errors: bool = False, **image: Any
) -> Looked:
    """Deconvolve a simulated image with the service."""
    write_sun(folder / "sun.fits", shape, **image)
    write_psf(folder / "psf.fits")
    psf_id = client.upload_psf(folder / "psf.fits")["id"]
    output = folder / "product.fits"
    noise: dict[str, Any] = {"noise": (4.0, 1.0), "error_draws": 4} if errors else {}
    product = client.deconvolve(folder / "sun.fits", output, psf_id=psf_id, steps=5, overwrite=True, **noise)
    return Looked(
        product["id"],
        product["image_id"],
        np.asarray(fits.getdata(folder / "sun.fits"), dtype=np.float32),
        np.asarray(fits.getdata(output), dtype=np.float32),
        output,
    )
