"""The lengths of Fourier transforms, and how many the kernels (`@compiled`) compute side by side. This file imports no
numerical libraries, because estimates of memory need it too.
"""

from __future__ import annotations

from psfcore.errors import DataError

LANES = 16
LARGEST_LENGTH = 16384
_ODD_FACTORS = (1, 3, 5, 9)


def good_length(at_least: int) -> int:
    """The smallest supported length >= `at_least`. Supported are 2^a, 3 2^a, 5 2^a and 9 2^a with a >= 4. Raises
    ValueError.
    """
    candidates = [odd << a for odd in _ODD_FACTORS for a in range(4, 15) if odd << a <= LARGEST_LENGTH]
    fitting = [length for length in candidates if length >= at_least]
    if not fitting:
        raise ValueError(f"expected a length of at most {LARGEST_LENGTH}; got {at_least}")
    return min(fitting)


def periodic_length(size: int) -> int:
    """The size of a field that continues periodically. Raises DataError "periodic-size" if it is not supported."""
    if size > LARGEST_LENGTH or good_length(size) != size:
        raise DataError(
            "periodic-size",
            "expected sides of 2^a, 3 2^a, 5 2^a or 9 2^a px with a >= 4, such as 2048 or 4096, for the edges "
            f"periodic; got {size}: use other edges",
        )
    return size
