"""Real occultations by Venus: deconvolution with scatter removes light from the dark disc and does not change the ring.

The disc should be dark; its light is scattered light, or noise. No PSF of XRT or of AIA's 1600 A channel is available
here. An assumed PSF is used: only the softened power law, with several totals. A published deconvolution of the XRT image,
with its own PSF, is the comparison.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

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
    """The light in the disc is a share of the scattered light of its surroundings, and a constant. Deconvolution with this share
    takes out more than the peer's PSF, which is not fitted to this image."""
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


Vector = NDArray[np.float64]


def epochs_of_aia(shared: Path) -> tuple[Vector, dict[str, Vector]]:
    """The light that remains in the disc (DN) at 32 epochs in AIA 193, deconvolved with the standard PSF, which has no long-range
    scatter; and terms that may explain it, scaled to a mean (or a step) of 1."""
    with (shared / "data/real/occultation/aia193_venus_residuals.csv").open() as lines:
        rows = list(csv.DictReader(lines))
    column = {name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name != "time"}
    order = np.linspace(-0.5, 0.5, len(rows))
    ring, disk = column["annulus_DN_after_std_psf"], column["fulldisk_DN"]
    # About every other image has 5 % more light over the whole disk: there are two kinds of images.
    brighter = (disk > np.polyval(np.polyfit(order, disk, 1), order)).astype(float)
    return column["core_DN_after_std_psf"], {
        "level": np.ones(len(rows)),
        "ring": ring / ring.mean(),
        "full disk": disk / disk.mean(),
        "kind of image": brighter - brighter.mean(),
    }


def explained(
    core: Vector, terms: dict[str, Vector], chosen: Sequence[str]
) -> tuple[dict[str, tuple[float, float]], float, float]:
    """Fit core = sum over terms of weight x term by least squares: the weight of each term with its error (DN), the rms error of
    held-out epochs (DN), and BIC = n ln(rss / n) + k ln n."""
    design = np.array([terms[name] for name in chosen]).T
    inverse = np.linalg.inv(design.T @ design)
    weights = inverse @ design.T @ core
    left, (n, k) = core - design @ weights, design.shape
    sigma = np.sqrt(np.diag(inverse) * float(left @ left) / (n - k))
    lever = np.einsum("ni,ij,nj->n", design, inverse, design)
    fitted = {name: (float(w), float(s)) for name, w, s in zip(chosen, weights, sigma, strict=True)}
    bic = float(n * np.log(left @ left / n) + k * np.log(n))
    return fitted, float(np.sqrt(np.mean((left / (1 - lever)) ** 2))), bic


def test_without_long_range_scatter_the_gap_is_a_constant_plus_a_share_of_the_ring(shared: Path) -> None:
    core, terms = epochs_of_aia(shared)
    _, level_rms, _ = explained(core, terms, ["level"])
    weights, both_rms, both_bic = explained(core, terms, ["level", "ring"])
    weight, sigma = weights["ring"]
    assert weight > 4 * sigma and both_rms < level_rms
    # A constant and a share of the full disk, whose light hardly changes, cannot be told apart.
    _, _, other_bic = explained(core, terms, ["full disk", "ring"])
    assert abs(other_bic - both_bic) < 6
    # Two ways of taking images differ by more than their light does: no scatter does that.
    weights, _, _ = explained(core, terms, ["level", "ring", "kind of image"])
    weight, sigma = weights["kind of image"]
    assert weight > 3 * sigma and weight / core.mean() > 0.15
