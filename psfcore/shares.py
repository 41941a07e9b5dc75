"""Work on numbered parts, shared out among threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")


def shared_out(work: Callable[[range], Result], count: int, threads: int) -> list[Result]:
    """The results of the shares of some parts, one share for each thread.

    Share t has the parts t, t + threads, ..., so that each thread gets its part of the dark and the bright rows of an
    image. The first share is worked on in this thread.

    Parameters
    ----------
    work
        Function of the numbers of the parts in a share.
    count
        The number of parts; they are numbered from 0.
    """
    first, *others = (range(start, count, threads) for start in range(max(1, min(threads, count))))
    if not others:
        return [work(first)]
    with ThreadPoolExecutor(len(others)) as pool:
        pending = [pool.submit(work, share) for share in others]
        return [work(first), *(one.result() for one in pending)]


def in_order(work: Callable[[int], Result], count: int, threads: int) -> list[Result]:
    """The results of `work` for the numbers from 0 to count - 1, in this order for any number of threads."""
    shares = shared_out(lambda share: [work(n) for n in share], count, threads)
    return [shares[n % len(shares)][n // len(shares)] for n in range(count)]
