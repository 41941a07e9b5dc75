"""Memory that is no longer needed goes back to the system."""

from __future__ import annotations

import ctypes
import gc
import weakref

import numpy as np
import psutil
import pytest

from psfcore.gap.unused_memory import return_unused_memory

MIB = 2**20


class Planes:
    """Planes that refer to themselves, as the fields of a view do."""

    def __init__(self, count: int) -> None:
        self.planes = [np.ones(MIB // 8) for _ in range(count)]
        self.own = self


def test_objects_that_refer_to_each_other_are_freed() -> None:
    gc.disable()
    try:
        planes = Planes(1)
        alive = weakref.ref(planes)
        del planes
        assert alive() is not None
        return_unused_memory()
        assert alive() is None
    finally:
        gc.enable()


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="the C library is not glibc")
def test_freed_blocks_between_blocks_in_use_go_back_to_the_system() -> None:
    # From now on, blocks below 30 MiB stay in the heap when they are freed.
    block = np.ones(30 * MIB // 8)
    del block
    return_unused_memory()
    process = psutil.Process()
    before = process.memory_info().rss
    kept, freed = [], []
    for _ in range(100):
        freed.append(Planes(2))
        kept.append(np.ones(1000))
    with_all = process.memory_info().rss
    freed.clear()
    return_unused_memory()
    after = process.memory_info().rss
    assert with_all - before > 190 * MIB
    assert after - before < 20 * MIB
    assert len(kept) == 100
