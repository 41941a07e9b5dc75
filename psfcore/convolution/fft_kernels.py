"""Fast Fourier transforms of sixteen signals at a time, in single precision, with all data in the cache.

These are mixed-radix Cooley-Tukey transforms in place. The forward transform decimates in frequency; its input is in
natural order and its output in digit-reversed order. The inverse decimates in time, from digit-reversed back to natural
order. A convolution multiplies the two spectra between these transforms, so the frequencies need not be sorted.
`Plan.frequency` gives the frequency of each index.

Sixteen signals ("lanes") are stored side by side, so each butterfly is one operation on sixteen neighbours. A buffer is
a flat float32 array, [index][re, im][lane]. The compiler turns the innermost loop, which runs over the lanes, into
vector instructions. If a butterfly has more than three inputs ("legs"), this works only if the distances between the
legs are constants. Therefore there is one compiled function for each length of a radix-8 or radix-4 pass. The radix-4
or radix-2 pass comes before the radix-8 passes. This order keeps the number of lengths small, and so the time to
compile on the first run. Indices are unsigned, because a check for negative indices would prevent vector instructions.

A plan holds the addresses of its passes, and `forward` and `inverse` call the passes by address. A pass is compiled when
the first plan needs it, and kernels that transform do not contain copies of the passes: otherwise the first
deconvolution of an installation would compile all passes of all lengths, five times.

    X[k] = sum_j x[j] exp(-2 pi i j k / L)                                                          Eq. (1)

A pass of radix r on length n = r m replaces the legs x[p + q m], q = 0 .. r-1, by DFT_r(legs)[q] exp(-2 pi i p q / n).
The inverse of Eq. (1), times L, is the same transform with real and imaginary parts exchanged in input and output.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from psfcore.compiled import Addressed, compiled, compiled_at_address

LANES = 16
_HALF_ROOT = np.float32(np.sqrt(0.5))
_HALF_ROOT_3 = np.float32(np.sqrt(0.75))
_W = np.uint64(LANES)
# Of the compiler's options for fast arithmetic, only fused multiply-add is used. Options that assume finite numbers or
# change the order of sums are not used.
_FAST: Any = {"contract"}

# A pass gets the buffer, its twiddle factors, the length of the transform, and the length of its own blocks.
_PASS = types.void(types.CPointer(types.float32), types.CPointer(types.float32), types.int64, types.int64)

Flat = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Plan:
    """How to transform signals of one length: radix and length of each pass, twiddle factors, and order of the result.

    `passes[0]` and `passes[1]` hold the addresses of the passes of `forward` and `inverse`.

    `frequency[i]` is the frequency at index i after a forward transform. `place` is the inverse permutation:
    `place[k]` is the index of frequency k.
    """

    length: int
    radices: NDArray[np.int64]
    passes: NDArray[np.int64]
    lengths: NDArray[np.int64]
    twiddles: Flat
    offsets: NDArray[np.int64]
    frequency: NDArray[np.int64]
    place: NDArray[np.int64]

    @property
    def numbers(self) -> tuple[Any, ...]:
        """The arguments of `forward` and `inverse` after the buffer."""
        return self.length, self.passes, self.lengths, self.twiddles, self.offsets


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
        # Block q of this pass holds the frequencies congruent to q modulo the radix: the first pass gives the lowest digit.
        frequency = (frequency[:, None] + scale * np.arange(radix)[None, :]).ravel()
        scale *= radix
        n = m
    place = np.empty(length, dtype=np.int64)
    place[frequency] = np.arange(length)
    return Plan(
        length=length,
        radices=np.array(radices, dtype=np.int64),
        passes=np.array(
            [
                [_pass(radix, n, inverse).address for radix, n in zip(radices, lengths, strict=True)]
                for inverse in (False, True)
            ],
            dtype=np.int64,
        ),
        lengths=np.array(lengths, dtype=np.int64),
        twiddles=np.concatenate(twiddles),
        offsets=np.array(offsets, dtype=np.int64),
        frequency=frequency,
        place=place,
    )


def _radices(length: int) -> list[int]:
    """Radices of the passes: first 3 (up to twice), then 4 or 2 if needed, then 8. This order gives few lengths."""
    radices, rest = [], length
    while rest % 3 == 0:
        radices.append(3)
        rest //= 3
    eights = 0
    while rest % 8 == 0:
        eights += 1
        rest //= 8
    if rest > 1:
        radices.append(rest)
    if rest not in (1, 2, 4):
        raise ValueError(f"expected a length 2^a, 3 2^a or 9 2^a; got {length}")
    return radices + [8] * eights


# Butterflies of single numbers; the compiler applies them to all lanes ---------------------------------------


@njit(inline="always", fastmath=_FAST)
def _dft4(ar, ai, br, bi, cr, ci, dr, di):  # type: ignore[no-untyped-def]
    sr, si, tr, ti = ar + cr, ai + ci, ar - cr, ai - ci
    ur, ui, vr, vi = br + dr, bi + di, br - dr, bi - di
    return sr + ur, si + ui, tr + vi, ti - vr, sr - ur, si - ui, tr - vi, ti + vr


@njit(inline="always", fastmath=_FAST)
def _times(ar, ai, wr, wi):  # type: ignore[no-untyped-def]
    return ar * wr - ai * wi, ar * wi + ai * wr


def _radix8(n: int, inverse: bool) -> Addressed:
    """Make the radix-8 pass for blocks of length n; n is a constant for the compiler."""
    m = n // 8
    h = _HALF_ROOT
    M1, M2, M3, M4, M5, M6, M7 = (np.uint64(q * m * 2 * LANES) for q in range(1, 8))
    # The inverse exchanges real and imaginary parts.
    R, I = (np.uint64(LANES), np.uint64(0)) if inverse else (np.uint64(0), np.uint64(LANES))  # noqa: E741

    @compiled_at_address(_PASS, name=f"forward_{n}", fastmath=_FAST)
    def forward(buffer, twiddles, length, _n):  # type: ignore[no-untyped-def]
        x, tw = carray(buffer, (length * 2 * LANES,)), carray(twiddles, (14 * m,))
        for base in range(0, length, n):
            for p in range(m):
                o = np.uint64((base + p) * 2 * LANES)
                t = p * 14
                w1r, w1i, w2r, w2i, w3r, w3i = tw[t], tw[t + 1], tw[t + 2], tw[t + 3], tw[t + 4], tw[t + 5]
                w4r, w4i, w5r, w5i = tw[t + 6], tw[t + 7], tw[t + 8], tw[t + 9]
                w6r, w6i, w7r, w7i = tw[t + 10], tw[t + 11], tw[t + 12], tw[t + 13]
                for w in range(LANES):
                    r = o + np.uint64(w) + R
                    i = o + np.uint64(w) + I
                    ar, ai, br, bi = x[r] + x[r + M4], x[i] + x[i + M4], x[r] - x[r + M4], x[i] - x[i + M4]
                    cr, ci = x[r + M1] + x[r + M5], x[i + M1] + x[i + M5]
                    dr, di = x[r + M1] - x[r + M5], x[i + M1] - x[i + M5]
                    er, ei = x[r + M2] + x[r + M6], x[i + M2] + x[i + M6]
                    fr, fi = x[r + M2] - x[r + M6], x[i + M2] - x[i + M6]
                    gr, gi = x[r + M3] + x[r + M7], x[i + M3] + x[i + M7]
                    hr, hi = x[r + M3] - x[r + M7], x[i + M3] - x[i + M7]
                    y0r, y0i, y2r, y2i, y4r, y4i, y6r, y6i = _dft4(ar, ai, cr, ci, er, ei, gr, gi)
                    # Odd outputs: legs multiplied by exp(-2 pi i q / 8).
                    y1r, y1i, y3r, y3i, y5r, y5i, y7r, y7i = _dft4(
                        br, bi, h * (dr + di), h * (di - dr), fi, -fr, h * (hi - hr), -h * (hr + hi)
                    )
                    x[r], x[i] = y0r, y0i
                    x[r + M1], x[i + M1] = _times(y1r, y1i, w1r, w1i)
                    x[r + M2], x[i + M2] = _times(y2r, y2i, w2r, w2i)
                    x[r + M3], x[i + M3] = _times(y3r, y3i, w3r, w3i)
                    x[r + M4], x[i + M4] = _times(y4r, y4i, w4r, w4i)
                    x[r + M5], x[i + M5] = _times(y5r, y5i, w5r, w5i)
                    x[r + M6], x[i + M6] = _times(y6r, y6i, w6r, w6i)
                    x[r + M7], x[i + M7] = _times(y7r, y7i, w7r, w7i)

    @compiled_at_address(_PASS, name=f"backward_{n}", fastmath=_FAST)
    def backward(buffer, twiddles, length, _n):  # type: ignore[no-untyped-def]
        x, tw = carray(buffer, (length * 2 * LANES,)), carray(twiddles, (14 * m,))
        for base in range(0, length, n):
            for p in range(m):
                o = np.uint64((base + p) * 2 * LANES)
                t = p * 14
                w1r, w1i, w2r, w2i, w3r, w3i = tw[t], tw[t + 1], tw[t + 2], tw[t + 3], tw[t + 4], tw[t + 5]
                w4r, w4i, w5r, w5i = tw[t + 6], tw[t + 7], tw[t + 8], tw[t + 9]
                w6r, w6i, w7r, w7i = tw[t + 10], tw[t + 11], tw[t + 12], tw[t + 13]
                for w in range(LANES):
                    r = o + np.uint64(w) + R
                    i = o + np.uint64(w) + I
                    z0r, z0i = x[r], x[i]
                    z1r, z1i = _times(x[r + M1], x[i + M1], w1r, w1i)
                    z2r, z2i = _times(x[r + M2], x[i + M2], w2r, w2i)
                    z3r, z3i = _times(x[r + M3], x[i + M3], w3r, w3i)
                    z4r, z4i = _times(x[r + M4], x[i + M4], w4r, w4i)
                    z5r, z5i = _times(x[r + M5], x[i + M5], w5r, w5i)
                    z6r, z6i = _times(x[r + M6], x[i + M6], w6r, w6i)
                    z7r, z7i = _times(x[r + M7], x[i + M7], w7r, w7i)
                    ar, ai, br, bi = z0r + z4r, z0i + z4i, z0r - z4r, z0i - z4i
                    cr, ci, dr, di = z1r + z5r, z1i + z5i, z1r - z5r, z1i - z5i
                    er, ei, fr, fi = z2r + z6r, z2i + z6i, z2r - z6r, z2i - z6i
                    gr, gi, hr, hi = z3r + z7r, z3i + z7i, z3r - z7r, z3i - z7i
                    y0r, y0i, y2r, y2i, y4r, y4i, y6r, y6i = _dft4(ar, ai, cr, ci, er, ei, gr, gi)
                    y1r, y1i, y3r, y3i, y5r, y5i, y7r, y7i = _dft4(
                        br, bi, h * (dr + di), h * (di - dr), fi, -fr, h * (hi - hr), -h * (hr + hi)
                    )
                    x[r], x[i], x[r + M1], x[i + M1] = y0r, y0i, y1r, y1i
                    x[r + M2], x[i + M2], x[r + M3], x[i + M3] = y2r, y2i, y3r, y3i
                    x[r + M4], x[i + M4], x[r + M5], x[i + M5] = y4r, y4i, y5r, y5i
                    x[r + M6], x[i + M6], x[r + M7], x[i + M7] = y6r, y6i, y7r, y7i

    return backward if inverse else forward


@compiled_at_address(_PASS, name="forward3", fastmath=_FAST)
def _forward3(buffer, twiddles, length, n):  # type: ignore[no-untyped-def]
    m = n // 3
    x, tw = carray(buffer, (length * 2 * LANES,)), carray(twiddles, (4 * m,))
    for base in range(0, length, n):
        for p in range(m):
            a = x[(base + p) * 2 * LANES :]
            b = x[(base + p + m) * 2 * LANES :]
            c = x[(base + p + 2 * m) * 2 * LANES :]
            w1r, w1i, w2r, w2i = tw[4 * p], tw[4 * p + 1], tw[4 * p + 2], tw[4 * p + 3]
            for w in range(LANES):
                r, i = np.uint64(w), np.uint64(w) + _W
                sr, si = b[r] + c[r], b[i] + c[i]
                dr, di = _HALF_ROOT_3 * (b[i] - c[i]), _HALF_ROOT_3 * (c[r] - b[r])
                tr, ti = a[r] - np.float32(0.5) * sr, a[i] - np.float32(0.5) * si
                a[r], a[i] = a[r] + sr, a[i] + si
                b[r], b[i] = _times(tr + dr, ti + di, w1r, w1i)
                c[r], c[i] = _times(tr - dr, ti - di, w2r, w2i)


@compiled_at_address(_PASS, name="backward3", fastmath=_FAST)
def _backward3(buffer, twiddles, length, n):  # type: ignore[no-untyped-def]
    m = n // 3
    x, tw = carray(buffer, (length * 2 * LANES,)), carray(twiddles, (4 * m,))
    for base in range(0, length, n):
        for p in range(m):
            a = x[(base + p) * 2 * LANES :]
            b = x[(base + p + m) * 2 * LANES :]
            c = x[(base + p + 2 * m) * 2 * LANES :]
            w1r, w1i, w2r, w2i = tw[4 * p], tw[4 * p + 1], tw[4 * p + 2], tw[4 * p + 3]
            for w in range(LANES):
                r, i = np.uint64(w) + _W, np.uint64(w)
                br, bi = _times(b[r], b[i], w1r, w1i)
                cr, ci = _times(c[r], c[i], w2r, w2i)
                sr, si = br + cr, bi + ci
                dr, di = _HALF_ROOT_3 * (bi - ci), _HALF_ROOT_3 * (cr - br)
                tr, ti = a[r] - np.float32(0.5) * sr, a[i] - np.float32(0.5) * si
                a[r], a[i] = a[r] + sr, a[i] + si
                b[r], b[i] = tr + dr, ti + di
                c[r], c[i] = tr - dr, ti - di


def _radix4(n: int, inverse: bool) -> Addressed:
    """Make the radix-4 pass for blocks of length n; n is a constant for the compiler."""
    m = n // 4
    M1, M2, M3 = (np.uint64(q * m * 2 * LANES) for q in range(1, 4))
    R, I = (np.uint64(LANES), np.uint64(0)) if inverse else (np.uint64(0), np.uint64(LANES))  # noqa: E741

    @compiled_at_address(_PASS, name=f"forward4_{n}", fastmath=_FAST)
    def forward(buffer, twiddles, length, _n):  # type: ignore[no-untyped-def]
        x, tw = carray(buffer, (length * 2 * LANES,)), carray(twiddles, (6 * m,))
        for base in range(0, length, n):
            for p in range(m):
                o = np.uint64((base + p) * 2 * LANES)
                t = p * 6
                w1r, w1i, w2r, w2i, w3r, w3i = tw[t], tw[t + 1], tw[t + 2], tw[t + 3], tw[t + 4], tw[t + 5]
                for w in range(LANES):
                    r = o + np.uint64(w) + R
                    i = o + np.uint64(w) + I
                    y0r, y0i, y1r, y1i, y2r, y2i, y3r, y3i = _dft4(
                        x[r], x[i], x[r + M1], x[i + M1], x[r + M2], x[i + M2], x[r + M3], x[i + M3]
                    )
                    x[r], x[i] = y0r, y0i
                    x[r + M1], x[i + M1] = _times(y1r, y1i, w1r, w1i)
                    x[r + M2], x[i + M2] = _times(y2r, y2i, w2r, w2i)
                    x[r + M3], x[i + M3] = _times(y3r, y3i, w3r, w3i)

    @compiled_at_address(_PASS, name=f"backward4_{n}", fastmath=_FAST)
    def backward(buffer, twiddles, length, _n):  # type: ignore[no-untyped-def]
        x, tw = carray(buffer, (length * 2 * LANES,)), carray(twiddles, (6 * m,))
        for base in range(0, length, n):
            for p in range(m):
                o = np.uint64((base + p) * 2 * LANES)
                t = p * 6
                w1r, w1i, w2r, w2i, w3r, w3i = tw[t], tw[t + 1], tw[t + 2], tw[t + 3], tw[t + 4], tw[t + 5]
                for w in range(LANES):
                    r = o + np.uint64(w) + R
                    i = o + np.uint64(w) + I
                    br, bi = _times(x[r + M1], x[i + M1], w1r, w1i)
                    cr, ci = _times(x[r + M2], x[i + M2], w2r, w2i)
                    dr, di = _times(x[r + M3], x[i + M3], w3r, w3i)
                    y0r, y0i, y1r, y1i, y2r, y2i, y3r, y3i = _dft4(x[r], x[i], br, bi, cr, ci, dr, di)
                    x[r], x[i], x[r + M1], x[i + M1] = y0r, y0i, y1r, y1i
                    x[r + M2], x[i + M2], x[r + M3], x[i + M3] = y2r, y2i, y3r, y3i

    return backward if inverse else forward


@compiled_at_address(_PASS, name="forward2", fastmath=_FAST)
def _forward2(buffer, twiddles, length, n):  # type: ignore[no-untyped-def]
    m = n // 2
    x, tw = carray(buffer, (length * 2 * LANES,)), carray(twiddles, (2 * m,))
    for base in range(0, length, n):
        for p in range(m):
            a = x[(base + p) * 2 * LANES :]
            b = x[(base + p + m) * 2 * LANES :]
            wr, wi = tw[2 * p], tw[2 * p + 1]
            for w in range(LANES):
                r, i = np.uint64(w), np.uint64(w) + _W
                dr, di = a[r] - b[r], a[i] - b[i]
                a[r], a[i] = a[r] + b[r], a[i] + b[i]
                b[r], b[i] = _times(dr, di, wr, wi)


@compiled_at_address(_PASS, name="backward2", fastmath=_FAST)
def _backward2(buffer, twiddles, length, n):  # type: ignore[no-untyped-def]
    m = n // 2
    x, tw = carray(buffer, (length * 2 * LANES,)), carray(twiddles, (2 * m,))
    for base in range(0, length, n):
        for p in range(m):
            a = x[(base + p) * 2 * LANES :]
            b = x[(base + p + m) * 2 * LANES :]
            wr, wi = tw[2 * p], tw[2 * p + 1]
            for w in range(LANES):
                r, i = np.uint64(w) + _W, np.uint64(w)
                br, bi = _times(b[r], b[i], wr, wi)
                a[r], a[i], b[r], b[i] = a[r] + br, a[i] + bi, a[r] - br, a[i] - bi


# The passes by radix and length of their blocks. A pass of radix 3 or 2 handles every length.
_ANY = 0
_FORWARD: dict[tuple[int, int], Addressed] = {(3, _ANY): _forward3, (2, _ANY): _forward2}
_INVERSE: dict[tuple[int, int], Addressed] = {(3, _ANY): _backward3, (2, _ANY): _backward2}
for _n in (8, 64, 512, 4096):
    _FORWARD[8, _n], _INVERSE[8, _n] = _radix8(_n, False), _radix8(_n, True)
for _n in (32, 256, 2048, 16384):
    _FORWARD[4, _n], _INVERSE[4, _n] = _radix4(_n, False), _radix4(_n, True)


def _pass(radix: int, n: int, inverse: bool) -> Addressed:
    return (_INVERSE if inverse else _FORWARD)[radix, n if radix in (8, 4) else _ANY]


@intrinsic
def _call(_typing, address, x, twiddles, length, n):  # type: ignore[no-untyped-def]
    """Call the pass at an address."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
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
def forward(x, length, passes, lengths, twiddles, offsets):  # type: ignore[no-untyped-def]
    """Compute Eq. (1) for sixteen lanes, in place. The result is in the order of `Plan.frequency`."""
    for stage in range(lengths.size):
        _call(passes[0, stage], x, twiddles[offsets[stage] :], length, lengths[stage])


@compiled()
def inverse(x, length, passes, lengths, twiddles, offsets):  # type: ignore[no-untyped-def]
    """Compute `length` times the inverse of `forward`, in place. The result is in natural order."""
    for stage in range(lengths.size - 1, -1, -1):
        _call(passes[1, stage], x, twiddles[offsets[stage] :], length, lengths[stage])
