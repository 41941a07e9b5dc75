"""The butterflies of the passes (`fft_kernels`), and the call of a pass: vector instructions for kernels (`@compiled`).

If a butterfly were a loop over the lanes, the compiler would have to prove for each length that the inputs of a
butterfly ("legs") do not overlap, which takes most of the time to compile on the first run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.base import BaseContext
from numba.core.typing.templates import Signature

from psfcore.convolution.lanes import (
    Memory,
    Vector,
    Written,
    constant,
    instruction,
    instruction_of_constants,
    parts,
)
from psfcore.convolution.lengths import LANES

_HALF = np.float32(0.5)
_HALF_ROOT = np.float32(np.sqrt(0.5))
_HALF_ROOT_3 = np.float32(np.sqrt(0.75))
_COS_FIFTH, _COS_TWO_FIFTHS = (np.float32(np.cos(2 * np.pi * q / 5)) for q in (1, 2))
_SIN_FIFTH, _SIN_TWO_FIFTHS = (np.float32(np.sin(2 * np.pi * q / 5)) for q in (1, 2))

# Each leg and each factor is a pair of real and imaginary part.
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
def butterfly(
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


@instruction
def call(
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
