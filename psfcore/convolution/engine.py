"""Fast convolution with one PSF, and its adjoint, for fields of one shape, in single precision.

The engine computes the same operators as `psfcore.convolution.convolver.Convolver`: H of Eq. (1) and H^T of Eq. (2) in
that module. The engine is several times faster than SciPy (`make bench-peers` prints the ratios to SciPy
and ducc0). There are three reasons:

- Zeros are not transformed. Along x, only the rows of the field are transformed, not the padding rows. Along y, a block
  of sixteen columns is padded, transformed, multiplied by the transfer function and transformed back while it is in the
  cache. Only the rows of the field are written back.
- Steps are combined. Between two convolutions of an iteration, a block of rows is transformed back, changed by the
  method and transformed again while it is in the cache. H x is never written to memory.
- The transfer function is real if the PSF is symmetric about its centre.

A field is stored in blocks of 32 rows, [block][x][half][lane]; the row is 32 block + 16 half + lane. The two halves
are the real and the imaginary part of one complex transform, so a real row costs half a transform. A spectrum is
stored as [block of 16 columns][row][re, im][lane]. Each block is processed independently and in a fixed order, so the
result does not depend on the number of threads.
"""

from __future__ import annotations

import copy
import itertools
import math
import queue
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.fft_kernels import Plan, forward, inverse, make_plan
from psfcore.convolution.lanes import LANES, join, scale, split, transpose, turn, turn_back
from psfcore.convolution.lengths import good_length
from psfcore.convolution.offsets import needed_kernel
from psfcore.errors import DataError

BLOCK_ROWS = 2 * LANES
_SIZE = 2 * LANES  # numbers of sixteen complex values
# Largest imaginary part of the transfer function of a symmetric PSF, as a share of the sum of weights. This
# limit is smaller than the float32 rounding of the transfer function.
SYMMETRIC_TO = 1e-7
# Chunks per thread for small and for large images. To start a chunk takes about as long as to process one or two small
# blocks.
_LINE_BYTES = 64
_CHUNKS_A_THREAD = (2, 4)
_BLOCKS_A_CHUNK = 8

Single = NDArray[np.float32]
Result = TypeVar("Result")


class Scratch(NamedTuple):
    """Working memory of one thread: the buffer of a transform, and a small array in which blocks are transposed."""

    buffer: Single
    corner: Single


class Lines(NamedTuple):
    """The rows or columns of a spectrum for a kernel, which takes them as one argument: with the working memory of a
    thread and the plan of the transform.
    """

    spectrum: Single
    buffer: Single
    corner: Single
    plan: Plan


class FieldLines(NamedTuple):
    """Lines of all spectra that a PSF that changes over the field needs (`psfcore.convolution.field_engine`). The first
    fields are those of `Lines`.

    Attributes
    ----------
    second
        A second buffer of the thread.
    spectra
        The spectra of the field times each u^a: [n] and then as the spectrum.
    factors
        The functions u^a [n][x].
    from_rows
        The number of spectra, beside the first, into which rows are transformed.
    to_rows
        The number of spectra that, each times its function, are added to rows that are transformed back.
    """

    spectrum: Single
    buffer: Single
    corner: Single
    plan: Plan
    second: Single
    spectra: Single
    factors: Single
    from_rows: int
    to_rows: int


# The number of fields of `Lines`. The compiler leaves out what is for `FieldLines` alone.
_FIELDS: Final = 4


