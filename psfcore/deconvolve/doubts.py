"""Warnings about the inputs of a deconvolution: the PSF, its channel and mesh, and pixels that are not what they should
be.

Three signs of wrong pixels are looked for: spikes, a bias that was not subtracted, and values that were scaled for
display. A spike (a cosmic ray, a hot pixel) is brighter than the PSF allows. The PSF puts the share k of a point's
light into the brightest of the four nearest pixels; a pixel with the excess e over its surroundings is a spike if its
neighbours have less than half of the excess that its light alone must give them:

    excess of the brightest neighbour < k e / 2,   e > SPIKE_SIGMA sigma        Eq. (1)

sigma is the scatter between neighbouring pixels. Each block of BLOCK_PX pixels is searched for its brightest pixel
only, so the number of spikes is a lower bound.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.offsets import needed_kernel
from psfcore.deconvolve.declaration import Edges
from psfcore.deconvolve.edges import light_across
from psfcore.deconvolve.methods.registry import method_names, properties_of
from psfcore.fits.units import parse_unit
from psfcore.image import Image
from psfcore.instruments.psf_statements import mesh_is_assumed
from psfcore.psf import REACH_GRID_PX, Psf
from psfcore.psf_sampling import frame_warnings

LARGEST_CLIPPED = 0.01  # share of the light of an image; a product's total is accurate to about this share
LARGEST_CUT = 0.001  # share of the light of a PSF; a PSF sums to 1 with about this tolerance
BLOCK_PX = 16
SPIKE_SIGMA = 20.0
FEWEST_SPIKES = 5
# A bias is suspected if the darkest of 1000 pixels is above this level (DN) and the others reach less far above it than
# it is.
SMALLEST_BIAS_DN = 50.0
_SAMPLE = 65_536
_BESIDE = ((0, 1), (0, -1), (1, 0), (-1, 0))


def input_warnings(
    psf: Psf, image: Image, method: str | None, *, channel: str | None, edges: Edges | None = None
) -> dict[str, str]:
    """Warnings about the inputs: sentences by their codes, the most harmful first.

    Parameters
    ----------
    method
        The method of the deconvolution; None: none was chosen yet.
    channel
        The answer of `check_channel`.
    edges
        The scene beyond the edges of the image; None: not chosen.
    """
    warnings = frame_warnings(psf, image.header)
    warnings |= {} if channel is None else {"channel": channel}
    if mesh_is_assumed(psf.name, psf.instrument, psf.provenance):
        warnings["assumed-mesh"] = (
            "the instrument file of the PSF assumes a part of its filter meshes: compare the arms of a bright point "
            "with it (heliopsf arms), or use a published PSF"
        )
    warnings |= image.warnings
    if image.saturation is not None and image.saturation.warning is not None:
        warnings["saturation"] = image.saturation.warning
    if method is not None:
        warnings |= _cut_warning(psf, image)
        warnings |= _across_warning(psf, image) if edges == "periodic" else {}
        warnings |= {} if properties_of(method).may_be_negative else _negative_warning(image)
        warnings |= pixel_warnings(image, psf.kernel)
    return warnings


def _cut_warning(psf: Psf, image: Image) -> dict[str, str]:
    """The warning if a PSF that is larger than the usual reach is cut, and more than LARGEST_CUT of its light is cut
    off.
    """
    if max(psf.kernel.shape) <= REACH_GRID_PX:
        return {}
    needed, _ = needed_kernel(psf.kernel, image.pixels.shape)
    off = 1 - float(needed.sum()) / psf.total
    if off <= LARGEST_CUT:
        return {}
    (ny, nx), (rows, columns) = psf.kernel.shape, needed.shape
    return {
        "psf-cut": f"of the PSF of {nx} x {ny} px, the image needs {columns} x {rows} px: {100 * off:.3g} % of its "
        "light falls farther, and such light from sources beyond the image is not removed: use a larger image if it "
        "matters"
    }


def _across_warning(psf: Psf, image: Image) -> dict[str, str]:
    """The warning that says how much light periodic edges bring from one edge to the opposite one."""
    mean = float(image.pixels.mean(where=image.valid)) if image.valid.any() else 0.0
    if mean <= 0:
        return {}
    share_pct = 100 * light_across(image, psf) / mean
    return {
        "periodic": "the edges periodic bring light from each edge to the opposite one: a pixel gets at most "
        f"{share_pct:.3g} % of the mean of the image: use the edges symmetric if this matters"
    }


def _negative_warning(image: Image) -> dict[str, str]:
    """The warning if a method that counts negative pixels as 0 adds more than LARGEST_CLIPPED to the light of the
    image.
    """
    light = float(image.pixels.sum(where=image.valid))
    clipped = -float(image.pixels.sum(where=image.valid & (image.pixels < 0)))
    if clipped <= LARGEST_CLIPPED * abs(light):
        return {}
    share = f"{100 * clipped / abs(light):.3g} % of the light" if light else "all of the light"
    kept = ", ".join(name for name in method_names() if properties_of(name).may_be_negative)
    return {
        "negative-pixels": f"negative pixels count as 0, which adds {share}: use a method that keeps them ({kept})"
    }


def pixel_warnings(image: Image, psf_kernel: NDArray[np.float64]) -> dict[str, str]:
    """Warnings about the pixels of an image: sentences by their codes.

    Parameters
    ----------
    psf_kernel
        Weights [y, x] on the pixels of the image, centre at [ny // 2, nx // 2].
    """
    warnings = {}
    spikes = count_spikes(image, psf_kernel)
    if spikes >= FEWEST_SPIKES:
        warnings["spikes"] = (
            f"at least {spikes} pixels are brighter than the PSF allows, as cosmic rays are, and spread: use the "
            "image after despiking, or mask them"
        )
    step = max(1, image.pixels.size // _SAMPLE)
    sample = image.pixels.ravel()[::step][image.mask.ravel()[::step] == 0]
    if sample.size:
        low, middle, high = np.percentile(sample, (0.1, 50, 99.9))
        count = parse_unit(image.unit).kind in ("count", "unknown")
        if count and low > SMALLEST_BIAS_DN and high - low < low:
            warnings["bias"] = (
                f"the darkest pixels are at {low:.4g}, and the others reach to {high:.4g}: if a bias is still in the "
                "image, subtract it first"
            )
        whole = np.array_equal(sample, np.rint(sample))
        if whole and 200 < float(image.pixels.max(where=image.valid, initial=0)) <= 255 and low >= 0:
            warnings["picture"] = (
                "all pixels are whole numbers up to 255, as in a picture: a scaled picture is not proportional to light"
            )
        elif not whole and count and low > 0 and high < 6 and high - low < 5 and middle > 1:
            warnings["scaled"] = (
                f"the pixels reach from {low:.2f} to {high:.2f}, as logarithms of DN do: use the image before scaling"
            )
    return warnings


def count_spikes(image: Image, psf_kernel: NDArray[np.float64]) -> int:
    """The number of blocks of an image whose brightest pixel is a spike, Eq. (1)."""
    y, x = psf_kernel.shape[0] // 2, psf_kernel.shape[1] // 2
    near = psf_kernel[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
    peak = float(psf_kernel[y, x])
    if near.shape != (3, 3) or peak <= 0:
        return 0
    share = max(near[1, 0], near[1, 2], near[0, 1], near[2, 1]) / peak
    rows, columns = _brightest_of_blocks(image)
    reach = 3
    ny, nx = image.pixels.shape
    inside = (rows >= reach) & (columns >= reach) & (rows < ny - reach) & (columns < nx - reach)
    rows, columns = rows[inside], columns[inside]
    if rows.size == 0:
        return 0
    pixels, usable = image.pixels, image.valid
    for dy, dx in _BESIDE:
        good = usable[rows + dy, columns + dx] & usable[rows + reach * dy, columns + reach * dx]
        rows, columns = rows[good], columns[good]
    level = np.mean([pixels[rows + reach * dy, columns + reach * dx] for dy, dx in _BESIDE], axis=0)
    beside = np.max([pixels[rows + dy, columns + dx] for dy, dx in _BESIDE], axis=0) - level
    excess = pixels[rows, columns] - level
    sigma = _scatter(image)
    return int(np.count_nonzero((beside < 0.5 * share * excess) & (excess > SPIKE_SIGMA * sigma)))


def _brightest_of_blocks(image: Image) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the brightest pixel of each block that has a pixel far above its mean."""
    ny, nx = (size // BLOCK_PX for size in image.pixels.shape)
    if ny == 0 or nx == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    plane = (
        image.pixels if image.valid.all() else np.where(image.valid, image.pixels, np.nanmin(image.pixels))
    )
    blocks = plane[: ny * BLOCK_PX, : nx * BLOCK_PX].reshape(ny, BLOCK_PX, nx, BLOCK_PX)
    brightest = blocks.max(axis=1).max(axis=-1)  # rows first, which are contiguous
    typical = np.median(blocks[:, BLOCK_PX // 2, :, ::4], axis=-1)
    chosen = np.argwhere(brightest - typical > SPIKE_SIGMA * _scatter(image))
    at = [int(blocks[by, :, bx, :].argmax()) for by, bx in chosen]
    inner = np.array(np.unravel_index(np.array(at, np.intp), (BLOCK_PX, BLOCK_PX)))
    return chosen[:, 0] * BLOCK_PX + inner[0], chosen[:, 1] * BLOCK_PX + inner[1]


def _scatter(image: Image) -> float:
    """The standard deviation of the difference between a pixel and the next one, from its median, in a sample of
    rows.
    """
    step = max(1, image.pixels.shape[0] // 64)
    rows = image.pixels[::step]
    difference = np.abs(np.diff(rows, axis=1))
    difference = difference[np.isfinite(difference)]
    return 1.4826 * float(np.median(difference)) / 2**0.5 if difference.size else 0.0
