"""Compares two arrays that should be equal: tells whether they are equal bit for bit, and how large the difference
is."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Comparison:
    """The differences between two arrays.

    same: whether the arrays are equal bit for bit. largest_relative: the largest difference divided by the largest
    absolute value of the first array; None if the shapes differ, if one array is finite where the other is
    not, or if the finite values differ and those of the first array are all 0. values_that_differ: number of
    differing values; None if the shapes differ. sha256: hashes of the two arrays, see ``array_sha256``.
    """

    same: bool
    largest_relative: float | None
    values_that_differ: int | None
    sha256: tuple[str, str]


def compare(first: NDArray[Any], again: NDArray[Any]) -> Comparison:
    """Compare two arrays of numbers; NaN equals NaN."""
    hashes = (array_sha256(first), array_sha256(again))
    kinds = {array.dtype.newbyteorder("<") for array in (first, again)}
    same = first.shape == again.shape and len(kinds) == 1 and hashes[0] == hashes[1]
    if first.shape != again.shape:
        return Comparison(False, None, None, hashes)
    one, other = (np.asarray(array, dtype=np.float64) for array in (first, again))
    differ = ~((one == other) | (np.isnan(one) & np.isnan(other)))
    count = int(np.count_nonzero(differ))
    if not np.array_equal(np.isfinite(one), np.isfinite(other)):
        return Comparison(same, None, count, hashes)
    finite = np.isfinite(one)
    apart = float(np.abs(other[finite] - one[finite]).max(initial=0.0))
    largest = float(np.abs(one[finite]).max(initial=0.0))
    relative = 0.0 if apart == 0.0 else apart / largest if largest > 0.0 else None
    return Comparison(same, relative, count, hashes)


def array_sha256(array: NDArray[Any]) -> str:
    """SHA-256 (hex) of an array's values in C order and little-endian, in the array's number type.

    The hash does not depend on the byte order and the memory layout of the array.
    """
    plain = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return hashlib.sha256(plain.tobytes()).hexdigest()
