"""Fast Fourier transforms of sixteen signals at a time, in single precision, with all data in the cache.

These are mixed-radix Cooley-Tukey transforms in place. The forward transform decimates in frequency; its input is in
natural order and its output in digit-reversed order. The inverse decimates in time, from digit-reversed back to natural
order. A convolution multiplies the two spectra between these transforms, so the frequencies need not be sorted.
`Plan.place` gives the index of each frequency.

Sixteen signals ("lanes") are stored side by side, so each butterfly is one operation on sixteen neighbours. A buffer is
a flat float32 array, [index][re, im][lane]. A butterfly is written down as vector instructions (`_butterfly`). If it
were a loop over the lanes, the compiler would have to prove for each length that the inputs of a butterfly ("legs") do
not overlap, which takes most of the time to compile on the first run. The radix-4 or radix-2 pass comes before the
radix-8 passes.

There is one pass for each radix. A plan holds the addresses of its passes, and `forward` and `inverse` call the passes
by address. A pass is compiled when the first plan needs it, and kernels that transform do not contain copies of the
passes: otherwise the first deconvolution of an installation would compile all passes, five times.

    X[k] = sum_j x[j] exp(-2 pi i j k / L)                                                          Eq. (1)

A pass of radix r on length n = r m replaces the legs x[p + q m], q = 0 .. r-1, by DFT_r(legs)[q] exp(-2 pi i p q / n).
The inverse of Eq. (1), times L, is the same transform with real and imaginary parts exchanged in input and output.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.base import BaseContext
from numba.core.typing.templates import Signature
from numpy.typing import NDArray

from psfcore.compiled import Addressed, compiled, compiled_at_address
from psfcore.convolution.lanes import (
    LANES,
    Memory,
    Vector,
    Written,
    constant,
    instruction,
    instruction_of_constants,
    parts,
)

_HALF = np.float32(0.5)
_HALF_ROOT = np.float32(np.sqrt(0.5))
_HALF_ROOT_3 = np.float32(np.sqrt(0.75))
_COS_FIFTH, _COS_TWO_FIFTHS = (np.float32(np.cos(2 * np.pi * q / 5)) for q in (1, 2))
_SIN_FIFTH, _SIN_TWO_FIFTHS = (np.float32(np.sin(2 * np.pi * q / 5)) for q in (1, 2))

# A pass gets the buffer, its twiddle factors, the length of the transform, and the length of its own blocks.
_PASS = types.void(types.CPointer(types.float32), types.CPointer(types.float32), types.int64, types.int64)

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


# Butterflies; each leg and each factor is a pair of real and imaginary part ---------------------------------------

Leg = tuple[Vector, Vector]


def _times(a: Leg, w: Leg, first: int = 0) -> Leg:
    """The product of two complex numbers.

    Parameters
    ----------
    first
        The product of the imaginary part, ar * wi + ai * wr, for the fused multiply-add, which rounds product and sum
        once: 0 for ar * wi, 1 for ai * wr.
    """
    (ar, ai), (wr, wi) = a, w
    real = ar.times_plus(wr, -(ai * wi))
    return real, ai.times_plus(wr, ar * wi) if first else ar.times_plus(wi, ai * wr)


def _dft2(a: Leg, b: Leg) -> list[Leg]:
    return [(a[0] + b[0], a[1] + b[1]), (a[0] - b[0], a[1] - b[1])]


def _dft3(a: Leg, b: Leg, c: Leg) -> list[Leg]:
    (ar, ai), (br, bi), (cr, ci) = a, b, c
    sr, si = br + cr, bi + ci
    dr, di = _HALF_ROOT_3 * (bi - ci), _HALF_ROOT_3 * (cr - br)
    tr, ti = (s.times_plus(s.like(-_HALF), a) for s, a in ((sr, ar), (si, ai)))
    return [(ar + sr, ai + si), (tr + dr, ti + di), (tr - dr, ti - di)]


def _dft4(a: Leg, b: Leg, c: Leg, d: Leg) -> list[Leg]:
    (ar, ai), (br, bi), (cr, ci), (dr, di) = a, b, c, d
    sr, si, tr, ti = ar + cr, ai + ci, ar - cr, ai - ci
    ur, ui, vr, vi = br + dr, bi + di, br - dr, bi - di
    return [(sr + ur, si + ui), (tr + vi, ti - vr), (sr - ur, si - ui), (tr - vi, ti + vr)]


def _dft5(a: Leg, b: Leg, c: Leg, d: Leg, e: Leg) -> list[Leg]:
    (pr, pi), (ur, ui) = _dft2(b, e)
    (qr, qi), (vr, vi) = _dft2(c, d)

    def even(near: np.float32, far: np.float32) -> Leg:
        real, imaginary = (
            p.times_plus(p.like(near), q.times_plus(q.like(far), centre))
            for p, q, centre in ((pr, qr, a[0]), (pi, qi, a[1]))
        )
        return real, imaginary

    def odd(first: np.float32, second: np.float32) -> Leg:
        real, imaginary = (u.times_plus(u.like(first), second * v) for u, v in ((ur, vr), (ui, vi)))
        return real, imaginary

    (er, ei), (fr, fi) = even(_COS_FIFTH, _COS_TWO_FIFTHS), even(_COS_TWO_FIFTHS, _COS_FIFTH)
    (gr, gi), (hr, hi) = odd(_SIN_FIFTH, _SIN_TWO_FIFTHS), odd(_SIN_TWO_FIFTHS, -_SIN_FIFTH)
    outer = [(er + gi, ei - gr), (fr + hi, fi - hr), (fr - hi, fi + hr), (er - gi, ei + gr)]
    return [(a[0] + pr + qr, a[1] + pi + qi), *outer]


def _dft8(*legs: Leg) -> list[Leg]:
    sums, differences = zip(*(_dft2(legs[q], legs[q + 4]) for q in range(4)), strict=True)
    even = _dft4(*sums)
    # Odd outputs: legs multiplied by exp(-2 pi i q / 8).
    b, (dr, di), (fr, fi), (hr, hi) = differences
    h = _HALF_ROOT
    odd = _dft4(b, (h * (dr + di), h * (di - dr)), (fi, -fr), (h * (hi - hr), -h * (hr + hi)))
    return [leg for pair in zip(even, odd, strict=True) for leg in pair]


# Which of two products is rounded with their sum makes no difference for the accuracy. For these legs of a forward pass
# it is the other one, because results must be those of earlier versions, bit for bit.
_ROUNDED_LAST = {4: (1, 3), 8: (2, 6)}
_DFT: dict[int, Callable[..., list[Leg]]] = {2: _dft2, 3: _dft3, 4: _dft4, 5: _dft5, 8: _dft8}


@instruction_of_constants
def _butterfly(
    _: object,
    x: types.Type,
    first: types.Type,
    step: types.Type,
    table: types.Type,
    at: types.Type,
    radix: types.IntegerLiteral,
    backward: types.IntegerLiteral,
) -> Written:
    """One butterfly on all lanes: the legs are the elements first + q step of the buffer x.

    The factors of the legs 1, 2, ... begin at table[at]. radix and backward are constants; backward = 1: the inverse,
    which exchanges real and imaginary parts.
    """
    legs, inverse = range(radix.literal_value), bool(backward.literal_value)
    real, imaginary = (LANES, 0) if inverse else (0, LANES)

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Sequence[ir.Value]
    ) -> ir.Value:
        buffer, first, step, table, at = arguments[:5]
        memory, table = Memory(builder, buffer), Memory(builder, table)
        size = constant(2 * LANES)
        places = [builder.mul(builder.add(first, builder.mul(step, constant(q))), size) for q in legs]
        for lane in parts():
            r, i = lane + real, lane + imaginary
            values = [(memory.load(place, r), memory.load(place, i)) for place in places]
            factors = [(table.everywhere(at, 2 * q - 2), table.everywhere(at, 2 * q - 1)) for q in legs[1:]]
            rounded = [0 if inverse else int(q in _ROUNDED_LAST.get(len(legs), ())) for q in legs[1:]]
            if inverse:
                values[1:] = map(_times, values[1:], factors, rounded)
            values = _DFT[len(legs)](*values)
            if not inverse:
                values[1:] = map(_times, values[1:], factors, rounded)
            for place, value in zip(places, values, strict=True):
                memory.store(value[0], place, r)
                memory.store(value[1], place, i)
        return context.get_dummy_value()

    number = types.int64
    return types.void(x, number, number, table, number, radix, backward), generate


def _make_pass(radix: int, backward: int) -> Addressed:
    """Make the pass of a radix, for blocks of any length.

    Parameters
    ----------
    backward
        The direction: 1 for `inverse`, 0 for `forward`.
    """
    factors = 2 * (radix - 1)

    @compiled_at_address(_PASS, name=f"{'backward' if backward else 'forward'}_{radix}")
    def run(buffer: Flat, table: Flat, length: int, n: int) -> None:
        m = n // radix
        for base in range(0, length, n):
            for p in range(m):
                _butterfly(buffer, base + p, m, table, p * factors, radix, backward)

    return run


_FORWARD = {radix: _make_pass(radix, 0) for radix in _DFT}
_INVERSE = {radix: _make_pass(radix, 1) for radix in _DFT}


@instruction
def _call(
    _: object, address: types.Type, x: types.Type, twiddles: types.Type, length: types.Type, n: types.Type
) -> Written:
    """Call the pass at an address."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Sequence[ir.Value]
    ) -> ir.Value:
        at, *arrays, length, n = arguments
        kinds = signature.args[1:3]
        pointers = [
            context.make_array(kind)(context, builder, array).data
            for kind, array in zip(kinds, arrays, strict=True)
        ]
        number, pointer = ir.IntType(64), pointers[0].type
        function = ir.FunctionType(ir.VoidType(), [pointer, pointer, number, number])
        builder.call(builder.inttoptr(at, function.as_pointer()), [*pointers, length, n])
        return context.get_dummy_value()

    return types.void(types.int64, x, twiddles, types.int64, types.int64), generate


@compiled()
def forward(x: Flat, plan: Plan) -> None:
    """Compute Eq. (1) for sixteen lanes, in place. The frequency k is at index `plan.place[k]` of the result."""
    for stage in range(plan.lengths.size):
        _call(
            plan.passes[0, stage], x, plan.twiddles[plan.offsets[stage] :], plan.length, plan.lengths[stage]
        )


@compiled()
def inverse(x: Flat, plan: Plan) -> None:
    """Compute `length` times the inverse of `forward`, in place. The result is in natural order."""
    for stage in range(plan.lengths.size - 1, -1, -1):
        _call(
            plan.passes[1, stage], x, plan.twiddles[plan.offsets[stage] :], plan.length, plan.lengths[stage]
        )
