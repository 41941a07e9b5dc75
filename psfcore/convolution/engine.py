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
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution import kernels
from psfcore.convolution.fft_kernels import Plan, forward, make_plan
from psfcore.convolution.kernels import BLOCK_ROWS, Lines, Single
from psfcore.convolution.lengths import LANES, good_length, periodic_length
from psfcore.convolution.offsets import needed_kernel
from psfcore.errors import DataError

PERIODIC = (0, 0)  # the span of a field that continues with its opposite side
# Largest imaginary part of the transfer function of a symmetric PSF, as a share of the sum of weights. This
# limit is smaller than the float32 rounding of the transfer function.
SYMMETRIC_TO = 1e-7
# Chunks per thread for small and for large images. To start a chunk takes about as long as to process one or two small
# blocks.
_LINE_BYTES = 64
_CHUNKS_A_THREAD = (2, 4)
_BLOCKS_A_CHUNK = 8

Result = TypeVar("Result")


class Scratch(NamedTuple):
    """Working memory of one thread: the buffer of a transform, and a small array in which blocks are transposed."""

    buffer: Single
    corner: Single


class Engine:
    """Convolution with one PSF, cut to one field, and the adjoint of this operator, in float32.

    Raises DataError "field-shape" if an array has another shape, and "periodic-size" if a periodic field has a size for
    which there is no fast transform.

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
        wrap from one to the other. PERIODIC: the field continues with its opposite side, and the transforms have its
        size.
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
        periodic = span == PERIODIC
        # Weights farther than half of a period are left out.
        self._joined = (field_shape[0] // 2, field_shape[1] // 2) if periodic else span
        kernel, first = needed_kernel(psf_kernel, self._joined)
        ly, lx = (
            periodic_length(size)
            if periodic
            else good_length(max(size, joined + max(-low, low + count - 1, 0)))
            for size, joined, low, count in zip(field_shape, self._joined, first, kernel.shape, strict=True)
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
        # Taken here, because memory that many threads take and give back is left in pieces that are not used again.
        _ = twin._spectrum
        return twin

    @cached_property
    def _spectrum(self) -> Single:
        """The spectrum of the field, in blocks of columns. It must be asked for before threads share it."""
        return aligned(*self._spectra, self.column_blocks, self.row_blocks * BLOCK_ROWS, 2, LANES)

    @cached_property
    def _whole(self) -> Single:
        """The spectrum along both axes that `transform_columns` keeps."""
        return aligned(self.column_blocks, self.column_plan.length, 2, LANES)

    def release(self) -> None:
        """Give back the memory of the spectra; the next transform takes it again."""
        self.__dict__.pop("_spectrum", None)
        self.__dict__.pop("_whole", None)

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
        return self._operator(x, adjoint=False)

    def adjoint(self, y: NDArray[np.floating]) -> Single:
        """The field [y, x] correlated with the PSF, H^T y."""
        return self._operator(y, adjoint=True)

    def _operator(self, field: NDArray[np.floating], *, adjoint: bool) -> Single:
        lanes = self.to_lanes(field)
        self.rows_forward(lanes)
        self.columns(adjoint=adjoint)
        self.rows_inverse(lanes)
        return self.from_lanes(lanes)

    # Steps that a method combines -------------------------------------------------------------------

    def to_lanes(
        self, field: NDArray[np.floating], *, padding: float = 0.0, out: Single | None = None
    ) -> Single:
        """Convert a field (ny, nx) to the engine's layout, into `out` if it is given. Additional rows that complete the
        last block hold `padding`.
        """
        if field.shape != self.field_shape:
            raise DataError("field-shape", f"expected a field of {self.field_shape}; got {field.shape}")
        return self.lanes_of(lambda rows: field[rows], padding=padding, out=out)

    def lanes_of(
        self,
        rows_of: Callable[[slice], NDArray[np.floating]],
        *,
        padding: float = 0.0,
        out: Single | None = None,
    ) -> Single:
        """As ``to_lanes``, for a field that is computed in blocks of rows: `rows_of(rows)` returns these rows.

        The whole field is never in memory.
        """
        ny, nx = self.field_shape
        lanes = aligned(*self.lanes_shape) if out is None else out
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

    def rows_forward(self, lanes: Single, first_block: int = 0) -> None:
        """Transform the rows of a field, or of the blocks of a field from `first_block` on, into the spectrum."""
        self.row_stage(kernels.rows_forward, lanes, first_block, blocks=len(lanes))

    def rows_inverse(self, lanes: Single, first_block: int = 0) -> None:
        """Transform the spectrum's rows back into a field, or into its blocks from `first_block` on."""
        self.row_stage(kernels.rows_inverse, lanes, first_block, blocks=len(lanes))

    def rows_cut(self) -> None:
        """As ``rows_inverse`` and ``rows_forward``, without a field in memory: cut what the spectrum contains to the
        field.
        """
        self.row_stage(kernels.rows_cut, self.field_shape[1], self.field_shape[0])

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
        self._stage(kernels.columns, self.column_plan, self.column_blocks, transfer, conjugate)

    def transform_columns(self) -> None:
        """Transform the columns of the spectrum, and keep the result for `multiply_kept`."""
        self._stage(kernels.columns_forward, self.column_plan, self.column_blocks, self._whole)

    def multiply_kept(self, transfer: Single) -> None:
        """As ``multiply_columns``, but for the field whose columns `transform_columns` transformed last.

        One transform of a field then serves for several filters.
        """
        self._stage(kernels.columns_inverse, self.column_plan, self.column_blocks, self._whole, transfer)

    def row_stage(
        self,
        kernel: Callable[..., None],
        *fields: object,
        before_h: bool = True,
        blocks: int | None = None,
    ) -> None:
        """Run the compiled row function of a method on all blocks: `kernel(lines, start, stop, *fields)`.

        lines: the rows, with the working memory of the thread. start, stop: the range of blocks.

        Parameters
        ----------
        before_h
            Whether H may be applied next to the rows that the function transforms. If H^T or a filter follows, an
            engine for a PSF that changes over the field does less work.
        blocks
            The number of blocks; None: all.
        """
        self._stage(kernel, self.row_plan, self.row_blocks if blocks is None else blocks, *fields)

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
        whole = np.zeros((self.column_blocks, blocks * BLOCK_ROWS, 2, LANES), np.float32)
        real = aligned(self.column_blocks, ly, 1, LANES)

        def along_rows(start: int, stop: int, scratch: Scratch) -> None:
            for block in range(start, stop):
                here = slice(block * BLOCK_ROWS, (block + 1) * BLOCK_ROWS)
                rows = _wrapped_rows(kernel, first, (ly, lx), here) * np.float32(1 / self.transfer_scale)
                lanes = np.ascontiguousarray(rows.reshape(1, 2, LANES, lx).transpose(0, 3, 1, 2))
                kernels.rows_forward(Lines(whole, *scratch, self.row_plan), 0, 1, lanes, block)

        def along_columns(start: int, stop: int, _scratch: Scratch) -> float:
            odd_part = 0.0
            for block in range(start, stop):
                column = whole[block, :ly]
                forward(column.reshape(-1), self.column_plan)
                # While the column is in the cache: its real part may be all that is needed.
                real[block] = column[:, :1]
                odd_part = max(odd_part, float(column[:, 1].max()), -float(column[:, 1].min()))
            return odd_part

        self.run(along_rows, blocks)
        odd_part = max(self.run(along_columns, self.column_blocks)) * self.transfer_scale
        symmetric = odd_part < SYMMETRIC_TO * float(np.abs(kernel).sum())
        return real if symmetric else _aligned_copy(whole[:, :ly])


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
