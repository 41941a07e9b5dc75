"""Fast Fourier transforms of sixteen signals at a time, in single precision, with all data in the cache.

These are mixed-radix Cooley-Tukey transforms in place. The forward transform decimates in frequency; its input is in
natural order and its output in digit-reversed order. The inverse decimates in time, from digit-reversed back to natural
order. A convolution multiplies the two spectra between these transforms, so the frequencies need not be sorted.
`Plan.place` gives the index of each frequency.

Sixteen signals ("lanes") are stored side by side, so each butterfly is one operation on sixteen neighbours. A buffer is
a flat float32 array, [index][re, im][lane]. A butterfly is written down as vector instructions (`butterflies`). The
radix-4 or radix-2 pass comes before the radix-8 passes.

There is one pass for each radix. A plan holds the addresses of its passes, and `forward` and `inverse` call the passes
by address. A pass is compiled when the first plan needs it, and kernels that transform do not contain copies of the
passes: otherwise the first deconvolution of an installation would compile all passes, five times.

    X[k] = sum_j x[j] exp(-2 pi i j k / L)                                                          Eq. (1)

A pass of radix r on length n = r m replaces the legs x[p + q m], q = 0 .. r-1, by DFT_r(legs)[q] exp(-2 pi i p q / n).
The inverse of Eq. (1), times L, is the same transform with real and imaginary parts exchanged in input and output.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import Addressed, Later, compiled, compiled_at_address

if TYPE_CHECKING:
    from psfcore.convolution import butterflies as instructions
else:
    instructions = Later("psfcore.convolution.butterflies")

# A pass gets the buffer, its twiddle factors, the length of the transform, and the length of its own blocks.
_SIGNATURE = "void(CPointer(float32), CPointer(float32), int64, int64)"
_RADICES = (2, 3, 4, 5, 8)

Flat = NDArray[np.float32]


class Plan(NamedTuple):
    """How to transform signals of one length, as one argument of the kernels: passes, twiddle factors, and order of the
    result.

    `passes[0]` and `passes[1]` hold the addresses of the passes of `forward` and `inverse`, `lengths` the lengths of
    their blocks. `place[k]` is the index of frequency k after a forward transform.
    """

    length: int
    passes: NDArray[np.int64]
    lengths: NDArray[np.int64]
    twiddles: Flat
    offsets: NDArray[np.int64]
    place: NDArray[np.int64]


@lru_cache(maxsize=16)
def make_plan(length: int) -> Plan:
    """The plan for a length that `good_length` returned. Compiles the passes that are not kept on disk yet."""
    radices = _radices(length)
    lengths, offsets, twiddles = [], [], []
    n, offset = length, 0
    frequency = np.zeros(1, dtype=np.int64)
    scale = 1
    for radix in radices:
        m = n // radix
        angle = -2 * np.pi * np.outer(np.arange(m), np.arange(1, radix)) / n
        table = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
        lengths.append(n)
        offsets.append(offset)
        twiddles.append(table.ravel())
        offset += table.size
        # Block q of this pass holds the frequencies congruent to q modulo the radix: the first pass gives the lowest
        # digit.
        frequency = (frequency[:, None] + scale * np.arange(radix)[None, :]).ravel()
        scale *= radix
        n = m
    place = np.empty(length, dtype=np.int64)
    place[frequency] = np.arange(length)
    return Plan(
        length=length,
        passes=np.array(
            [[kernels[radix].address for radix in radices] for kernels in (_FORWARD, _INVERSE)],
            dtype=np.int64,
        ),
        lengths=np.array(lengths, dtype=np.int64),
        twiddles=np.concatenate(twiddles),
        offsets=np.array(offsets, dtype=np.int64),
        place=place,
    )


def _radices(length: int) -> list[int]:
    """Radices of the passes: first 5 or 3 (3 up to twice), then 4 or 2 if needed, then 8."""
    radices, rest = [], length
    for odd in (5, 3):
        while rest % odd == 0:
            radices.append(odd)
            rest //= odd
    eights = 0
    while rest % 8 == 0:
        eights += 1
        rest //= 8
    if rest > 1:
        radices.append(rest)
    if rest not in (1, 2, 4):
        raise ValueError(f"expected a length 2^a, 3 2^a, 5 2^a or 9 2^a; got {length}")
    return radices + [8] * eights


def _make_pass(radix: int, backward: int) -> Addressed:
    """Make the pass of a radix, for blocks of any length.

    Parameters
    ----------
    backward
        The direction: 1 for `inverse`, 0 for `forward`.
    """
    factors = 2 * (radix - 1)

    @compiled_at_address(_SIGNATURE, name=f"{'backward' if backward else 'forward'}_{radix}")
    def run(buffer: Flat, table: Flat, length: int, n: int) -> None:
        m = n // radix
        for base in range(0, length, n):
            for p in range(m):
                instructions.butterfly(buffer, base + p, m, table, p * factors, radix, backward)

    return run


_FORWARD = {radix: _make_pass(radix, 0) for radix in _RADICES}
_INVERSE = {radix: _make_pass(radix, 1) for radix in _RADICES}


@compiled()
def forward(x: Flat, plan: Plan) -> None:
    """Compute Eq. (1) for sixteen lanes, in place. The frequency k is at index `plan.place[k]` of the result."""
    for stage in range(plan.lengths.size):
        instructions.call(
            plan.passes[0, stage], x, plan.twiddles[plan.offsets[stage] :], plan.length, plan.lengths[stage]
        )


@compiled()
def inverse(x: Flat, plan: Plan) -> None:
    """Compute `length` times the inverse of `forward`, in place. The result is in natural order."""
    for stage in range(plan.lengths.size - 1, -1, -1):
        instructions.call(
            plan.passes[1, stage], x, plan.twiddles[plan.offsets[stage] :], plan.length, plan.lengths[stage]
        )
