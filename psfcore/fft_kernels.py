"""Fast Fourier transforms of sixteen signals at a time, in single precision and in cache.

Mixed-radix Cooley-Tukey transforms in place. Forward is decimation in frequency, from natural to digit-reversed
order; inverse is decimation in time, back from digit-reversed to natural order. A convolution multiplies
between the two, so nothing is ever put in order (``Plan.frequency`` says which frequency lies where).

Sixteen signals ("lanes") lie side by side, so that each butterfly is the same operation on sixteen neighbours:
a buffer is flat float32, [index][re, im][lane]. The compiler turns the innermost loop over lanes into vector
instructions, which needs the distances between the legs of a butterfly as constants: hence one compiled function
for each length of a radix-8 pass. Unsigned indices spare the check for negative ones, which would prevent it.

    X[k] = sum_j x[j] exp(-2 pi i j k / L)                                                          Eq. (1)

A pass of radix r on length n = r m takes legs x[p + q m], q = 0 .. r-1, to DFT_r(legs)[q] exp(-2 pi i p q / n).
The inverse of Eq. (1) times L is the same with the real and imaginary parts exchanged on the way in and out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from psfcore.compiled import compiled

LANES = 16
LARGEST_LENGTH = 16384
_ODD_FACTORS = (1, 3, 9)
_HALF_ROOT = np.float32(np.sqrt(0.5))
_HALF_ROOT_3 = np.float32(np.sqrt(0.75))
_W = np.uint64(LANES)
# Contraction to fused multiply-add only: nothing that lets NaN or the order of sums be guessed at.
_FAST: Any = {"contract"}

Flat = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Plan:
    """How a length is transformed: radices and lengths pass by pass, twiddles, and the order of the result.

    ``frequency[i]`` is the frequency at place i after a forward transform, ``place`` its inverse.
    """

    length: int
    radices: NDArray[np.int64]
    lengths: NDArray[np.int64]
    twiddles: Flat
    offsets: NDArray[np.int64]
    frequency: NDArray[np.int64]
    place: NDArray[np.int64]


def good_length(at_least: int) -> int:
    """The smallest length >= ``at_least`` that can be transformed: 2^a, 3 2^a or 9 2^a, a >= 4."""
    candidates = [odd << a for odd in _ODD_FACTORS for a in range(4, 15) if odd << a <= LARGEST_LENGTH]
    fitting = [length for length in candidates if length >= at_least]
    if not fitting:
        raise ValueError(f"expected a length of at most {LARGEST_LENGTH}, got {at_least}")
    return min(fitting)


@lru_cache(maxsize=16)
def make_plan(length: int) -> Plan:
    """The plan for a length that ``good_length`` returned."""
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
        # Block q of this pass holds the frequencies congruent to q: the first pass is the lowest digit.
        frequency = (frequency[:, None] + scale * np.arange(radix)[None, :]).ravel()
        scale *= radix
        n = m
    place = np.empty(length, dtype=np.int64)
    place[frequency] = np.arange(length)
    return Plan(
        length=length,
        radices=np.array(radices, dtype=np.int64),
        lengths=np.array(lengths, dtype=np.int64),
        twiddles=np.concatenate(twiddles),
        offsets=np.array(offsets, dtype=np.int64),
        frequency=frequency,
        place=place,
    )


def _radices(length: int) -> list[int]:
    """Threes first, then eights, and the four or two that is left over last."""
    radices, rest = [], length
    while rest % 3 == 0:
        radices.append(3)
        rest //= 3
    while rest % 8 == 0:
        radices.append(8)
        rest //= 8
    if rest > 1:
        radices.append(rest)
    if np.prod(radices) != length or rest not in (1, 2, 4):
        raise ValueError(f"length {length} is not 2^a, 3 2^a or 9 2^a")
    return radices


# Butterflies on scalars, which the compiler sees as lanes --------------------------------------------


@njit(inline="always", fastmath=_FAST)
def _dft4(ar, ai, br, bi, cr, ci, dr, di):  # type: ignore[no-untyped-def]
    sr, si, tr, ti = ar + cr, ai + ci, ar - cr, ai - ci
    ur, ui, vr, vi = br + dr, bi + di, br - dr, bi - di
    return sr + ur, si + ui, tr + vi, ti - vr, sr - ur, si - ui, tr - vi, ti + vr


@njit(inline="always", fastmath=_FAST)
def _times(ar, ai, wr, wi):  # type: ignore[no-untyped-def]
    return ar * wr - ai * wi, ar * wi + ai * wr


def _radix8(n: int, inverse: bool) -> Callable[..., None]:
    """The radix-8 pass for blocks of length n, which is a constant for the compiler."""
    m = n // 8
    h = _HALF_ROOT
    M1, M2, M3, M4, M5, M6, M7 = (np.uint64(q * m * 2 * LANES) for q in range(1, 8))
    # Real and imaginary parts change places for the inverse.
    R, I = (np.uint64(LANES), np.uint64(0)) if inverse else (np.uint64(0), np.uint64(LANES))  # noqa: E741

    @compiled(name=f"forward_{n}", fastmath=_FAST)
    def forward(x, tw, length):  # type: ignore[no-untyped-def]
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
                    # The odd outputs: legs turned by exp(-2 pi i q / 8).
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

    @compiled(name=f"backward_{n}", fastmath=_FAST)
    def backward(x, tw, length):  # type: ignore[no-untyped-def]
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


@compiled(fastmath=_FAST)
def _forward3(x, tw, length, n):  # type: ignore[no-untyped-def]
    m = n // 3
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


@compiled(fastmath=_FAST)
def _backward3(x, tw, length, n):  # type: ignore[no-untyped-def]
    m = n // 3
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


@compiled(fastmath=_FAST)
def _last4(x, length, swap):  # type: ignore[no-untyped-def]
    """The pass of radix 4 on blocks of 4, which has no twiddles and is its own direction."""
    R, I = (_W, np.uint64(0)) if swap else (np.uint64(0), _W)  # noqa: E741
    for base in range(0, length, 4):
        b = x[base * 2 * LANES : (base + 4) * 2 * LANES]
        for w in range(LANES):
            r, i = np.uint64(w) + R, np.uint64(w) + I
            s = np.uint64(2 * LANES)
            y = _dft4(
                b[r], b[i], b[r + s], b[i + s], b[r + s + s], b[i + s + s], b[r + s + s + s], b[i + s + s + s]
            )
            b[r], b[i], b[r + s], b[i + s] = y[0], y[1], y[2], y[3]
            b[r + s + s], b[i + s + s], b[r + s + s + s], b[i + s + s + s] = y[4], y[5], y[6], y[7]


@compiled(fastmath=_FAST)
def _last2(x, length):  # type: ignore[no-untyped-def]
    for base in range(0, length, 2):
        b = x[base * 2 * LANES : (base + 2) * 2 * LANES]
        for w in range(2 * LANES):
            j, k = np.uint64(w), np.uint64(w + 2 * LANES)
            b[j], b[k] = b[j] + b[k], b[j] - b[k]


_forward_8, _backward_8 = _radix8(8, False), _radix8(8, True)
_forward_16, _backward_16 = _radix8(16, False), _radix8(16, True)
_forward_32, _backward_32 = _radix8(32, False), _radix8(32, True)
_forward_64, _backward_64 = _radix8(64, False), _radix8(64, True)
_forward_128, _backward_128 = _radix8(128, False), _radix8(128, True)
_forward_256, _backward_256 = _radix8(256, False), _radix8(256, True)
_forward_512, _backward_512 = _radix8(512, False), _radix8(512, True)
_forward_1024, _backward_1024 = _radix8(1024, False), _radix8(1024, True)
_forward_2048, _backward_2048 = _radix8(2048, False), _radix8(2048, True)
_forward_4096, _backward_4096 = _radix8(4096, False), _radix8(4096, True)
_forward_8192, _backward_8192 = _radix8(8192, False), _radix8(8192, True)
_forward_16384, _backward_16384 = _radix8(16384, False), _radix8(16384, True)


@compiled()
def forward(x, length, radices, lengths, twiddles, offsets):  # type: ignore[no-untyped-def]
    """Eq. (1) of sixteen lanes in place; the result is in the order ``Plan.frequency``."""
    for stage in range(len(radices)):
        tw, n = twiddles[offsets[stage] :], lengths[stage]
        if radices[stage] == 3:
            _forward3(x, tw, length, n)
        elif radices[stage] == 4:
            _last4(x, length, False)
        elif radices[stage] == 2:
            _last2(x, length)
        elif n == 8:
            _forward_8(x, tw, length)
        elif n == 16:
            _forward_16(x, tw, length)
        elif n == 32:
            _forward_32(x, tw, length)
        elif n == 64:
            _forward_64(x, tw, length)
        elif n == 128:
            _forward_128(x, tw, length)
        elif n == 256:
            _forward_256(x, tw, length)
        elif n == 512:
            _forward_512(x, tw, length)
        elif n == 1024:
            _forward_1024(x, tw, length)
        elif n == 2048:
            _forward_2048(x, tw, length)
        elif n == 4096:
            _forward_4096(x, tw, length)
        elif n == 8192:
            _forward_8192(x, tw, length)
        elif n == 16384:
            _forward_16384(x, tw, length)


@compiled()
def inverse(x, length, radices, lengths, twiddles, offsets):  # type: ignore[no-untyped-def]
    """``length`` times the inverse of ``forward``, in place, from its order back to the natural one."""
    for stage in range(len(radices) - 1, -1, -1):
        tw, n = twiddles[offsets[stage] :], lengths[stage]
        if radices[stage] == 3:
            _backward3(x, tw, length, n)
        elif radices[stage] == 4:
            _last4(x, length, True)
        elif radices[stage] == 2:
            _last2(x, length)
        elif n == 8:
            _backward_8(x, tw, length)
        elif n == 16:
            _backward_16(x, tw, length)
        elif n == 32:
            _backward_32(x, tw, length)
        elif n == 64:
            _backward_64(x, tw, length)
        elif n == 128:
            _backward_128(x, tw, length)
        elif n == 256:
            _backward_256(x, tw, length)
        elif n == 512:
            _backward_512(x, tw, length)
        elif n == 1024:
            _backward_1024(x, tw, length)
        elif n == 2048:
            _backward_2048(x, tw, length)
        elif n == 4096:
            _backward_4096(x, tw, length)
        elif n == 8192:
            _backward_8192(x, tw, length)
        elif n == 16384:
            _backward_16384(x, tw, length)
