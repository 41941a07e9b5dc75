"""Values of given ranks among millions of numbers, faster than by a sort or a partition.

The bits of a float32, read as an integer, order the numbers above 0 by their values and those below 0 in reverse; with
the latter turned around, this integer is called the key. A histogram of the upper 16 bits of the keys tells in which
bin each rank lies, and histograms of the lower 16 bits in these bins tell the value. The numbers are read twice and in
portions, so they need not be in memory together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.shares import shared_out

Values = NDArray[np.float32]
Groups = NDArray[np.uint8]
Bits = NDArray[np.int32]
Counts = NDArray[np.int32]
_BINS, _SHIFT = 1 << 16, 16
_MINUS_ZERO, _LOWER_31 = -(1 << 31), (1 << 31) - 1
_LARGEST = float(np.finfo(np.float32).max)
_PORTION = 1 << 18


@dataclass(frozen=True, eq=False)
class Portions:
    """Numbers that are made in portions each time they are read, and the group of each number.

    Attributes
    ----------
    sizes
        The number of numbers in each portion.
    read
        Function of the number of a portion that returns its numbers, none of them NaN.
    groups
        The group of each number (n,); None: all are in group 0.
    threads
        Number of threads that read.
    """

    sizes: NDArray[np.intp]
    read: Callable[[int], Values]
    groups: Groups | None = None
    threads: int = 1

    @classmethod
    def of(cls, values: NDArray[np.generic]) -> Portions:
        """The portions of an array (n,), in single precision."""
        with np.errstate(over="ignore"):
            single = np.asarray(values, dtype=np.float32)
        starts = np.arange(0, max(single.size, 1), _PORTION)
        sizes = np.minimum(single.size - starts, _PORTION)
        return cls(sizes, lambda n: single[n * _PORTION : (n + 1) * _PORTION])

    @cached_property
    def ends(self) -> NDArray[np.intp]:
        """Where each portion ends among all numbers."""
        return np.cumsum(self.sizes)

    def portion(self, n: int) -> tuple[Bits, Groups]:
        """The bits of the numbers, and the groups of a portion."""
        bits = self.read(n).view(np.int32)
        if self.groups is None:
            return bits, np.zeros(bits.size, np.uint8)
        return bits, self.groups[self.ends[n] - bits.size : self.ends[n]]


def percentiles(values: NDArray[np.generic] | Portions, levels: Sequence[float]) -> NDArray[np.float64]:
    """The percentiles of numbers, none of them NaN, as `numpy.percentile` computes them, in single precision."""
    portions = values if isinstance(values, Portions) else Portions.of(values)

    def place(size: int) -> NDArray[np.float64]:
        return np.asarray((size - 1) * np.asarray(levels) / 100)

    def neighbours(size: int) -> list[int]:
        rank = place(size).astype(np.intp)
        return [*rank.tolist(), *np.minimum(rank + 1, size - 1).tolist()]

    ((size, found, _),) = _at_ranks(portions, 1, neighbours)
    low, high = np.split(np.clip(found.astype(np.float64), -_LARGEST, _LARGEST), 2)
    return np.asarray(low + (high - low) * (place(size) % 1))


def medians(portions: Portions, count: int) -> NDArray[np.float64]:
    """The median of the numbers of each of `count` groups; no group is empty."""
    if count == 0:
        return np.empty(0)
    found = _at_ranks(portions, count, lambda size: [(size - 1) // 2, size // 2])
    return np.array([pair.mean(dtype=np.float64) for _, pair, _ in found])


def parts_of_equal_size(portions: Portions, count: int) -> tuple[Groups, NDArray[np.float64]]:
    """The number of the part to which each number (n,) belongs, if the sorted numbers are cut into `count` parts, and
    the median of each part (count,).

    The sizes of the parts differ by at most 1; none is empty, so there are at least `count` numbers. Of equal numbers
    at a border, the first ones belong to the lower part.
    """

    def starts(size: int) -> NDArray[np.intp]:
        each, more = divmod(size, count)
        return np.concatenate([[0], np.cumsum(each + (np.arange(count) < more))])

    def needed(size: int) -> list[int]:
        first, end = starts(size)[:-1], starts(size)[1:]
        return [*first[1:].tolist(), *((first + end - 1) // 2).tolist(), *((first + end) // 2).tolist()]

    ((size, values, below),) = _at_ranks(portions, 1, needed)
    borders, *middles = np.split(values, [count - 1, 2 * count - 1])
    lower, equal = starts(size)[1:-1] - below[: count - 1], np.zeros(borders.size, np.int64)
    bits = (borders + np.float32(0)).view(np.int32)  # as in `_key`; the sum turns -0 into 0
    bins = ((bits ^ ((bits >> 31) & _LOWER_31)) >> _SHIFT) + _BINS // 2
    in_lower_bins = np.searchsorted(bins, np.arange(_BINS))
    parts = np.empty(size, np.uint8)
    for n, end in enumerate(portions.ends):  # in order, because of equal numbers
        numbers = portions.read(n)
        _cut(
            numbers,
            numbers.view(np.int32),
            borders,
            in_lower_bins,
            lower,
            equal,
            parts[end - numbers.size : end],
        )
    return parts, np.mean(middles, axis=0, dtype=np.float64)


def _at_ranks(
    portions: Portions, groups: int, ranks_of: Callable[[int], Sequence[int]]
) -> list[tuple[int, Values, NDArray[np.int64]]]:
    """For each group: its size, the values that stand at some ranks (from 0) of its sorted numbers, and how many of its
    numbers are smaller.

    Parameters
    ----------
    ranks_of
        Function of the size of a group that returns the ranks.
    """

    def by_upper_bits(share: range) -> Counts:
        counts = np.zeros((groups, _BINS), np.int32)
        for n in share:
            _count_upper(*portions.portion(n), counts)
        return counts

    below = np.cumsum(
        _sum(shared_out(by_upper_bits, len(portions.sizes), portions.threads)), axis=1, dtype=np.int64
    )
    ranks = [ranks_of(size) for size in below[:, -1].tolist()]
    # Most bins contain no rank. The others are numbered.
    bins = [np.searchsorted(*pair, side="right") for pair in zip(below, ranks, strict=True)]
    wanted = np.zeros(below.shape, np.bool_)
    for group, of_group in enumerate(bins):
        wanted[group, of_group] = True
    numbers = np.where(wanted, np.cumsum(wanted, dtype=np.int32).reshape(wanted.shape) - 1, -1).astype(
        np.int16
    )

    def by_lower_bits(share: range) -> Counts:
        counts = np.zeros((np.count_nonzero(wanted), _BINS), np.int32)
        for n in share:
            _count_lower(*portions.portion(n), numbers, counts)
        return counts

    within = np.cumsum(
        _sum(shared_out(by_lower_bits, len(portions.sizes), portions.threads)), axis=1, dtype=np.int64
    )
    found = []
    for group, (of_group, of_ranks) in enumerate(zip(bins, ranks, strict=True)):
        values, smaller = np.empty(len(of_ranks), np.float32), np.empty(len(of_ranks), np.int64)
        for n, (upper, rank) in enumerate(zip(of_group.tolist(), of_ranks, strict=True)):
            in_lower_bins = below[group, upper - 1] if upper else 0
            of_bin = within[numbers[group, upper]]
            lower = int(np.searchsorted(of_bin, rank - in_lower_bins, side="right"))
            smaller[n] = in_lower_bins + (of_bin[lower - 1] if lower else 0)
            values[n] = _value(((upper - _BINS // 2) << _SHIFT) + lower)
        found.append((int(below[group, -1]), values, smaller))
    return found


def _sum(of_shares: Sequence[Counts]) -> Counts:
    return of_shares[0] if len(of_shares) == 1 else np.sum(of_shares, axis=0, dtype=np.int32)


def _value(key: int) -> np.float32:
    """The float32 that has this key."""
    return np.int32(key if key >= 0 else key ^ _LOWER_31).view(np.float32)


@compiled()
def _key(bits: int) -> int:
    """The key of a value with these bits. -0 has the key of 0: equal values must have equal keys."""
    bits = 0 if bits == _MINUS_ZERO else bits
    return bits ^ ((bits >> 31) & _LOWER_31)


# Views are made by the callers: to compile them would take as long as all the rest.


@compiled()
def _count_upper(bits: Bits, groups: Groups, counts: Counts) -> None:
    """Add the number of values with these bits in each bin of each group to counts [group, bin]."""
    for n in range(bits.size):
        counts[groups[n], (_key(bits[n]) >> _SHIFT) + _BINS // 2] += 1


@compiled()
def _count_lower(bits: Bits, groups: Groups, numbers: NDArray[np.int16], counts: Counts) -> None:
    """Add the number of values with these bits, in each wanted bin, to counts [number of the bin, lower half of the
    key].

    Parameters
    ----------
    numbers
        The number of each bin [group, bin]; below 0: not wanted.
    """
    for n in range(bits.size):
        key = _key(bits[n])
        number = numbers[groups[n], (key >> _SHIFT) + _BINS // 2]
        if number >= 0:
            counts[number, key & (_BINS - 1)] += 1


@compiled()
def _cut(
    values: Values,
    bits: Bits,
    borders: Values,
    in_lower_bins: NDArray[np.intp],
    lower: NDArray[np.int64],
    equal: NDArray[np.int64],
    parts: Groups,
) -> None:
    """Write the part of each value: the number of borders below it.

    Parameters
    ----------
    in_lower_bins
        For each bin, the number of borders in the bins below it.
    lower
        For each border, how many of the values that equal the border count as below it.
    equal
        For each border, how many values equalled it before; it is counted on.
    """
    for n in range(values.size):
        part = np.int64(in_lower_bins[(_key(bits[n]) >> _SHIFT) + _BINS // 2])
        while part < borders.size and borders[part] < values[n]:
            part += 1
        if part < borders.size and borders[part] == values[n]:
            border = part
            while part < borders.size and borders[part] == values[n] and equal[border] >= lower[part]:
                part += 1
            equal[border] += 1
        parts[n] = part
