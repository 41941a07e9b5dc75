"""Instructions on sixteen neighbouring numbers ("lanes"), for the kernels (`@compiled`) of `fft_kernels` and `engine`.
Only the compiler needs this module: it imports numba.

A kernel calls the functions of this module like other functions; each of them becomes vector instructions. Loops over
the lanes would have the same meaning. However, the compiler can turn such a loop into vector instructions only after it
has proved that the arrays of the loop do not overlap, and for many arrays it fails, or spends most of the time of the
first run of an installation.

Arrays are float32, contiguous, and addressed by the index of a number in the flat array.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.base import BaseContext
from numba.core.cgutils import get_or_insert_function
from numba.core.errors import TypingError
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from psfcore.convolution.lengths import LANES
from psfcore.machine_code import processor

# What an intrinsic of numba returns: the types of its arguments, and the function that writes its instructions.
Written = tuple[Signature, Callable[..., ir.Value]]
# numba gives the decorated function the context of the compiler and the types of the arguments. Kernels call it with
# the arguments alone.
instruction: Callable[[Callable[..., Written]], Callable[..., object]] = intrinsic
# The types of constant arguments hold their values.
instruction_of_constants: Callable[[Callable[..., Written]], Callable[..., object]] = intrinsic(
    prefer_literal=True
)


class Vector:
    """Neighbouring lanes in a vector register. An operation adds an instruction to the kernel that is compiled."""

    __array_ufunc__ = None  # a product with a number of numpy calls `__rmul__`

    def __init__(self, builder: ir.IRBuilder, value: ir.Value) -> None:
        self.builder, self.value = builder, value

    def __add__(self, other: Vector) -> Vector:
        return Vector(self.builder, self.builder.fadd(self.value, other.value))

    def __sub__(self, other: Vector) -> Vector:
        return Vector(self.builder, self.builder.fsub(self.value, other.value))

    def __mul__(self, other: Vector) -> Vector:
        return Vector(self.builder, self.builder.fmul(self.value, other.value))

    def __rmul__(self, number: np.float32) -> Vector:
        return self.like(number) * self

    def like(self, number: np.float32) -> Vector:
        """A number in all lanes."""
        kind = self.value.type
        return Vector(
            self.builder, ir.Constant(kind, [ir.Constant(kind.element, float(number))] * kind.count)
        )

    def __neg__(self) -> Vector:
        return Vector(self.builder, self.builder.fneg(self.value))

    def times_plus(self, factor: Vector, summand: Vector) -> Vector:
        """Self * factor + summand, rounded once if the processor has an instruction for it."""
        kind = self.value.type
        fused = get_or_insert_function(
            self.builder.module, ir.FunctionType(kind, [kind] * 3), f"llvm.fmuladd.v{kind.count}f32"
        )
        return Vector(self.builder, self.builder.call(fused, [self.value, factor.value, summand.value]))


class Memory:
    """The vectors in an array; `data` is the pointer to the first number of the array."""

    def __init__(self, builder: ir.IRBuilder, data: ir.Value) -> None:
        self.builder, self.data = builder, data
        self.kind = ir.VectorType(ir.FloatType(), width())

    def _at(self, index: ir.Value, offset: int) -> ir.Value:
        return self.builder.gep(self.data, [self.builder.add(index, constant(offset))])

    def load(self, index: ir.Value, offset: int = 0) -> Vector:
        """The vector whose first lane is at index + offset."""
        place = self.builder.bitcast(self._at(index, offset), self.kind.as_pointer())
        return Vector(self.builder, self.builder.load(place, align=4))

    def store(self, vector: Vector, index: ir.Value, offset: int = 0) -> None:
        """Write a vector; its first lane goes to index + offset."""
        place = self.builder.bitcast(self._at(index, offset), self.kind.as_pointer())
        self.builder.store(vector.value, place, align=4)

    def everywhere(self, index: ir.Value, offset: int) -> Vector:
        """The number at index + offset in all lanes."""
        builder = self.builder
        number = builder.load(self._at(index, offset))
        first = builder.insert_element(ir.Constant(self.kind, ir.Undefined), number, ir.IntType(32)(0))
        return Vector(builder, builder.shuffle_vector(first, first, _places([0] * self.kind.count)))


def constant(number: int) -> ir.Constant:
    """A constant index."""
    return ir.Constant(ir.IntType(64), number)


def _places(indices: Sequence[int]) -> ir.Constant:
    number = ir.IntType(32)
    return ir.Constant(ir.VectorType(number, len(indices)), [ir.Constant(number, n) for n in indices])


@cache
def width() -> int:
    """The number of lanes in a vector register of the processor; 8 is good for processors with shorter registers
    too.
    """
    return 16 if "+avx512f" in processor()[2] else 8


def parts() -> range:
    """The first lane of each vector."""
    return range(0, LANES, width())


def written(write: Callable[..., None], arrays: Sequence[types.Type], numbers: int) -> Written:
    """What an intrinsic of numba returns. write(*memories, *indices) writes the instructions for these types of
    arrays.
    """
    for kind in arrays:
        if not (isinstance(kind, types.Array) and kind.layout == "C" and kind.dtype == types.float32):
            raise TypingError(f"expected a contiguous array of float32; got {kind}: copy it")

    def generate(
        context: BaseContext, builder: ir.IRBuilder, _signature: Signature, given: Sequence[ir.Value]
    ) -> ir.Value:
        pairs = zip(arrays, given[: len(arrays)], strict=True)
        data = (context.make_array(kind)(context, builder, array).data for kind, array in pairs)
        write(*(Memory(builder, one) for one in data), *given[len(arrays) :])
        return context.get_dummy_value()

    return types.void(*arrays, *[types.int64] * numbers), generate


@instruction
def transpose(
    _: object,
    source: types.Type,
    target: types.Type,
    first: types.Type,
    step: types.Type,
    to: types.Type,
    to_step: types.Type,
) -> Written:
    """target[to + j to_step + i] = source[first + i step + j] for all lanes i and j."""
    return written(_write_transpose, (source, target), 4)


@instruction
def split(
    _: object, z: types.Type, corner: types.Type, p: types.Type, q: types.Type, at: types.Type
) -> Written:
    """Separate the complex numbers P at z[p] and Q at z[q]: (P + Q*) / 2 and (P - Q*) / (2 i) go to corner[at]."""
    return written(_write_split, (z, corner), 3)


@instruction
def join(
    _: object, corner: types.Type, z: types.Type, at: types.Type, p: types.Type, q: types.Type
) -> Written:
    """Join the numbers A and B at corner[at], the inverse of `split`: A + i B goes to z[p], and A* + i B* to z[q]."""
    return written(_write_join, (corner, z), 3)


@instruction
def scale(_: object, z: types.Type, factors: types.Type, at: types.Type, of: types.Type) -> Written:
    """Multiply the complex numbers at z[at] by the real factors at factors[of]."""
    return written(_write_scale, (z, factors), 2)


@instruction
def turn(_: object, z: types.Type, factors: types.Type, at: types.Type, of: types.Type) -> Written:
    """Multiply the complex numbers at z[at] by the complex factors at factors[of]."""
    return written(partial(_write_turn, conjugate=False), (z, factors), 2)


@instruction
def turn_back(_: object, z: types.Type, factors: types.Type, at: types.Type, of: types.Type) -> Written:
    """As `turn`, by the conjugates of the factors."""
    return written(partial(_write_turn, conjugate=True), (z, factors), 2)


@instruction
def add_scaled(
    _: object, z: types.Type, factors: types.Type, total: types.Type, at: types.Type, of: types.Type
) -> Written:
    """Add to the complex numbers at total[at] those at z[at] times the real factors at factors[of]."""
    return written(_write_add_scaled, (z, factors, total), 2)


@instruction
def add_turned(
    _: object, z: types.Type, factors: types.Type, total: types.Type, at: types.Type, of: types.Type
) -> Written:
    """Add to the complex numbers at total[at] those at z[at] times the complex factors at factors[of]."""
    return written(_write_add_turned, (z, factors, total), 2)


def _write_transpose(
    source: Memory, target: Memory, first: ir.Value, step: ir.Value, to: ir.Value, to_step: ir.Value
) -> None:
    builder, size = source.builder, width()
    for top in parts():
        for left in parts():
            rows = [
                source.load(builder.add(first, builder.mul(step, constant(top + n))), left).value
                for n in range(size)
            ]
            for column, vector in enumerate(_transposed(builder, rows)):
                place = builder.add(to, builder.mul(to_step, constant(left + column)))
                target.store(Vector(builder, vector), place, top)


def _transposed(builder: ir.IRBuilder, rows: list[ir.Value]) -> list[ir.Value]:
    """The transpose of a square of vectors: for each power of two, the off-diagonal squares of that size are
    exchanged.
    """
    rows, count = list(rows), len(rows)
    distance = count // 2
    while distance:
        upper = _places([n + count - distance if n & distance else n for n in range(count)])
        lower = _places([n + count if n & distance else n + distance for n in range(count)])
        for n in (n for n in range(count) if not n & distance):
            pair = rows[n], rows[n + distance]
            rows[n] = builder.shuffle_vector(*pair, upper)
            rows[n + distance] = builder.shuffle_vector(*pair, lower)
        distance //= 2
    return rows


def _write_split(z: Memory, corner: Memory, p: ir.Value, q: ir.Value, at: ir.Value) -> None:
    half = np.float32(0.5)
    for lane in parts():
        pr, pi, qr, qi = (z.load(index, lane + part) for index in (p, q) for part in (0, LANES))
        for n, value in enumerate((pr + qr, pi - qi, pi + qi, qr - pr)):
            corner.store(half * value, at, lane + n * LANES)


def _write_join(corner: Memory, z: Memory, at: ir.Value, p: ir.Value, q: ir.Value) -> None:
    for lane in parts():
        ar, ai, br, bi = (corner.load(at, lane + n * LANES) for n in range(4))
        z.store(ar + bi, q, lane)
        z.store(br - ai, q, lane + LANES)
        z.store(ar - bi, p, lane)
        z.store(ai + br, p, lane + LANES)


def _write_scale(z: Memory, factors: Memory, at: ir.Value, of: ir.Value) -> None:
    for lane in parts():
        factor = factors.load(of, lane)
        for place in (lane, lane + LANES):
            z.store(z.load(at, place) * factor, at, place)


def _write_turn(z: Memory, factors: Memory, at: ir.Value, of: ir.Value, *, conjugate: bool) -> None:
    for lane in parts():
        r, i = z.load(at, lane), z.load(at, lane + LANES)
        tr, ti = factors.load(of, lane), factors.load(of, lane + LANES)
        ti = -ti if conjugate else ti
        z.store(r * tr - i * ti, at, lane)
        z.store(r * ti + i * tr, at, lane + LANES)


def _write_add_scaled(z: Memory, factors: Memory, total: Memory, at: ir.Value, of: ir.Value) -> None:
    for lane in parts():
        factor = factors.load(of, lane)
        for place in (lane, lane + LANES):
            total.store(z.load(at, place).times_plus(factor, total.load(at, place)), at, place)


def _write_add_turned(z: Memory, factors: Memory, total: Memory, at: ir.Value, of: ir.Value) -> None:
    for lane in parts():
        r, i = z.load(at, lane), z.load(at, lane + LANES)
        tr, ti = factors.load(of, lane), factors.load(of, lane + LANES)
        total.store(r * tr - i * ti + total.load(at, lane), at, lane)
        total.store(r * ti + i * tr + total.load(at, lane + LANES), at, lane + LANES)
