"""Real occultations by Venus: deconvolution with scatter removes light from the dark disc and does not change the ring.

The disc should be dark; its light is scattered light, or noise. No PSF of XRT or of AIA's 1600 A channel is available
here. An assumed PSF is used: only the softened power law, with several totals. A published deconvolution of the XRT image,
with its own PSF, is the comparison.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named
from psfcore.fits.observation import read_observation
from psfcore.image import Image
from psfcore.scatter.power_law import scatter_kernel
from studies.venus_gap import explained, read
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


def test_without_long_range_scatter_the_gap_is_a_constant_plus_a_share_of_the_ring(shared: Path) -> None:
    core, terms = read(shared)
    level = explained(core, terms, ["level"])
    both = explained(core, terms, ["level", "ring"])
    weight, sigma = both.weights["ring"]
    assert weight > 4 * sigma and both.held_out_rms < level.held_out_rms
    # A constant and a share of the full disk, whose light hardly changes, cannot be told apart.
    other = explained(core, terms, ["full disk", "ring"])
    assert abs(other.bic - both.bic) < 6
    # Two ways of taking images differ by more than their light does: no scatter does that.
    weight, sigma = explained(core, terms, ["level", "ring", "kind of image"]).weights["kind of image"]
    assert weight > 3 * sigma and weight / core.mean() > 0.15
