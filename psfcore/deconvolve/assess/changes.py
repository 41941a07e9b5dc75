"""What a deconvolution changed in an image, in numbers that can be compared with the paper.

Hofmeister et al., The point-spread function of HRI_EUV, section "Effects on HRI_EUV images": "bright features
intensify by up to 40 %, while dark regions decrease by up to 85 %". The paper does not define a feature, the number
of pixels over which it is averaged, or the meaning of "up to". This module therefore makes a table for several
definitions. Here a feature is a block of n x n pixels (BLOCKS_PX); the code calls it a structure. The brightest and the
darkest blocks (TAILS_PCT) are selected by percentiles of the image before deconvolution. Each row of the table gives
three numbers: the change of the summed light of these blocks, the median of their changes, and the largest change after
the most extreme 1 % of the blocks are left out.

    change = 100 (after / before - 1)                             Eq. (1)
    dynamic range = percentile 100 - p divided by percentile p    Eq. (2)    percentiles of the block means

The image before deconvolution, in which the blocks are selected, is noisy: some of the brightest single pixels are
bright only because of noise. This hardly matters for blocks of 4 px and more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess import ranks
from psfcore.deconvolve.assess.artefacts import Artefacts, NoiseAt, find_artefacts
from psfcore.deconvolve.assess.compared import Compared, single
from psfcore.deconvolve.edges import inside_band
from psfcore.errors import DataError
from psfcore.fits.units import dn_per_unit
from psfcore.image import Image
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.shares import in_order

BLOCKS_PX = (1, 4, 8, 16, 32)  # powers of 2
TAILS_PCT = (5.0, 1.0, 0.1)
CHANGE_PERCENTILES = (0.1, 1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0, 99.9)
_LARGEST_PCT = 99.0
_AT_ONCE = 1 << 18

Plane = NDArray[np.floating]
Means = NDArray[np.float32]
Flags = NDArray[np.bool_]
Pixel = TypeVar("Pixel", bound=np.generic)


@dataclass(frozen=True)
class Structure:
    """Change, Eq. (1), of the brightest or darkest `tail_pct` percent of blocks of block_px x block_px.

    Attributes
    ----------
    kind
        The kind of the blocks: bright or dark.
    sum_pct
        Change of the summed light of these blocks, percent.
    median_pct
        Median of the changes of these blocks, percent.
    up_to_pct
        Percentile 99 of the changes of bright blocks, or percentile 1 of the changes of dark blocks.
    before
        Mean of the blocks before deconvolution, in the unit of the image.
    """

    kind: str
    block_px: int
    tail_pct: float
    blocks: int
    before: float
    sum_pct: float
    median_pct: float
    up_to_pct: float


@dataclass(frozen=True)
class Range:
    """Dynamic range, Eq. (2), and contrast of block means, before and after deconvolution.

    Contrast is the standard deviation divided by the mean. It is None if the mean is not above zero, and a dynamic
    range is None if the lower percentile is not.
    """

    block_px: int
    tail_pct: float
    dynamic_before: float | None
    dynamic_after: float | None
    contrast_before: float | None
    contrast_after: float | None


@dataclass(frozen=True, eq=False)
class Changes:
    """What a deconvolution changed in one image.

    Attributes
    ----------
    pixels
        Number of compared pixels.
    edge_px
        Width of the excluded band at the edges.
    change_pct
        Percentiles of the change of single pixels, Eq. (1).
    difference
        Percentiles of after - before, in the unit of the image.
    not_positive_before, not_positive_after
        Number of pixels that are not above zero, before and after deconvolution. Eq. (1) is not defined for pixels that
        are not above zero before.
    """

    pixels: int
    edge_px: int
    flux_change_pct: float
    change_pct: dict[str, float]
    difference: dict[str, float]
    not_positive_before: int
    not_positive_after: int
    structures: tuple[Structure, ...]
    ranges: tuple[Range, ...]
    artefacts: Artefacts

    def as_json(self) -> dict[str, object]:
        """Values for JSON, without the plane of suspected pixels."""
        plain = {name: value for name, value in vars(self).items() if name not in ("structures", "ranges")}
        return plain | {
            "structures": [asdict(row) for row in self.structures],
            "ranges": [asdict(row) for row in self.ranges],
            "artefacts": self.artefacts.as_json(),
        }


def measure_changes(
    image: Image,
    result: Plane,
    psf: Psf,
    *,
    noise: Noise | None = None,
    edge_px: int = 0,
    threads: int = 2,
) -> Changes:
    """Compare an image with its deconvolution, `result` [y, x], in the trusted pixels.

    Raises DataError "field-shape", "no-signal", "no-exposure".

    Parameters
    ----------
    psf
        The PSF with which the image was deconvolved.
    edge_px
        Width of the band at the edges that is left out.
    noise
        Noise of the camera; if it is None, the artefact check estimates the noise from the pixels.
    threads
        Number of threads; it does not change the result.
    """
    if result.shape != image.pixels.shape:
        raise DataError("field-shape", f"expected a result of {image.pixels.shape}; got {result.shape}")
    counted = counted_pixels(image, result, edge_px)
    if not counted.any():
        raise DataError(
            "no-signal", "expected trusted pixels outside the edge band; got none: use a larger image"
        )
    sigma = None if noise is None else _noise_at(image, noise)
    centre = (psf.kernel.shape[0] // 2, psf.kernel.shape[1] // 2)
    pair = Compared(single(image.pixels), single(result), counted, threads)
    above = replace(pair, counted=counted & (image.pixels > 0))
    blocks = [_pixels(pair), *_larger_blocks(image.pixels, result, pair)]
    light_before, light_after = (
        float(plane.sum(dtype=np.float64, where=counted)) for plane in (image.pixels, result)
    )
    pixels, positive = (int(one.sizes.sum()) for one in (pair, above))
    return Changes(
        pixels=pixels,
        edge_px=edge_px,
        flux_change_pct=100 * (light_after - light_before) / (abs(light_before) or 1.0),
        change_pct=_percentiles(above, lambda rows: _change_pct(image.pixels[rows], result[rows]))
        if positive
        else {},
        difference=_percentiles(pair, lambda rows: result[rows] - image.pixels[rows]),
        not_positive_before=pixels - positive,
        not_positive_after=sum(
            int(np.count_nonzero(counted[rows] & (result[rows] <= 0))) for rows in pair.blocks
        ),
        structures=tuple(row for part in blocks for row in _structures(part)),
        ranges=tuple(row for part in blocks for row in _ranges(part)),
        artefacts=find_artefacts(pair, float(psf.kernel[centre]), sigma=sigma),
    )


def bright_and_dark_change_pct(
    image: Image, result: Plane, *, threads: int = 1
) -> tuple[float | None, float | None]:
    """The change of the light of the brightest and of the darkest percent of the trusted pixels, in percent.

    A change is None if the light before is not above zero.

    Parameters
    ----------
    result
        The deconvolved image [y, x].
    threads
        Number of threads; it does not change the result.
    """
    pair = Compared(single(image.pixels), single(result), image.valid, threads)
    low, high = ranks.percentiles(pair.portions(pair.before.__getitem__), [1, 99])

    def light(n: int) -> NDArray[np.float64]:
        old, new = (
            pair.compared(plane[pair.blocks[n]], n).astype(np.float64) for plane in (pair.before, pair.after)
        )
        return np.array([[one[tail].sum() for one in (old, new)] for tail in (old >= high, old <= low)])

    total = np.sum(in_order(light, len(pair.blocks), threads), axis=0).tolist()
    bright, dark = (100 * (after / before - 1) if before > 0 else None for before, after in total)
    return bright, dark


def _noise_at(image: Image, noise: Noise) -> NoiseAt:
    """The noise of the image's pixels at given positions. Raises DataError "no-exposure"."""
    dn = dn_per_unit(image)
    return lambda at: np.sqrt(noise.variance(image.pixels[at], dn))


