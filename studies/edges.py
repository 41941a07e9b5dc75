"""`python -m studies.edges`: errors of a deconvolved field along its edges, by method and treatment of edges.

A scene of 2048 px is convolved with a PSF, noise is added, and the whole image is deconvolved. The middle of the result
is the reference without edges. The same pixels of the image are cut out and deconvolved alone. Both results are
compared in bands along the edges of the cut-out:

    bias = sum(x) / sum(x_ref) - 1,    deviation = sum(abs(x - x_ref)) / sum(x_ref),    in percent     Eq. (1)

The bias is the relative error of the mean of a band. The deviation is the mean relative error of the pixels of the
band.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.convolution.convolver import linear_convolve
from psfcore.deconvolve.conditions import Conditions, EngineFor, PreparedPsfs
from psfcore.deconvolve.edges import EDGES
from psfcore.deconvolve.methods.registry import method_named, method_names
from psfcore.image import Image
from psfcore.psf import Psf
from psfcore.scatter.power_law import scatter_kernel
from psfcore.simulate.scene import observe, solar_scene

FIELD_PX = 1024
SCENE_PX = 2048
BANDS_PX = ((0, 2), (2, 20), (20, 64))
CORE_SIGMA_PX = 0.45
SEEDS = (1, 2, 3)
EXPOSURE_S, PHOTON_GAIN_DN, READ_NOISE_DN = 1.4, 6.0, 2.0
DISTANCE_PX = np.minimum.outer(*(2 * (np.minimum(np.arange(FIELD_PX), np.arange(FIELD_PX)[::-1]),)))


@dataclass(frozen=True)
class Row:
    """Eq. (1) for one method, treatment of edges and seed, in each of BANDS_PX, percent."""

    method: str
    edges: str
    seed: int
    bias_pct: tuple[float, ...]
    deviation_pct: tuple[float, ...]


def study_psf() -> Psf:
    """The diffuse scatter of the paper on its full reach, convolved with a small core."""
    line = np.exp(-((np.arange(17) - 8) ** 2) / (2 * CORE_SIGMA_PX**2))
    core = np.outer(line, line) / line.sum() ** 2
    kernel = linear_convolve(scatter_kernel(6.15, 2.53, 0.411, 2048), core, (2048, 2048))
    return Psf(kernel=np.maximum(kernel, 0), name="edge study", version="1", instrument=None, status="draft")


def rows(
    seed: int, psf: Psf, cache: EngineFor, *, methods: tuple[str, ...], ways: tuple[str | None, ...]
) -> Iterator[Row]:
    """One row for every method and every treatment of edges, on one scene. None: the default treatment of the method."""
    scene = solar_scene((SCENE_PX, SCENE_PX), seed)
    whole = observe(
        scene, psf, exposure_s=EXPOSURE_S, photon_gain_dn=PHOTON_GAIN_DN, read_noise_dn=READ_NOISE_DN, seed=seed,
        threads=2,
    )  # fmt: skip
    first = (SCENE_PX - FIELD_PX) // 2
    middle = (slice(first, first + FIELD_PX),) * 2
    for name in methods:
        deconvolve = method_named(name)
        # The middle of the scene is far from its edges; outside, the scene is zero.
        whole_way = "extended" if name == "richardson-lucy-extended" else "zero"
        reference = deconvolve(
            _image(whole), psf, Conditions(edges=whole_way, margin_px=0, threads=2, engine_for=cache)
        ).pixels[middle]
        for way in ways:
            found = deconvolve(_image(whole[middle]), psf, Conditions(edges=way, threads=2, engine_for=cache))
            yield Row(name, found.edges, seed, *compare(found.pixels, reference))


def compare(
    x: NDArray[np.float64], reference: NDArray[np.float64]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Eq. (1) of each band."""
    bias, deviation = [], []
    for near, far in BANDS_PX:
        band = (near <= DISTANCE_PX) & (far > DISTANCE_PX)
        total = reference[band].sum()
        bias.append(100 * (x[band].sum() / total - 1))
        deviation.append(100 * np.abs(x - reference)[band].sum() / total)
    return tuple(bias), tuple(deviation)


def _image(pixels: NDArray[np.float64]) -> Image:
    return Image(pixels, np.zeros(pixels.shape, np.uint8), fits.Header(), "DN/s", EXPOSURE_S)


def main() -> None:
    seeds = tuple(map(int, sys.argv[1:])) or SEEDS
    psf, cache = study_psf(), PreparedPsfs().engine_for
    print(
        f"{'method':<30}{'edges':<12}{'seed':>5}   "
        "bias, % (0-2, 2-20, 20-64 px from the edge)    deviation, % (same bands)"
    )
    for seed in seeds:
        for row in rows(seed, psf, cache, methods=tuple(method_names()), ways=EDGES):
            figures = [" ".join(f"{v:8.2f}" for v in part) for part in (row.bias_pct, row.deviation_pct)]
            print(f"{row.method:<30}{row.edges:<12}{row.seed:>5}   {figures[0]}   {figures[1]}", flush=True)


if __name__ == "__main__":
    main()
