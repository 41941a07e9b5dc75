"""Which decoded planes are kept, and that each is decoded once."""

from __future__ import annotations

import gc
import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import pytest

from psfcore.fits.viewing import planes as module
from psfcore.fits.viewing.planes import Decoded, Planes


@pytest.fixture
def planes(tmp_path: Path) -> Planes:
    @contextmanager
    def temporary() -> Iterator[Path]:
        path = tmp_path / str(time.monotonic_ns())
        try:
            yield path
        finally:
            path.unlink(missing_ok=True)

    return Planes(temporary)


class Decoder:
    """Writes a plane of one row; counts how often."""

    def __init__(self, pixels: int = 4, seconds: float = 0.0) -> None:
        self.pixels, self.seconds, self.times = pixels, seconds, 0

    def __call__(self, target: BinaryIO) -> Decoded:
        self.times += 1
        time.sleep(self.seconds)
        target.write(bytes(4 * self.pixels))
        return Decoded((1, self.pixels), "DN")


def test_threads_that_ask_at_once_share_one_decoding(planes: Planes, tmp_path: Path) -> None:
    decode, start = Decoder(seconds=0.1), threading.Barrier(6)

    def ask(_number: int) -> bytes:
        start.wait()
        return planes.decoded(("a", "image"), decode).rows(0, 1)

    with ThreadPoolExecutor(6) as pool:
        assert set(pool.map(ask, range(6))) == {bytes(16)}
    assert decode.times == 1
    assert list(tmp_path.iterdir()) == [], "the files have no names"


def test_the_planes_used_last_are_kept(planes: Planes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_PLANES", 2)
    decode = Decoder()
    for name in ("a", "b", "a", "c"):
        planes.decoded((name, "image"), decode)
    assert [planes.kept((name, "image")) is not None for name in "abc"] == [True, False, True]
    assert decode.times == 3


def test_a_plane_larger_than_the_room_is_served_and_not_kept(
    planes: Planes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_BYTES", 100)
    plane = planes.decoded(("large", "image"), Decoder(pixels=26))
    assert planes.kept(("large", "image")) is None
    assert plane.rows(0, 1) == bytes(104)
    with pytest.raises(EOFError, match="expected 208 bytes of a decoded plane; got 104"):
        plane.rows(0, 2)


def test_the_space_is_free_once_nobody_reads_the_plane(
    planes: Planes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_BYTES", 0)

    def handles() -> int:
        gc.collect()
        return len(os.listdir("/proc/self/fd"))

    before = handles()
    plane = planes.decoded(("a", "image"), Decoder())
    assert handles() == before + 1
    del plane
    assert handles() == before


def test_a_failed_decoding_leaves_nothing_and_is_tried_again(planes: Planes, tmp_path: Path) -> None:
    def broken(target: BinaryIO) -> Decoded:
        target.write(b"half")
        raise ValueError("cannot be decoded")

    with pytest.raises(ValueError, match="cannot be decoded"):
        planes.decoded(("a", "image"), broken)
    assert list(tmp_path.iterdir()) == []
    assert planes.decoded(("a", "image"), Decoder()).unit == "DN"
