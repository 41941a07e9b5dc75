"""Arrays of numbers: their kinds, windows and squares, their JSON values and hashes, differences, and the covariance of
a fit.

The covariance is the inverse of a normal matrix whose parameters have different units:

    A = S B S,   S = diag(sqrt(A_kk))        Eq. (1)
    A^+ = S^-1 B^+ S^-1                      Eq. (2)

The diagonal of B is 1 for any units of the fitted parameters. Therefore only the data determine which directions in
the space of parameters are undetermined; a ratio of units, such as px and DN/s, has no influence. B^+ is the
pseudo-inverse of B (Moore and Penrose). Along an undetermined direction, it gives no change and no variance.

| symbol | name |
|---|---|
| A | normal: J^T W J, with the Jacobian J and the weights W |
| S | size |
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]  # (n,)
Matrix = NDArray[np.float64]  # (rows, columns), or more axes
Plane = NDArray[np.float64]  # [y, x] of an image
Kernel = NDArray[np.float64]  # weights [y, x] of a PSF, with the centre at [ny // 2, nx // 2]
Flags = NDArray[np.bool_]
Number = TypeVar("Number", bound=np.generic)

# Share of B's largest eigenvalue: a direction whose eigenvalue is smaller is undetermined.
WEAKEST_DIRECTION = 1e-15


def json_values(value: object) -> Any:
    """The JSON values of a result.

    Arrays become lists, mappings and dataclasses become objects, and nan and infinity become null, because JSON cannot
    express them.
    """
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_values(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [json_values(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_attributes(of: object, *names: str) -> dict[str, object]:
    """The JSON values of some attributes of an object, by name."""
    return {name: json_values(getattr(of, name)) for name in names}


@dataclass(frozen=True)
class Comparison:
    """The differences between two arrays.

    Attributes
    ----------
    same
        Whether the arrays are equal bit for bit.
    largest_relative
        The largest difference divided by the largest absolute value of the first array; None if the shapes differ, if
        one array is finite where the other is not, or if the finite values differ and those of the first array are all
        0.
    values_that_differ
        Number of differing values; None if the shapes differ.
    sha256
        Hashes of the two arrays, see ``array_sha256``.
    """

    same: bool
    largest_relative: float | None
    values_that_differ: int | None
    sha256: tuple[str, str]


def compare(first: NDArray[np.generic], again: NDArray[np.generic]) -> Comparison:
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


def array_sha256(array: NDArray[np.generic]) -> str:
    """SHA-256 (hex) of an array's values in C order and little-endian, in the array's number type.

    The hash does not depend on the byte order and the memory layout of the array.
    """
    plain = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return hashlib.sha256(plain.tobytes()).hexdigest()


def squares(planes: NDArray[Number], edge: int) -> NDArray[Number]:
    """Planes [..., y, x], divided into squares of `edge` px: (..., rows, edge, columns, edge).

    Incomplete squares in the last rows and columns are left out.
    """
    rows, columns = (n // edge for n in planes.shape[-2:])
    cut = planes[..., : rows * edge, : columns * edge]
    return cut.reshape(*planes.shape[:-2], rows, edge, columns, edge)


def cut(plane: NDArray[Number], top: int, left: int, size: tuple[int, int]) -> NDArray[Number]:
    """A window of a plane [y, x]; its pixels outside the plane are 0."""
    out = np.zeros(size, plane.dtype)
    low_y, high_y = (min(max(at, 0), plane.shape[0]) for at in (top, top + size[0]))
    low_x, high_x = (min(max(at, 0), plane.shape[1]) for at in (left, left + size[1]))
    if low_y < high_y and low_x < high_x:
        out[low_y - top : high_y - top, low_x - left : high_x - left] = plane[low_y:high_y, low_x:high_x]
    return out


def scaled_inverse(normal: Matrix, *, weakest: float = WEAKEST_DIRECTION) -> Matrix:
    """Compute A^+ by Eq. (2) for a symmetric, non-negative matrix (n, n).

    The rows and columns of parameters that have no influence on the data are 0.

    Parameters
    ----------
    weakest
        The limit for undetermined directions: a direction is undetermined if its eigenvalue in B is at most this
        fraction of the largest eigenvalue.
    """
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(normal / scale, rcond=weakest, hermitian=True) / scale)  # Eq. (2)
