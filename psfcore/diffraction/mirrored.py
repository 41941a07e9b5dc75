"""The transforms of `fraunhofer`, for a pupil that is symmetric in x and in y.

The cells of such a mask are at +-(i + 1/2) from the axis, with i = 0, 1, ..., so the sum along one axis is real:

    E(q) = sum over i >= 0 of c_i 2 cos(2 pi q (i + 1/2) / n)                                        Eq. (1)

For q = j + o, the cells are added modulo n, which gives g, and the result is one transform of length n:

    g_u = sum over k of c_i exp(-2 pi i o (i + 1/2) / n),  i = u + k n                               Eq. (2)
    E(j + o) = exp(-pi i j / n) sum over u of f_u exp(-2 pi i j u / n),  f_u = g_u + conj(g_(n-1-u)) Eq. (3)

The result is real, so one complex transform serves two rows: with f = f_A + i f_B, the result is E_A + i E_B. Along x
only a quarter of the mask is needed, and along y half of its rows. In comparison with the complex sum of
`fraunhofer`, half as many transforms are computed, from half as many cells.

The data have the layout of `psfcore.convolution.engine`: [index][half][lane]. The two halves are the rows A and B of
one transform, and sixteen transforms ("lanes") are computed side by side in the cache.

| symbol | name | unit |
|---|---|---|
| c | lanes, open share of the cells, or the field after the transform along x | - |
| n | period, the length of the transform | px |
| o | offset of the samples from the centre of a pixel | px |
| j | pixel, from -size // 2 | px |
"""

from __future__ import annotations

import math
import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.fft_kernels import forward, make_plan
from psfcore.convolution.lengths import LANES, LARGEST_LENGTH, good_length
from psfcore.diffraction.pupil import MaskGrid

BLOCK = 2 * LANES
FIELD_BYTES = 800 * 2**20  # memory for the fields after the transform along x that are kept at the same time
_CHUNKS_A_THREAD = 4

Single = NDArray[np.float32]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SampleOffset:
    """A position (s, t) of the samples within a pixel: their offsets (px), and how often the intensity counts."""

    offset_x: float
    offset_y: float
    weight: float


def passes(places: Sequence[SampleOffset], together: int) -> Iterator[tuple[list[float], list[SampleOffset]]]:
    """Divide places into passes over the mask: the offsets in x of each pass, at most `together`, and its places."""
    offsets = sorted({place.offset_x for place in places})
    for first in range(0, len(offsets), together):
        here = offsets[first : first + together]
        yield here, [place for place in places if place.offset_x in here]


def can_transform(period: int) -> bool:
    """Whether there is a transform of this length."""
    return period <= LARGEST_LENGTH and good_length(period) == period


