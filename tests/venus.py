"""`python -m tests.venus`: real occultations by Venus: the light in the dark disc over that in the ring around it.

The disc should be dark; its light is scattered light, or noise. Deconvolution with a PSF that contains the scatter of the
telescope removes light from the disc; the amount shows how complete the PSF is. No PSF of XRT or of AIA's 1600 A channel
is available here. An assumed PSF is used: only the softened power law, with the totals of the scan below. A published
deconvolution of the XRT image, with its own PSF, is listed for comparison.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named
from psfcore.fits.header import FitsLimits
from psfcore.fits.images import read_image
from psfcore.psf import Psf
from psfcore.scatter.power_law import scatter_kernel

FOLDER = "data/real/occultation"
# file, centre x, y and radius of the disc in pixels
DISCS = {
    "XRT": ("L1_XRT20120605_215839.9.fits", 84.5, 203.5, 28.5),
    "AIA 1600": ("AIA1600_venus_20120606_040731_UTC.0041.fits", 374.0, 219.0, 48.0),
}
PEER = "L1_XRT20120605_215839.9.deconv.fits"
B_PX, C = 3.0, 2.5
TOTALS = (0.05, 0.10, 0.20, 0.30)


def core_and_annulus(pixels: NDArray[np.float64], x: float, y: float, radius: float) -> tuple[float, float]:
    """The means of the inner half of the disc and of the ring from 1.2 to 1.6 radii."""
    yy, xx = np.indices(pixels.shape)
    r = np.hypot(xx - x, yy - y) / radius
    core, ring = pixels[r < 0.5], pixels[(r > 1.2) & (r < 1.6)]
    return float(np.nanmean(core)), float(np.nanmean(ring))


def stated_psf(total: float) -> Psf:
    """A PSF that is only the softened power law."""
    kernel = scatter_kernel(B_PX, C, total, 2048)
    return Psf(kernel, f"power law b={B_PX} c={C} total={total}", "0", None, "draft", None, None)


def table(shared: Path) -> list[tuple[str, str, float, float]]:
    """(image, processing, core, ring) for each image and each total."""
    rows = []
    limits = FitsLimits(max_pixels=2**24)
    for name, (file, x, y, radius) in DISCS.items():
        image = read_image(shared / FOLDER / file, limits)
        rows.append((name, "as observed", *core_and_annulus(image.pixels, x, y, radius)))
        for total in TOTALS:
            done = method_named("richardson-lucy")(image, stated_psf(total), Conditions(threads=2), steps=20)
            rows.append(
                (name, f"scatter of {100 * total:.0f} %", *core_and_annulus(done.pixels, x, y, radius))
            )
        if name == "XRT":
            peer = read_image(shared / FOLDER / PEER, limits)
            rows.append((name, "published deconvolution", *core_and_annulus(peer.pixels, x, y, radius)))
    return rows


if __name__ == "__main__":
    shared = Path(os.environ.get("HELIOPSF_SHARED", Path(__file__).parents[2] / "shared"))
    print(f"power law a / (b + r)^c with b = {B_PX} px, c = {C}; Richardson-Lucy, 20 steps")
    for name, what, core, ring in table(shared):
        print(f"{name:<10} {what:<26} core {core:9.3f}  ring {ring:9.3f}  core/ring {core / ring:.4f}")
