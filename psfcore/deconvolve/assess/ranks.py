"""Values of given ranks among millions of numbers, faster than by a sort or a partition.

The bits of a float32, read as an integer, order the numbers above 0 by their values and those below 0 in reverse; with
the latter turned around, this integer is called the key. A histogram of the upper 16 bits of the keys tells in which
bin each rank lies. Only the values in these bins, usually a few percent of all, are sorted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled

Values = NDArray[np.float32]
Groups = NDArray[np.uint8]
_BINS, _SHIFT = 1 << 16, 16
_MINUS_ZERO = -(1 << 31)
_LARGEST = float(np.finfo(np.float32).max)


def percentiles(values: NDArray[np.generic], levels: Sequence[float]) -> NDArray[np.float64]:
    """The percentiles of values (n,), which must not be NaN, as `numpy.percentile` computes them, in single
    precision.
    """
    with np.errstate(over="ignore"):
        single = np.asarray(values, dtype=np.float32)
    place = (single.size - 1) * np.asarray(levels) / 100
    rank = place.astype(np.intp)
    ((found, _),) = _at_ranks(
        single, np.zeros(single.size, np.uint8), [[*rank, *np.minimum(rank + 1, single.size - 1)]]
    )
    low, high = np.split(np.clip(found.astype(np.float64), -_LARGEST, _LARGEST), 2)
    return np.asarray(low + (high - low) * (place - rank))


def medians(values: Values, groups: Groups, count: int) -> NDArray[np.float64]:
    """The median of the values (n,) of each of `count` groups.

    Parameters
    ----------
    groups
        The number of the group of each value; no group is empty.
    """
    if count == 0:
        return np.empty(0)
    sizes = np.bincount(groups, minlength=count)
    middles = [[(size - 1) // 2, size // 2] for size in sizes.tolist()]
    return np.array([pair.mean(dtype=np.float64) for pair, _ in _at_ranks(values, groups, middles)])


def parts_of_equal_size(values: Values, count: int) -> Groups:
    """The number of the part to which each value (n,) belongs, if the sorted values are cut into `count` parts.

    The sizes of the parts differ by at most 1. Of equal values at a border, the first ones belong to the lower part.
    """
    size, more = divmod(values.size, count)
    starts = np.cumsum(size + (np.arange(count - 1) < more))
    parts = np.zeros(values.size, np.uint8)
    ((borders, below),) = _at_ranks(values, parts, [starts.tolist()])
    equal, first = np.zeros(borders.size, np.int64), np.zeros(_BINS, np.uint8)
    bits = values.view(np.int32), borders.view(np.int32)
    _cut(values, bits[0], borders, bits[1], starts - below, equal, first, parts)
    return parts


def _at_ranks(
    values: Values, groups: Groups, ranks: Sequence[Sequence[int]]
) -> list[tuple[Values, NDArray[np.int64]]]:
    """For each group: the values that stand at these ranks (from 0) of its sorted values, and how many of its values
    are smaller.
    """
    counts = np.zeros((len(ranks), _BINS), np.int64)
    bits = values.view(np.int32)
    _count(bits, groups, counts)
    below = np.cumsum(counts, axis=1)
    wanted = np.zeros(counts.shape, np.bool_)
    bins = [
        np.searchsorted(of_group, of_ranks, side="right")
        for of_group, of_ranks in zip(below, ranks, strict=True)
    ]
    for group, of_group in enumerate(bins):
        wanted[group, of_group] = True
    sizes = np.where(wanted, counts, 0).sum(axis=1)
    ends = np.cumsum(sizes)
    chosen = np.empty(ends[-1], np.float32)
    _collect(values, bits, groups, wanted, ends - sizes, chosen)
    found = []
    for group, of_group in enumerate(bins):
        ordered = chosen[ends[group] - sizes[group] : ends[group]]
        ordered.sort()
        left_out = np.cumsum(
            np.where(wanted[group], 0, counts[group])
        )  # values in lower bins that were not collected
        of_ranks = ordered[np.asarray(ranks[group], np.intp) - left_out[of_group]]
        found.append((of_ranks, np.searchsorted(ordered, of_ranks) + left_out[of_group]))
    return found


@compiled()
def _bin(bits: int) -> int:
    """The bin of a value with these bits. -0 has the bin of 0: equal values must have equal keys."""
    bits = 0 if bits == _MINUS_ZERO else bits
    return ((bits ^ ((bits >> 31) & 0x7FFFFFFF)) >> _SHIFT) + _BINS // 2


# Views and new arrays are made by the callers: to compile them would take as long as all the rest.


@compiled()
def _count(bits: NDArray[np.int32], groups: Groups, counts: NDArray[np.int64]) -> None:
    """Add the number of values with these bits in each bin of each group to counts [group, bin]."""
    for n in range(bits.size):
        counts[groups[n], _bin(bits[n])] += 1


@compiled()
def _collect(
    values: Values,
    bits: NDArray[np.int32],
    groups: Groups,
    wanted: NDArray[np.bool_],
    place: NDArray[np.intp],
    chosen: Values,
) -> None:
    """Copy the values in the wanted bins [group, bin].

    Parameters
    ----------
    place
        The place of the next value of each group in `chosen`.
    """
    for n in range(bits.size):
        if wanted[groups[n], _bin(bits[n])]:
            chosen[place[groups[n]]] = values[n]
            place[groups[n]] += 1


@compiled()
def _cut(
    values: Values,
    bits: NDArray[np.int32],
    borders: Values,
    bits_of_borders: NDArray[np.int32],
    lower: NDArray[np.int64],
    equal: NDArray[np.int64],
    first: Groups,
    parts: Groups,
) -> None:
    """Write the part of each value: the number of borders below it.

    Parameters
    ----------
    lower
        For each border, how many of the values that equal the border count as below it.
    equal
        Zeros, which become the number of values that equal each border.
    first
        Zeros, which become the number of borders in lower bins.
    """
    for bit in bits_of_borders:
        for place in range(_bin(bit) + 1, _BINS):  # to add to a slice would compile two seconds longer
            first[place] += 1
    for n in range(values.size):
        part = np.int64(first[_bin(bits[n])])
        while part < borders.size and borders[part] < values[n]:
            part += 1
        if part < borders.size and borders[part] == values[n]:
            border = part
            while part < borders.size and borders[part] == values[n] and equal[border] >= lower[part]:
                part += 1
            equal[border] += 1
        parts[n] = part