class MirroredTransforms:
    """Computes the sum of |E|^2 over samples, for a mask that equals its mirror images in x and in y.

    The result has the shape (size, size).

    Parameters
    ----------
    period
        The period n, a length for which `can_transform` is true.
    """

    def __init__(
        self, mask: MaskGrid, *, period: int, size: int, pool: ThreadPoolExecutor, threads: int
    ) -> None:
        self.mask, self.period, self.size = mask, period, size
        self.pool, self.threads = pool, threads
        self.cells = mask.cells // 2
        self.row_blocks = -(-self.cells // BLOCK)
        self.column_blocks = -(-size // BLOCK)
        self.plan = make_plan(period)
        pixel = np.arange(self.column_blocks * BLOCK) - size // 2
        self._at = self.plan.place[pixel % period]
        self._turn = _turns(pixel / (2 * period))  # exp(-pi i j / n) of Eq. (3)
        self._buffers: queue.SimpleQueue[_Buffers] = queue.SimpleQueue()
        for _ in range(threads):
            shapes = (BLOCK, mask.cells), (self.cells, 2, LANES), period * BLOCK, (BLOCK, LANES)
            self._buffers.put(_Buffers(*(np.empty(shape, np.float32) for shape in shapes)))

    def summed(self, places: Sequence[SampleOffset], progress: Progress) -> NDArray[np.float64]:
        """The sum of |E|^2 over the places, each multiplied by its weight; shape (size, size). progress(done, of)."""
        offsets = len({place.offset_x for place in places})
        bytes_each = self.column_blocks * self.row_blocks * BLOCK**2 * 4
        together = math.ceil(offsets / math.ceil(offsets * bytes_each / FIELD_BYTES))
        fields = np.empty((together, self.column_blocks, self.row_blocks * BLOCK, 2, LANES), np.float32)
        total = np.zeros((self.column_blocks, self.size, 2, LANES))
        done = 0
        for here, of_pass in passes(places, together):
            self._along_x(here, fields)
            for place in of_pass:
                self._along_y(fields[here.index(place.offset_x)], place, total)
                done += 1
                progress(done, len(places))
        columns = total.transpose(1, 0, 2, 3).reshape(self.size, -1)
        return np.ascontiguousarray(columns[:, : self.size])

    def _along_x(self, offsets: Sequence[float], fields: Single) -> None:
        """Compute fields[offset, block of columns, row] of all rows above the axis, from a quarter of the mask."""
        turns = [self._factors(offset) for offset in offsets]

        def work(start: int, stop: int, scratch: _Buffers) -> None:
            for block in range(start, stop):
                first = self.cells + block * BLOCK
                last = min(first + BLOCK, self.mask.cells)
                _fill_lanes(self.mask.rows(first, last, out=scratch.strip), self.cells, scratch.lanes)
                for field, turn in zip(fields, turns, strict=False):
                    _transform(scratch.lanes, self.cells, turn, scratch.buffer, self.plan)
                    _keep_field(scratch.buffer, self._at, self._turn, field, block * BLOCK, scratch.corner)

        self._run(work, self.row_blocks)

    def _along_y(self, field: Single, place: SampleOffset, total: NDArray[np.float64]) -> None:
        """Add the intensities of one place to `total`, from the field after the transform along x."""
        turn = self._factors(place.offset_y)

        def work(start: int, stop: int, scratch: _Buffers) -> None:
            for block in range(start, stop):
                _transform(field[block], self.cells, turn, scratch.buffer, self.plan)
                _add_intensity(scratch.buffer, self._at, self._turn, total[block], place.weight)

        self._run(work, self.column_blocks)

    def _factors(self, offset: float) -> Single:
        """exp(-2 pi i o (i + 1/2) / n) of Eq. (2) for all cells, and zeros that complete a round of `_transform`."""
        cell = np.arange(-(-self.cells // (2 * self.period)) * 2 * self.period)
        factors = _turns(offset * (cell + 0.5) / self.period)
        factors[self.cells :] = 0
        return factors

    def _run(self, work: Callable[[int, int, _Buffers], None], blocks: int) -> None:
        """Call work(start, stop, buffers) on ranges that cover all blocks, using all threads."""
        chunks = min(blocks, _CHUNKS_A_THREAD * self.threads)
        bounds = [blocks * n // chunks for n in range(chunks + 1)]

        def one(n: int) -> None:
            scratch = self._buffers.get()
            try:
                work(bounds[n], bounds[n + 1], scratch)
            finally:
                self._buffers.put(scratch)

        list(self.pool.map(one, range(chunks)))


@dataclass(frozen=True, eq=False)
class _Buffers:
    """Working memory of one thread: rows of the mask, their layout in lanes, a transform, and a small array in which
    blocks are transposed.
    """

    strip: Single
    lanes: Single
    buffer: Single
    corner: Single


def _turns(turns: NDArray[np.floating]) -> Single:
    """exp(-2 pi i turns), [index][re, im]."""
    angle = -2 * np.pi * turns
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)


_FAST: set[str] = {"contract"}
_W = np.uint64(LANES)


@compiled()
def _fill_lanes(strip, first, lanes):  # type: ignore[no-untyped-def]  # compiled
    """lanes[i, half, lane] = strip[row, first + i], with row = 16 half + lane; 0 where the strip has no such row."""
    rows = strip.shape[0]
    for low in range(0, len(lanes), LANES):
        high = min(low + LANES, len(lanes))
        for half in range(2):
            for lane in range(LANES):
                row = half * LANES + lane
                for i in range(low, high):
                    lanes[i, half, lane] = strip[row, first + i] if row < rows else np.float32(0.0)


@compiled(fastmath=_FAST)
def _transform(lanes, cells, turn, buffer, plan):  # type: ignore[no-untyped-def]  # compiled
    """Compute the sum of Eq. (3) into `buffer`, from the `cells` first rows of `lanes`.

    Parameters
    ----------
    turn
        The factor of each cell in Eq. (2); 0 for the further cells after the first `cells`, which complete a round.
    """
    x, z, length = lanes.reshape(-1), buffer, plan.length
    half = length // 2
    size = 2 * LANES
    for n in range(z.size):
        z[n] = np.float32(0.0)
    # Of g_u + conj(g_(n-1-u)), the element u of `z` holds row A, and the element n-1-u holds row B. In each round, four
    # cells are added to both; the second and the fourth are mirrored.
    for start in range(0, len(turn), 4 * half):
        for u in range(half):
            i, j, k, m = start + u, start + length - 1 - u, start + length + u, start + 2 * length - 1 - u
            ic, isn, jc, jsn = turn[i, 0], turn[i, 1], turn[j, 0], -turn[j, 1]
            kc, ksn, mc, msn = turn[k, 0], turn[k, 1], turn[m, 0], -turn[m, 1]
            io, jo = np.uint64(min(i, cells - 1) * size), np.uint64(min(j, cells - 1) * size)
            ko, mo = np.uint64(min(k, cells - 1) * size), np.uint64(min(m, cells - 1) * size)
            a, b = np.uint64(u * size), np.uint64((length - 1 - u) * size)
            for lane in range(LANES):
                w = np.uint64(lane)
                z[a + w] += ic * x[io + w] + jc * x[jo + w] + kc * x[ko + w] + mc * x[mo + w]
                z[a + w + _W] += isn * x[io + w] + jsn * x[jo + w] + ksn * x[ko + w] + msn * x[mo + w]
            for lane in range(LANES):
                w, v = np.uint64(lane), np.uint64(lane) + _W
                z[b + w] += ic * x[io + v] + jc * x[jo + v] + kc * x[ko + v] + mc * x[mo + v]
                z[b + v] += isn * x[io + v] + jsn * x[jo + v] + ksn * x[ko + v] + msn * x[mo + v]
    for u in range(half):
        a, b = np.uint64(u * size), np.uint64((length - 1 - u) * size)
        for lane in range(LANES):
            w, v = np.uint64(lane), np.uint64(lane) + _W
            ar, ai, br, bi = z[a + w], z[a + v], z[b + w], z[b + v]
            # f_A + i f_B at u; at n-1-u both are conjugated.
            z[a + w] = ar - bi
            z[a + v] = ai + br
            z[b + w] = ar + bi
            z[b + v] = br - ai
    forward(buffer, plan)


@compiled(fastmath=_FAST)
def _keep_field(buffer, at, turn, field, first_row, corner):  # type: ignore[no-untyped-def]  # compiled
    """field[block of columns, first_row + row, half, lane] = E of 32 rows, for all pixels of a row."""
    z = buffer.reshape((-1, 2, LANES))
    for group in range(len(at) // LANES):
        for k in range(LANES):
            pixel = group * LANES + k
            place, cosine, sine = at[pixel], turn[pixel, 0], turn[pixel, 1]
            for w in range(LANES):
                corner[w, k] = z[place, 0, w] * cosine - z[place, 1, w] * sine
                corner[LANES + w, k] = z[place, 0, w] * sine + z[place, 1, w] * cosine
        block, half = group // 2, group % 2
        for row in range(2 * LANES):
            for k in range(LANES):
                field[block, first_row + row, half, k] = corner[row, k]


@compiled(fastmath=_FAST)
def _add_intensity(buffer, at, turn, total, weight):  # type: ignore[no-untyped-def]  # compiled
    """total[pixel, half, lane] += weight E^2 for all pixels of 32 columns."""
    z = buffer.reshape((-1, 2, LANES))
    for pixel in range(len(total)):
        place, cosine, sine = at[pixel], turn[pixel, 0], turn[pixel, 1]
        for w in range(LANES):
            a = z[place, 0, w] * cosine - z[place, 1, w] * sine
            b = z[place, 0, w] * sine + z[place, 1, w] * cosine
            total[pixel, 0, w] += weight * (np.float64(a) * np.float64(a))
            total[pixel, 1, w] += weight * (np.float64(b) * np.float64(b))