class Engine:
    """Convolution with one PSF, cut to one field, and the adjoint of this operator, in float32.

    Raises DataError "field-shape" if an array has another shape.

    Parameters
    ----------
    psf_kernel
        Weights [y, x] of any shape, even or odd; centre at [ny // 2, nx // 2].
    field_shape
        Shape (ny, nx) of the field.
    span
        Distances (ny, nx): the convolution is exact for every pair of pixels that are closer to each other than this.
        Default: the shape of the field, so that the convolution is exact for all pairs. If the field includes a margin,
        a smaller span makes the transforms shorter. Pixels farther apart then lie in opposite margins, and light may
        wrap from one to the other.
    threads
        Number of threads; it does not change the result.
    """

    _buffers = 1  # of a thread
    _spectra: tuple[int, ...] = ()  # first axis of the spectrum, for an engine with several spectra

    def __init__(
        self,
        psf_kernel: NDArray[np.floating],
        field_shape: tuple[int, int],
        *,
        span: tuple[int, int] | None = None,
        threads: int = 1,
    ) -> None:
        self.field_shape = field_shape
        span = span or field_shape
        kernel, first = needed_kernel(psf_kernel, span)
        ly, lx = (
            good_length(max(size, joined + max(-low, low + count - 1, 0)))
            for size, joined, low, count in zip(field_shape, span, first, kernel.shape, strict=True)
        )
        self.row_plan, self.column_plan = make_plan(lx), make_plan(ly)
        ny, nx = field_shape
        self.row_blocks = -(-ny // BLOCK_ROWS)
        self.column_blocks = -(-(lx // 2 + 1) // LANES)
        self.lanes_shape = (self.row_blocks, nx, 2, LANES)
        self._use_threads(threads)
        self.transfer = self._transfer_function(kernel, first)

    def _use_threads(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(max(threads - 1, 1))
        self._scratch: queue.SimpleQueue[Scratch] = queue.SimpleQueue()
        for _ in range(threads):
            buffer = aligned(self._buffers * max(self.row_plan.length, self.column_plan.length) * 2 * LANES)
            self._scratch.put(Scratch(buffer, aligned(LANES, 4, LANES)))

    def twin(self) -> Engine:
        """The same operator with one thread and its own working memory: another thread may use it beside this one."""
        twin = copy.copy(self)
        twin.release()
        twin._use_threads(1)
        return twin

    @cached_property
    def _spectrum(self) -> Single:
        """The spectrum of the field, in blocks of columns. It must be asked for before threads share it."""
        return aligned(*self._spectra, self.column_blocks, self.row_blocks * BLOCK_ROWS, 2, LANES)

    def release(self) -> None:
        """Give back the memory of the spectrum; the next transform takes it again."""
        self.__dict__.pop("_spectrum", None)

    @property
    def nbytes(self) -> int:
        """Memory that the engine holds between two deconvolutions, in bytes."""
        scratch = (
            self.threads * self._buffers * max(self.row_plan.length, self.column_plan.length) * 2 * LANES * 4
        )
        return self.transfer.nbytes + scratch

    @property
    def symmetric(self) -> bool:
        """Whether the PSF is symmetric about its centre. The transfer function is then real."""
        return bool(self.transfer.shape[2] == 1)

    def local_transfers(self, rows: int) -> Iterator[Single]:
        """The first rows of the transfer function, [block of columns][row][re, im][lane]. If the PSF changes over the
        field: of those at nine places.
        """
        yield self.transfer[:, :rows]

    # Whole operators -------------------------------------------------------------------------------

    def apply(self, x: NDArray[np.floating]) -> Single:
        """The field [y, x] convolved with the PSF, H x."""
        return self._whole(x, adjoint=False)

    def adjoint(self, y: NDArray[np.floating]) -> Single:
        """The field [y, x] correlated with the PSF, H^T y."""
        return self._whole(y, adjoint=True)

    def _whole(self, field: NDArray[np.floating], *, adjoint: bool) -> Single:
        lanes = self.to_lanes(field)
        self.rows_forward(lanes)
        self.columns(adjoint=adjoint)
        self.rows_inverse(lanes)
        return self.from_lanes(lanes)

    # Steps that a method combines -------------------------------------------------------------------

    def to_lanes(self, field: NDArray[np.floating], *, padding: float = 0.0) -> Single:
        """Convert a field (ny, nx) to the engine's layout. Additional rows that complete the last block hold
        `padding`.
        """
        if field.shape != self.field_shape:
            raise DataError("field-shape", f"expected a field of {self.field_shape}; got {field.shape}")
        return self.lanes_of(lambda rows: field[rows], padding=padding)

    def lanes_of(self, rows_of: Callable[[slice], NDArray[np.floating]], *, padding: float = 0.0) -> Single:
        """As ``to_lanes``, for a field that is computed in blocks of rows: `rows_of(rows)` returns these rows.

        The whole field is never in memory.
        """
        ny, nx = self.field_shape
        lanes = aligned(*self.lanes_shape)
        block = np.empty((BLOCK_ROWS, nx), np.float32)
        for n in range(self.row_blocks):
            rows = slice(n * BLOCK_ROWS, min((n + 1) * BLOCK_ROWS, ny))
            block[: rows.stop - rows.start] = rows_of(rows)
            block[rows.stop - rows.start :] = padding
            lanes[n] = block.reshape(2, LANES, nx).transpose(2, 0, 1)
        return lanes

    def from_lanes(self, lanes: Single) -> Single:
        """The field [y, x] that an array in the engine's layout contains."""
        field = np.empty(self.field_shape, np.float32)
        for first, rows in self.row_blocks_of(lanes):
            field[first : first + len(rows)] = rows
        return field

    def row_blocks_of(self, lanes: Single) -> Iterator[tuple[int, Single]]:
        """The rows of a field in the engine's layout, in blocks: the number of the first row, and the rows [y, x]."""
        ny, nx = self.field_shape
        for n in range(self.row_blocks):
            first = n * BLOCK_ROWS
            yield first, lanes[n].transpose(1, 2, 0).reshape(BLOCK_ROWS, nx)[: ny - first]

    def rows_forward(self, lanes: Single) -> None:
        """Transform the rows of a field into the spectrum."""
        self.row_stage(_rows_forward, lanes, 0)

    def rows_inverse(self, lanes: Single) -> None:
        """Transform the spectrum's rows back into a field."""
        self.row_stage(_rows_inverse, lanes)

    def columns(self, *, adjoint: bool) -> None:
        """Transform the columns, multiply by the transfer function, and transform back.

        Parameters
        ----------
        adjoint
            Whether to multiply by the conjugate of the transfer function.
        """
        self.multiply_columns(self.transfer, conjugate=adjoint)

    def multiply_columns(self, transfer: Single, *, conjugate: bool = False) -> None:
        """As ``columns``, but with a given filter.

        Parameters
        ----------
        transfer
            The filter, in the same layout as the transfer function.
        conjugate
            Whether to multiply by the complex conjugate of the filter.
        """
        self._stage(_columns, self.column_plan, self.column_blocks, transfer, conjugate)

    def row_stage(self, kernel: Callable[..., None], *fields: object, before_h: bool = True) -> None:
        """Run the compiled row function of a method on all blocks: `kernel(lines, start, stop, *fields)`.

        lines: the rows, with the working memory of the thread. start, stop: the range of blocks.

        Parameters
        ----------
        before_h
            Whether H may be applied next to the rows that the function transforms. If H^T or a filter follows, an
            engine for a PSF that changes over the field does less work.
        """
        self._stage(kernel, self.row_plan, self.row_blocks, *fields)

    def _stage(self, kernel: Callable[..., None], plan: Plan, blocks: int, *fields: object) -> None:
        spectrum = self._spectrum
        self.run(
            lambda start, stop, scratch: kernel(Lines(spectrum, *scratch, plan), start, stop, *fields), blocks
        )

    def run(self, work: Callable[[int, int, Scratch], Result], blocks: int) -> list[Result]:
        """Call `work(start, stop, scratch)` on ranges that cover all blocks, using all threads."""
        few, many = _CHUNKS_A_THREAD
        a_thread = min(max(blocks // (_BLOCKS_A_CHUNK * self.threads), few), many)
        chunks = min(blocks, self.threads * a_thread) if self.threads > 1 else 1
        bounds = [blocks * n // chunks for n in range(chunks + 1)]

        def one(n: int) -> Result:
            scratch = self._scratch.get()
            try:
                return work(bounds[n], bounds[n + 1], scratch)
            finally:
                self._scratch.put(scratch)

        # A single chunk runs in this thread.
        return [one(0)] if chunks == 1 else self._shared_out(one, chunks)

    def _shared_out(self, one: Callable[[int], Result], chunks: int) -> list[Result]:
        """Process all chunks and return their results. The calling thread works too; each thread takes the next free
        chunk.

        The chunks are not handed to a thread one by one: for a small image, it takes longer to wake a thread than to
        process a chunk.
        """
        results: dict[int, Result] = {}
        taken = itertools.count()

        def work() -> None:
            while (n := next(taken)) < chunks:
                results[n] = one(n)

        others = [self._pool.submit(work) for _ in range(self.threads - 1)]
        try:
            work()
        finally:
            for other in others:  # wait, because the other threads write to the same spectrum
                other.result()
        return [results[n] for n in range(chunks)]

    @property
    def transfer_scale(self) -> int:
        """The product of the lengths of the transforms.

        The transfer function is divided by this product, so the transforms need no scale factor.
        """
        return self.row_plan.length * self.column_plan.length

    def _transfer_function(self, kernel: NDArray[np.floating], first: tuple[int, int]) -> Single:
        """The PSF's transform divided by `transfer_scale`: [block of columns][row][re, im][lane].

        The imaginary part is left out if the PSF is symmetric.
        """
        ly, lx = self.column_plan.length, self.row_plan.length
        blocks = -(-ly // BLOCK_ROWS)
        transfer = np.zeros((self.column_blocks, blocks * BLOCK_ROWS, 2, LANES), np.float32)

        def along_rows(start: int, stop: int, scratch: Scratch) -> None:
            for block in range(start, stop):
                here = slice(block * BLOCK_ROWS, (block + 1) * BLOCK_ROWS)
                rows = _wrapped_rows(kernel, first, (ly, lx), here) * np.float32(1 / self.transfer_scale)
                lanes = np.ascontiguousarray(rows.reshape(1, 2, LANES, lx).transpose(0, 3, 1, 2))
                _rows_forward(Lines(transfer, *scratch, self.row_plan), 0, 1, lanes, block)

        def along_columns(start: int, stop: int, _scratch: Scratch) -> None:
            for block in range(start, stop):
                forward(transfer[block, :ly].reshape(-1), self.column_plan)

        self.run(along_rows, blocks)
        self.run(along_columns, self.column_blocks)
        transfer = transfer[:, :ly]
        odd_part = float(np.abs(transfer[:, :, 1]).max()) * self.transfer_scale
        symmetric = odd_part < SYMMETRIC_TO * float(np.abs(kernel).sum())
        return _aligned_copy(transfer[:, :, :1] if symmetric else transfer)


def aligned(*shape: int) -> Single:
    """Zeros whose first number begins a line of the cache, so that no vector of lanes lies in two lines."""
    count = math.prod(shape)
    spare = _LINE_BYTES // 4
    whole = np.zeros(count + spare, np.float32)
    first = -whole.ctypes.data // 4 % spare
    return whole[first : first + count].reshape(shape)


def _aligned_copy(plane: Single) -> Single:
    copy = aligned(*plane.shape)
    copy[...] = plane
    return copy


def _wrapped_rows(
    kernel: NDArray[np.floating], first: tuple[int, int], shape: tuple[int, int], rows: slice
) -> Single:
    """The given rows of a periodic plane: the kernel with its centre at [0, 0], and zeros in all other pixels."""
    (ky, kx), (fy, fx), (ly, lx) = kernel.shape, first, shape
    out = np.zeros((rows.stop - rows.start, lx), np.float32)
    split = min(kx, max(0, -fx))
    for n, row in enumerate(range(rows.start, min(rows.stop, ly))):
        source = (row - fy) % ly
        if source < ky:
            out[n, (fx % lx) : (fx % lx) + split] = kernel[source, :split]
            out[n, fx + split : fx + kx] = kernel[source, split:]
    return out


# Kernels; each processes the blocks [start, stop) --------------------------------------------------------


@compiled()
def rows_to_spectrum(lines: Lines | FieldLines, block: int, nx: int) -> None:
    """Transform the block of rows that the buffer holds, `nx` px long, and separate it into the spectra of its 32 rows:
    the rows times each function of x first, because the buffer is transformed in place.
    """
    if len(lines) > _FIELDS:
        for n in range(lines.from_rows):
            weigh(lines.buffer, lines.factors[n], lines.second, nx)
            _buffer_to_spectrum(lines, lines.second, lines.spectra[n], block, nx)
    _buffer_to_spectrum(lines, lines.buffer, lines.spectrum, block, nx)


@compiled()
def _buffer_to_spectrum(
    lines: Lines | FieldLines, buffer: Single, spectrum: Single, block: int, nx: int
) -> None:
    """Transform a block of rows in place, and separate it into the spectra of its 32 rows.

    Each complex signal of the block contains two real rows. If Z is the transform of a + i b with real a and b, then
    A[k] = (Z[k] + Z*[L-k]) / 2, B[k] = (Z[k] - Z*[L-k]) / (2 i).
    """
    corner, length, place = lines.corner, lines.plan.length, lines.plan.place
    clear_beyond(buffer, nx * _SIZE, length)
    forward(buffer, lines.plan)
    last = length // 2
    rows = spectrum.shape[1]
    for group in range(spectrum.shape[0]):
        for kk in range(LANES):
            k = group * LANES + kk
            if k > last:
                corner[kk] = np.float32(0.0)
            else:
                split(buffer, corner, place[k] * _SIZE, place[(length - k) % length] * _SIZE, kk * 2 * _SIZE)
        row = group * rows + block * BLOCK_ROWS
        for part in range(4):
            here = (row + part // 2 * LANES) * _SIZE + part % 2 * LANES
            transpose(corner, spectrum, part * LANES, 2 * _SIZE, here, _SIZE)


@compiled()
def rows_from_spectrum(lines: Lines | FieldLines, block: int) -> Single:
    """Transform a block of 32 rows back into the buffer, and return the buffer as [x, half, lane]. The blocks of the
    spectra that are multiplied by functions of x are added.
    """
    _spectrum_to_buffer(lines, lines.spectrum, lines.buffer, block)
    if len(lines) > _FIELDS:
        for n in range(lines.to_rows):
            _spectrum_to_buffer(lines, lines.spectra[n], lines.second, block)
            add_weighed(lines.second, lines.factors[n], lines.buffer, lines.factors.shape[1])
    return lines.buffer.reshape((-1, 2, LANES))


@compiled()
def _spectrum_to_buffer(lines: Lines | FieldLines, spectrum: Single, buffer: Single, block: int) -> None:
    """Transform a block of 32 rows back.

    The spectra of the rows are joined first: Z[k] = A[k] + i B[k] and Z[L-k] = A*[k] + i B*[k], the inverse of
    ``_buffer_to_spectrum``.
    """
    corner, length, place = lines.corner, lines.plan.length, lines.plan.place
    last = length // 2
    rows = spectrum.shape[1]
    for group in range(spectrum.shape[0]):
        row = group * rows + block * BLOCK_ROWS
        for part in range(4):
            here = (row + part // 2 * LANES) * _SIZE + part % 2 * LANES
            transpose(spectrum, corner, here, _SIZE, part * LANES, 2 * _SIZE)
        for k in range(group * LANES, min((group + 1) * LANES, last + 1)):
            at = (k - group * LANES) * 2 * _SIZE
            join(corner, buffer, at, place[k] * _SIZE, place[(length - k) % length] * _SIZE)
    inverse(buffer, lines.plan)


@compiled()
def weigh(values: Single, factors: Single, target: Single, count: int) -> None:
    """Set target to the values times a factor for each line of 32 values, in `count` lines."""
    for line in range(count):
        factor = factors[line]
        for n in range(line * _SIZE, (line + 1) * _SIZE):
            target[n] = factor * values[n]


@compiled()
def add_weighed(values: Single, factors: Single, target: Single, count: int) -> None:
    """Add to target the values times a factor for each line of 32 values, in `count` lines."""
    for line in range(count):
        factor = factors[line]
        for n in range(line * _SIZE, (line + 1) * _SIZE):
            target[n] += factor * values[n]


# An assignment between slices of arrays would compile five seconds longer, because of its check of the shapes.


@compiled()
def copy_numbers(values: Single, target: Single, count: int) -> None:
    """Copy the first `count` numbers."""
    for n in range(count):
        target[n] = values[n]


@compiled()
def clear_beyond(buffer: Single, filled: int, length: int) -> None:
    """Set the buffer of a transform to 0 beyond its first `filled` numbers."""
    buffer[filled : length * _SIZE] = np.float32(0.0)


@compiled()
def _rows_forward(lines: Lines, start: int, stop: int, lanes: Single, first_block: int) -> None:
    """Transform the rows of blocks.

    Parameters
    ----------
    first_block
        The block of the spectrum to which block 0 of `lanes` belongs.
    """
    nx = lanes.shape[1]
    for block in range(start, stop):
        copy_numbers(lanes[block].reshape(-1), lines.buffer, nx * _SIZE)
        rows_to_spectrum(lines, first_block + block, nx)


@compiled()
def _rows_inverse(lines: Lines, start: int, stop: int, lanes: Single) -> None:
    for block in range(start, stop):
        rows_from_spectrum(lines, block)
        copy_numbers(lines.buffer, lanes[block].reshape(-1), lanes.shape[1] * _SIZE)


@compiled()
def _columns(lines: Lines, start: int, stop: int, transfer: Single, conjugate: bool) -> None:
    """Multiply columns by the transfer function, real or complex, or by its conjugate."""
    buffer, length = lines.buffer, lines.plan.length
    # A block may have more rows than the transform; the rows beyond the transform are padding and stay zero.
    filled = min(lines.spectrum.shape[1], length) * _SIZE
    for group in range(start, stop):
        column = lines.spectrum[group].reshape(-1)
        copy_numbers(column, buffer, filled)
        clear_beyond(buffer, filled, length)
        forward(buffer, lines.plan)
        for k in range(length):
            if transfer.shape[2] == 1:
                scale(buffer, transfer, k * _SIZE, (group * length + k) * LANES)
            elif conjugate:
                turn_back(buffer, transfer, k * _SIZE, (group * length + k) * _SIZE)
            else:
                turn(buffer, transfer, k * _SIZE, (group * length + k) * _SIZE)
        inverse(buffer, lines.plan)
        copy_numbers(buffer, column, filled)
