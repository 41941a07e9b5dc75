"""Fast convolution with a PSF that changes over the field, and its adjoint, in single precision.

    H f = K0 * f + sum over m of K_m * (w_m f)                         Eq. (1)
    H^T y = K0 corr y + sum over m of w_m (K_m corr y)                 Eq. (2)
    w_m = u^a v^b                                                      Eq. (3)

u depends on x alone, and v on y alone. Therefore u^a is multiplied to the rows before they are transformed, and v^b to
the transformed rows before their columns are transformed. All terms with the same power a share the transforms of their
rows, and terms without u those of K0. With A powers of u other than 0 and M terms, H needs 1 + A transforms of the rows
forward and one back, and 1 + M transforms of the columns forward and one back; H^T needs as many in the other
direction. One linear term costs one and a half times as many transforms as a PSF without terms.

| symbol | name |
|---|---|
| K0, K_m | kernel, kernels of terms |
| w_m, u, v, a, b | Eq. (1) of `psfcore.psf_field` |
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Vector
from psfcore.compiled import Later, compiled
from psfcore.convolution.engine import Engine, Scratch, aligned
from psfcore.convolution.fft_kernels import Plan, forward, inverse
from psfcore.convolution.kernels import FieldLines, Single, add_weighed, clear_beyond, copy_numbers, weigh
from psfcore.convolution.lengths import LANES
from psfcore.convolution.offsets import needed_kernel
from psfcore.psf_field import FieldTerm, common_shape, factors_at, nine_places

if TYPE_CHECKING:
    from psfcore.convolution import lanes as instructions
else:
    instructions = Later("psfcore.convolution.lanes")

_SIZE = 2 * LANES


class FieldEngine(Engine):
    """Eqs. (1) and (2) for fields of one shape. The attribute `transfer` is that of K0.

    Parameters
    ----------
    psf_kernel
        The weights K0 [y, x].
    terms
        The terms; at least one.
    coordinates
        The coordinates u (nx,) and v (ny,) of the pixels of the field.
    field_shape, span, threads
        As for `Engine`.
    """

    _buffers = 2

    def __init__(
        self,
        psf_kernel: NDArray[np.floating],
        terms: Sequence[FieldTerm],
        coordinates: tuple[Vector, Vector],
        field_shape: tuple[int, int],
        *,
        span: tuple[int, int] | None = None,
        threads: int = 1,
    ) -> None:
        kernels = common_shape([np.asarray(psf_kernel, np.float64), *(term.kernel for term in terms)])
        super().__init__(kernels[0], field_shape, span=span, threads=threads)
        others = [self._transfer_function(*needed_kernel(one, self._joined)) for one in kernels[1:]]
        parts = max(one.shape[2] for one in (self.transfer, *others))
        self._transfers = aligned(len(kernels), *self.transfer.shape[:2], parts, LANES)
        for target, one in zip(self._transfers, (self.transfer, *others), strict=True):
            target[:, :, : one.shape[2]] = one
        self.transfer = self._transfers[0]
        self._of_terms = tuple(terms)
        u, v = coordinates
        powers = sorted({term.x_power for term in terms} - {0})
        self._factors = np.array([u**power for power in powers], np.float32).reshape(len(powers), u.size)
        self._source = np.array([0, *([0, *powers].index(term.x_power) for term in terms)])
        self._along_y = np.zeros((len(kernels), self.row_blocks * 2 * LANES), np.float32)
        # Whether a term is the first one of its spectrum.
        self._opens = np.isin(np.arange(len(kernels)), np.unique(self._source, return_index=True)[1])
        self._to_rows, self._spectra = 0, (1 + len(powers),)
        self._along_y[:, : v.size] = [v**power for power in (0, *(term.y_power for term in terms))]

    @property
    def nbytes(self) -> int:
        """Memory that the engine holds between two deconvolutions, in bytes."""
        return super().nbytes + self._transfers[1:].nbytes

    def local_transfers(self, rows: int) -> Iterator[Single]:
        """The first rows of the transfer functions at nine places of the detector."""
        for factors in factors_at(self._of_terms, nine_places()):
            yield np.tensordot(factors.astype(np.float32), self._transfers[:, :, :rows], 1)

    def columns(self, *, adjoint: bool) -> None:
        """The columns of Eq. (1) or Eq. (2): transform them, multiply by the transfer functions, and transform back."""
        kernel = _columns_adjoint if adjoint else _columns_forward
        terms = (self._transfers, self._source, self._along_y, *([self._opens] if adjoint else []))
        self._stage(kernel, self.column_plan, self.column_blocks, *terms)
        self._to_rows = len(self._factors) if adjoint else 0

    def multiply_columns(self, transfer: Single, *, conjugate: bool = False) -> None:
        """As `Engine.multiply_columns`, on the spectrum of the field."""
        super().multiply_columns(transfer, conjugate=conjugate)
        self._to_rows = 0

    def transform_columns(self) -> None:
        """Raise TypeError: `multiply_kept` applies one filter, and would leave the terms out."""
        raise TypeError("expected an engine for a PSF without terms of the field")

    def row_stage(
        self,
        kernel: Callable[..., None],
        *fields: object,
        before_h: bool = True,
        blocks: int | None = None,
    ) -> None:
        """As `Engine.row_stage`. The rows are those that the last call of `columns` or `multiply_columns` left."""
        from_rows = len(self._factors) if before_h else 0
        blocks = self.row_blocks if blocks is None else blocks
        self._stage(kernel, self.row_plan, blocks, *fields, from_rows=from_rows)

    def _stage(
        self, kernel: Callable[..., None], plan: Plan, blocks: int, *fields: object, from_rows: int = 0
    ) -> None:
        spectra = self._spectrum

        def work(start: int, stop: int, scratch: Scratch) -> None:
            buffer, second = scratch.buffer.reshape(2, -1)
            more = (second, spectra[1:], self._factors, from_rows, self._to_rows)
            kernel(FieldLines(spectra[0], buffer, scratch.corner, plan, *more), start, stop, *fields)

        self.run(work, blocks)


@compiled()
def _columns_forward(
    lines: FieldLines,
    start: int,
    stop: int,
    transfers: Single,
    source: NDArray[np.int64],
    factors: Single,
) -> None:
    """The columns of Eq. (1). The result is in the spectrum of the field.

    Parameters
    ----------
    transfers
        Transfer functions, [term] and then as `Engine.transfer`.
    source
        The number of the spectrum of each term, 0 for that of the field.
    factors
        The factors v^b [term][row].
    """
    buffer, total, length = lines.buffer, lines.second, lines.plan.length
    rows = min(lines.spectrum.shape[1], length)
    for group in range(start, stop):
        for m in range(source.size):
            spectrum = lines.spectra[source[m] - 1] if source[m] > 0 else lines.spectrum
            column = buffer if m > 0 else total
            weigh(spectrum[group].reshape(-1), factors[m], column, rows)
            clear_beyond(column, rows * _SIZE, length)
            forward(column, lines.plan)
            transfer = transfers[m]
            for k in range(length):
                if m == 0 and transfer.shape[2] == 1:
                    instructions.scale(total, transfer, k * _SIZE, (group * length + k) * LANES)
                elif m == 0:
                    instructions.turn(total, transfer, k * _SIZE, (group * length + k) * _SIZE)
                elif transfer.shape[2] == 1:
                    instructions.add_scaled(buffer, transfer, total, k * _SIZE, (group * length + k) * LANES)
                else:
                    instructions.add_turned(buffer, transfer, total, k * _SIZE, (group * length + k) * _SIZE)
        inverse(total, lines.plan)
        copy_numbers(total, lines.spectrum[group].reshape(-1), rows * _SIZE)


@compiled()
def _columns_adjoint(
    lines: FieldLines,
    start: int,
    stop: int,
    transfers: Single,
    source: NDArray[np.int64],
    factors: Single,
    opens: NDArray[np.bool_],
) -> None:
    """The columns of Eq. (2), from the spectrum of the field. The results are in all spectra.

    The other parameters are those of `_columns_forward`.

    Parameters
    ----------
    opens
        Whether a term is the first one of its spectrum.
    """
    once, length, last = lines.second, lines.plan.length, source.size - 1
    rows = min(lines.spectrum.shape[1], length)
    for group in range(start, stop):
        copy_numbers(lines.spectrum[group].reshape(-1), once, rows * _SIZE)
        clear_beyond(once, rows * _SIZE, length)
        forward(once, lines.plan)
        for m in range(source.size):
            buffer = lines.buffer if m < last else once  # the last term needs no copy
            if m < last:
                copy_numbers(once, buffer, length * _SIZE)
            transfer = transfers[m]
            for k in range(length):
                if transfer.shape[2] == 1:
                    instructions.scale(buffer, transfer, k * _SIZE, (group * length + k) * LANES)
                else:
                    instructions.turn_back(buffer, transfer, k * _SIZE, (group * length + k) * _SIZE)
            inverse(buffer, lines.plan)
            spectrum = lines.spectra[source[m] - 1] if source[m] > 0 else lines.spectrum
            column = spectrum[group].reshape(-1)
            if opens[m]:
                weigh(buffer, factors[m], column, rows)
            else:
                add_weighed(buffer, factors[m], column, rows)
