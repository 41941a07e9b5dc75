"""A small PSF with diffraction arms and scatter, and images of a flare with a saturated core made with it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.fits.psfs import write_psf
from psfcore.noise import Noise
from psfcore.psf import Psf, crop_centred
from psfcore.scatter.power_law import scatter_kernel

SIZE = 192
KERNEL = 255
CENTRE = (92, 101)  # x, y
SPACING_PX = 6
LIGHT = 1e8
QUIET = 500.0
SATURATION = 1.5e4
NOISE = Noise(photon_gain_dn=6.0, read_noise_dn=2.0)

Plane = NDArray[np.float64]


@cache
def flare_psf(c: float = 2.53) -> Psf:
    """A PSF with orders 6 px apart on both axes, and a power law of exponent c."""
    orders = np.zeros((KERNEL, KERNEL))
    middle = KERNEL // 2
    for k in range(1, 20):
        for dy, dx in ((0, k), (0, -k), (k, 0), (-k, 0)):
            orders[middle + dy * SPACING_PX, middle + dx * SPACING_PX] = 0.03 / k**1.6
    orders[middle, middle] = 1 - orders.sum()
    r = np.arange(-4, 5)
    blur = np.exp(-0.5 * (r / 0.8) ** 2)
    diffraction = linear_convolve(orders, np.outer(blur, blur) / blur.sum() ** 2, (KERNEL, KERNEL))
    scatter = crop_centred(scatter_kernel(6.15, c, 0.41, 2048), (KERNEL, KERNEL))
    total = linear_convolve(diffraction, scatter, (KERNEL, KERNEL))
    return Psf(
        kernel=np.maximum(total, 0),
        name="small",
        version="1",
        instrument=None,
        status="user",
        components={"DIFFRACTION": np.maximum(diffraction, 0), "SCATTER": scatter},
    )


def flare_light(seed: int, light: float = LIGHT) -> Plane:
    """The scene of a flare: uneven light on 5 x 5 px."""
    out = np.zeros((SIZE, SIZE))
    uneven = np.random.default_rng(seed).gamma(0.7, 1.0, (5, 5))
    uneven[2, 2] += 8
    x, y = CENTRE
    out[y - 2 : y + 3, x - 2 : x + 3] = light * uneven / uneven.sum()
    return out


def quiet_sun() -> Plane:
    y, x = np.indices((SIZE, SIZE))
    return np.asarray(QUIET * (1 + 0.3 * np.sin(x / 17) * np.cos(y / 23)))


def observed(scene: Plane, seed: int | None) -> Plane:
    """The scene convolved with the PSF; with noise unless seed is None."""
    clean = np.maximum(Convolver(flare_psf().kernel, (SIZE, SIZE), dtype=np.float64).apply(scene), 0)
    return clean if seed is None else NOISE.observe(clean, 1.0, np.random.default_rng(seed))


def pair(seed: int) -> tuple[Plane, Plane]:
    """The image of the flare, clipped at saturation, and the image before."""
    flaring = observed(quiet_sun() + flare_light(seed), 100 + seed)
    return np.minimum(flaring, SATURATION), observed(quiet_sun(), 200 + seed)


def write_flare(folder: Path, seed: int = 0) -> dict[str, Path]:
    """Write the files flare, before and psf into the folder; return their paths."""
    paths = {name: folder / f"{name}.fits" for name in ("flare", "before", "psf")}
    header = fits.Header({"BUNIT": "DN", "XPOSURE": 1.0})
    for name, pixels in zip(("flare", "before"), pair(seed), strict=True):
        fits.PrimaryHDU(pixels.astype("f4"), header).writeto(paths[name])
    write_psf(paths["psf"], flare_psf())
    return paths
