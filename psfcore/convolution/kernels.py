"""The kernels of the convolution engine: compiled functions that transform blocks of rows and of columns.

Each processes the blocks from `start` to `stop` - 1. `psfcore.convolution.engine` describes the blocks and the layout
of fields and spectra.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import Later, compiled
from psfcore.convolution.fft_kernels import Plan, forward, inverse
from psfcore.convolution.lengths import LANES

if TYPE_CHECKING:
    from psfcore.convolution import lanes as instructions
else:
    instructions = Later("psfcore.convolution.lanes")

BLOCK_ROWS = 2 * LANES
_SIZE = 2 * LANES  # numbers of sixteen complex values

Single = NDArray[np.float32]


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
                p, q = place[k] * _SIZE, place[(length - k) % length] * _SIZE
                instructions.split(buffer, corner, p, q, kk * 2 * _SIZE)
        row = group * rows + block * BLOCK_ROWS
        for part in range(4):
            here = (row + part // 2 * LANES) * _SIZE + part % 2 * LANES
            instructions.transpose(corner, spectrum, part * LANES, 2 * _SIZE, here, _SIZE)


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
            instructions.transpose(spectrum, corner, here, _SIZE, part * LANES, 2 * _SIZE)
        for k in range(group * LANES, min((group + 1) * LANES, last + 1)):
            at = (k - group * LANES) * 2 * _SIZE
            instructions.join(corner, buffer, at, place[k] * _SIZE, place[(length - k) % length] * _SIZE)
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
def rows_forward(lines: Lines, start: int, stop: int, lanes: Single, first_block: int) -> None:
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
def rows_inverse(lines: Lines, start: int, stop: int, lanes: Single, first_block: int) -> None:
    """Transform blocks of rows back into `lanes`, whose block 0 is the block `first_block` of the spectrum."""
    for block in range(start, stop):
        rows_from_spectrum(lines, first_block + block)
        copy_numbers(lines.buffer, lanes[block].reshape(-1), lanes.shape[1] * _SIZE)


@compiled()
def rows_cut(lines: Lines, start: int, stop: int, nx: int, ny: int) -> None:
    """Transform blocks of rows back, set what is beyond a field of ny rows and nx columns to 0, and transform them."""
    for block in range(start, stop):
        clear_rows_beyond(rows_from_spectrum(lines, block), ny - block * BLOCK_ROWS, nx)
        rows_to_spectrum(lines, block, nx)


@compiled()
def clear_rows_beyond(z: Single, rows: int, nx: int) -> None:
    """Set the rows of a block [x, half, lane] beyond the number of rows to 0."""
    for row in range(max(rows, 0), BLOCK_ROWS):
        for i in range(nx):
            z[i, row // LANES, row % LANES] = np.float32(0.0)


@compiled()
def _multiply(buffer: Single, transfer: Single, group: int, length: int, conjugate: bool) -> None:
    """Multiply transformed columns by the transfer function, real or complex, or by its conjugate."""
    for k in range(length):
        if transfer.shape[2] == 1:
            instructions.scale(buffer, transfer, k * _SIZE, (group * length + k) * LANES)
        elif conjugate:
            instructions.turn_back(buffer, transfer, k * _SIZE, (group * length + k) * _SIZE)
        else:
            instructions.turn(buffer, transfer, k * _SIZE, (group * length + k) * _SIZE)


@compiled()
def columns(lines: Lines, start: int, stop: int, transfer: Single, conjugate: bool) -> None:
    """Convolve columns."""
    buffer, length = lines.buffer, lines.plan.length
    # A block may have more rows than the transform; the rows beyond the transform are padding and stay zero.
    filled = min(lines.spectrum.shape[1], length) * _SIZE
    for group in range(start, stop):
        column = lines.spectrum[group].reshape(-1)
        copy_numbers(column, buffer, filled)
        clear_beyond(buffer, filled, length)
        forward(buffer, lines.plan)
        _multiply(buffer, transfer, group, length, conjugate)
        inverse(buffer, lines.plan)
        copy_numbers(buffer, column, filled)


@compiled()
def columns_forward(lines: Lines, start: int, stop: int, whole: Single) -> None:
    """The first half of `columns`, into a spectrum along both axes."""
    filled = min(lines.spectrum.shape[1], lines.plan.length) * _SIZE
    for group in range(start, stop):
        column = whole[group].reshape(-1)
        copy_numbers(lines.spectrum[group].reshape(-1), column, filled)
        clear_beyond(column, filled, lines.plan.length)
        forward(column, lines.plan)


@compiled()
def columns_inverse(lines: Lines, start: int, stop: int, whole: Single, transfer: Single) -> None:
    """The second half of `columns`, from a spectrum along both axes."""
    buffer, length = lines.buffer, lines.plan.length
    filled = min(lines.spectrum.shape[1], length) * _SIZE
    for group in range(start, stop):
        copy_numbers(whole[group].reshape(-1), buffer, length * _SIZE)
        _multiply(buffer, transfer, group, length, False)
        inverse(buffer, lines.plan)
        copy_numbers(buffer, lines.spectrum[group].reshape(-1), filled)
