"""Real occultations by Venus: deconvolution with scatter removes light from the dark disc and does not change the ring.

The disc should be dark; its light is scattered light, or noise. No PSF of XRT or of AIA's 1600 A channel is available
here. An assumed PSF is used: only the softened power law, with several totals. A published deconvolution of the XRT
image, with its own PSF, is the comparison.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psfcore.convolution.convolver import linear_convolve
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named
from psfcore.fits.observation import read_observation
from psfcore.image import Image
from psfcore.scatter.power_law import scatter_kernel
from tests.psfcore.conftest import LIMITS, make_psf

# file, centre x, y and radius of the disc in pixels
DISCS = {
    "XRT": ("L1_XRT20120605_215839.9.fits", 84.5, 203.5, 28.5),
    "AIA 1600": ("AIA1600_venus_20120606_040731_UTC.0041.fits", 374.0, 219.0, 48.0),
}
TOTALS = (0.05, 0.10, 0.30)


def core_and_ring(image: Image, x: float, y: float, radius: float) -> tuple[float, float]:
    """The means of the inner half of the disc and of the ring from 1.2 to 1.6 radii."""
    yy, xx = np.indices(image.pixels.shape)
    r = np.hypot(xx - x, yy - y) / radius
    core, ring = image.pixels[r < 0.5], image.pixels[(r > 1.2) & (r < 1.6)]
    return float(np.nanmean(core)), float(np.nanmean(ring))


def test_deconvolution_removes_scatter_from_the_disc_of_venus(shared: Path) -> None:
    folder = shared / "data/real/occultation"
    for name, (file, *disc) in DISCS.items():
        image = read_observation(folder / file, LIMITS)
        rows = [core_and_ring(image, *disc)]
        for total in TOTALS:
            psf = make_psf(scatter_kernel(3.0, 2.5, total, 2048))
            done = method_named("richardson-lucy")(image, psf, Conditions(threads=2), steps=20)
            rows.append(core_and_ring(done, *disc))
        cores = [core for core, _ in rows]
        assert cores == sorted(cores, reverse=True) and cores[-1] >= 0
        assert rows[2][1] == pytest.approx(rows[0][1], rel=0.02)
        if name == "XRT":
            # The peer's own deconvolution takes as much out as five percent of scatter would.
            peer, _ = core_and_ring(
                read_observation(folder / "L1_XRT20120605_215839.9.deconv.fits", LIMITS), *disc
            )
            assert cores[2] < peer < cores[0]


def test_the_scatter_fitted_to_the_disc_in_xrt_leaves_what_the_fit_calls_no_scatter(shared: Path) -> None:
    """The light in the disc is a share of the scattered light of its surroundings, and a constant. Deconvolution with
    this share takes out more than the peer's PSF, which is not fitted to this image."""
    file, x, y, radius = DISCS["XRT"]
    image = read_observation(shared / "data/real/occultation" / file, LIMITS)
    yy, xx = np.indices(image.pixels.shape)
    distance = np.hypot(xx - x, yy - y)
    around, half = np.where(distance < radius, 0.0, image.pixels), scatter_kernel(3.0, 2.5, 0.5, 2048)
    half[1024, 1024] = 0.0
    scattered = linear_convolve(around, half / 0.5, image.pixels.shape)
    inside = distance < 0.8 * radius
    terms = np.column_stack((scattered[inside], np.ones(inside.sum())))
    (total, constant), *_ = np.linalg.lstsq(terms, image.pixels[inside])
    psf = make_psf(scatter_kernel(3.0, 2.5, total, 2048))
    done = method_named("richardson-lucy")(image, psf, Conditions(threads=2), steps=20)
    core, ring = core_and_ring(done, x, y, radius)
    before, ring_before = core_and_ring(image, x, y, radius)
    assert (before, total) == (pytest.approx(5.72, abs=0.01), pytest.approx(0.29, abs=0.02))
    assert core == pytest.approx(constant, rel=0.1) and core < 5.44 < before
    assert ring == pytest.approx(ring_before, rel=0.02)