def counted_pixels(image: Image, result: Plane, edge_px: int) -> Flags:
    """Pixels [y, x] that are trusted, finite and outside the band at the edges."""
    return np.asarray(image.valid & np.isfinite(result) & inside_band(result.shape, edge_px))


def block_means(plane: Plane, counted: Flags, block_px: int) -> Plane:
    """The mean of each block of block_px x block_px pixels, (n_blocks,).

    Only blocks whose pixels are all counted are used.
    """
    whole = _in_blocks(counted, block_px).all(axis=(1, 3))
    with np.errstate(invalid="ignore"):  # a block with infinite pixels is not whole
        return np.asarray(_in_blocks(plane, block_px).mean(axis=(1, 3))[whole])


def _in_blocks(plane: NDArray[Pixel], block_px: int) -> NDArray[Pixel]:
    """The plane with one axis more for each direction: [block, row in it, block, column in it]."""
    ny, nx = plane.shape[0] // block_px, plane.shape[1] // block_px
    return plane[: ny * block_px, : nx * block_px].reshape(ny, block_px, nx, block_px)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Block means before and after deconvolution, in portions of the same sizes."""

    block_px: int
    old: ranks.Portions
    new: ranks.Portions

    @property
    def count(self) -> int:
        """The number of blocks."""
        return int(self.old.sizes.sum())

    @property
    def tails(self) -> list[float]:
        """The tails (percent of the blocks) that contain at least one block."""
        return [tail for tail in TAILS_PCT if self.count * tail >= 100]

    @cached_property
    def old_levels(self) -> dict[float, tuple[float, float]]:
        """For each tail, its lower and its upper percentile before deconvolution."""
        return _levels(self.old)

    @cached_property
    def new_levels(self) -> dict[float, tuple[float, float]]:
        """The same after deconvolution."""
        return _levels(self.new)

    @cached_property
    def in_tails(self) -> tuple[Means, Means]:
        """The means of the blocks of the largest tails, before and after deconvolution. On a plateau, these are all
        blocks.
        """
        low, high = self.old_levels[max(self.tails)]

        def tails(n: int) -> tuple[Means, Flags]:
            old = self.old.read(n)
            return old, (old <= low) | (old >= high)

        portions, threads = len(self.old.sizes), self.old.threads
        ends = np.cumsum(in_order(lambda n: np.count_nonzero(tails(n)[1]), portions, threads))
        before, after = np.empty((2, ends[-1]), np.float32)

        def fill(n: int) -> None:
            old, chosen = tails(n)
            here = slice(ends[n] - np.count_nonzero(chosen), ends[n])
            before[here], after[here] = old[chosen], self.new.read(n)[chosen]

        in_order(fill, portions, threads)
        return before, after


def _pixels(pair: Compared) -> _Blocks:
    """The compared pixels, as blocks of one pixel."""
    return _Blocks(1, *(pair.portions(plane.__getitem__) for plane in (pair.before, pair.after)))


def _larger_blocks(before: Plane, after: Plane, pair: Compared) -> list[_Blocks]:
    """The blocks whose pixels are all compared, for each size of BLOCKS_PX above 1. The sums of a size are those of
    half the size, added.
    """
    sizes = [size for size in BLOCKS_PX if size > 1]

    of_rows = in_order(
        lambda n: _means_of_rows(before, after, pair, pair.blocks[n]), len(pair.blocks), pair.threads
    )
    found = []
    for k, block_px in enumerate(sizes):
        both = np.concatenate([means[k] for means in of_rows], axis=1)
        found.append(_Blocks(block_px, *map(ranks.Portions.of, both)))
    return found


def _means_of_rows(before: Plane, after: Plane, pair: Compared, rows: slice) -> list[Means]:
    """The block means before and after, (2, n), of some rows, for each size of BLOCKS_PX above 1.

    The number of rows is a multiple of the largest size, except for the last rows of an image.
    """
    old, new, counted, block_px = before[rows], after[rows], pair.counted[rows], 1
    found = []
    while block_px < BLOCKS_PX[-1]:
        with np.errstate(invalid="ignore"):  # a block with infinite pixels is not whole
            old, new = _joined(old, np.add), _joined(new, np.add)
        counted, block_px = _joined(counted, np.logical_and), 2 * block_px
        if block_px in BLOCKS_PX:
            means = [plane[counted] / block_px**2 for plane in (old, new)]
            found.append(np.array(means, dtype=np.float32))
    return found


def _joined(plane: NDArray[Pixel], join: np.ufunc) -> NDArray[Pixel]:
    """Each square of 2 x 2 elements joined to one."""
    ny, nx = plane.shape[0] // 2 * 2, plane.shape[1] // 2 * 2
    rows = join(plane[0:ny:2], plane[1:ny:2])
    return np.asarray(join(rows[:, 0:nx:2], rows[:, 1:nx:2]))


def _levels(means: ranks.Portions) -> dict[float, tuple[float, float]]:
    """For each tail of p percent: (percentile p, percentile 100 - p) of the block means."""
    levels = ranks.percentiles(means, [level for tail in TAILS_PCT for level in (tail, 100 - tail)]).tolist()
    return {tail: (levels[2 * k], levels[2 * k + 1]) for k, tail in enumerate(TAILS_PCT)}


def _structures(blocks: _Blocks) -> list[Structure]:
    if not blocks.tails:
        return []
    old, new = blocks.in_tails
    rows = []
    of_level: dict[tuple[str, float], Structure | None] = {}  # on a plateau, all tails have the same level
    for tail, kind in ((tail, kind) for tail in blocks.tails for kind in ("bright", "dark")):
        level = blocks.old_levels[tail][kind == "bright"]
        if (kind, level) not in of_level:
            of_level[kind, level] = _structure(blocks, old, new, kind, tail)
        row = of_level[kind, level]
        if row is not None:
            rows.append(replace(row, tail_pct=tail))
    return rows


def _structure(blocks: _Blocks, old: Means, new: Means, kind: str, tail: float) -> Structure | None:
    """One row of the table; None if no block of the tail was above zero before deconvolution.

    Parameters
    ----------
    old, new
        Means of the brightest and darkest blocks, before and after deconvolution.
    """
    bright = kind == "bright"
    level = blocks.old_levels[tail][bright]
    chosen = (old >= level if bright else old <= level) & (old > 0)
    if not chosen.any():
        return None
    if not chosen.all():
        old, new = old[chosen], new[chosen]
    change = np.empty_like(old)
    light = np.zeros(2)
    for first in range(
        0, old.size, _AT_ONCE
    ):  # all blocks of a plateau in double precision would be too large
        part = slice(first, first + _AT_ONCE)
        before, after = old[part].astype(np.float64), new[part].astype(np.float64)
        light += before.sum(), after.sum()
        change[part] = _change_pct(before, after)
    return Structure(
        kind=kind,
        block_px=blocks.block_px,
        tail_pct=tail,
        blocks=old.size,
        before=float(light[0]) / old.size,
        sum_pct=float(100 * (light[1] / light[0] - 1)),
        median_pct=float(np.median(change, overwrite_input=True)),
        up_to_pct=float(
            np.percentile(change, _LARGEST_PCT if bright else 100 - _LARGEST_PCT, overwrite_input=True)
        ),
    )


def _ranges(blocks: _Blocks) -> list[Range]:
    tails = blocks.tails
    if not tails:
        return []
    contrast_before, contrast_after = _contrast(blocks.old), _contrast(blocks.new)
    return [
        Range(
            block_px=blocks.block_px,
            tail_pct=tail,
            dynamic_before=_dynamic_range(*blocks.old_levels[tail]),
            dynamic_after=_dynamic_range(*blocks.new_levels[tail]),
            contrast_before=contrast_before,
            contrast_after=contrast_after,
        )
        for tail in tails
    ]


def _dynamic_range(low: float, high: float) -> float | None:
    return float(high / low) if low > 0 else None  # Eq. (2)


def _contrast(means: ranks.Portions) -> float | None:
    count = int(means.sizes.sum())
    mean = _total(means, lambda values: values) / count
    if mean <= 0:
        return None
    return float(np.sqrt(_total(means, lambda values: (values - mean) ** 2) / count)) / mean


def _total(means: ranks.Portions, of: Callable[[Plane], Plane]) -> float:
    """The sum of a function of all numbers, in double precision."""
    totals = in_order(
        lambda n: float(of(means.read(n).astype(np.float64)).sum()), len(means.sizes), means.threads
    )
    return sum(totals)


def _percentiles(pair: Compared, of: Callable[[slice], Plane]) -> dict[str, float]:
    """Percentiles of what `of` gives for the compared pixels of some rows."""

    def numbers(rows: slice) -> Plane:
        with np.errstate(divide="ignore", invalid="ignore"):  # of pixels that are not compared
            return of(rows)

    levels = ranks.percentiles(pair.portions(numbers), CHANGE_PERCENTILES)
    return {f"p{level:g}": float(value) for level, value in zip(CHANGE_PERCENTILES, levels, strict=True)}


def _change_pct(before: Plane, after: Plane) -> Plane:
    """The change in percent, Eq. (1)."""
    change = after / before
    change -= 1
    change *= 100
    return change
