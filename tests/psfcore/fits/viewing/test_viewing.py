"""Planes for the viewer: decoded as the file stores them, kept, cut into windows; and the list of all cards."""

from __future__ import annotations

import gc
import json
import os
import threading
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import all_cards
from psfcore.fits.images import write_image
from psfcore.fits.viewing import planes as kept_planes
from psfcore.fits.viewing.planes import Decoded, Plane, Planes, decode_plane
from psfcore.fits.viewing.windows import Window, window_of
from psfcore.fits.viewing.windows import pixels as pixels_of
from psfcore.image import Image
from tests.psfcore.fits import raw_files

LIMITS = FitsLimits(max_pixels=2048 * 2048)


def decoded(path: Path, name: str = "image") -> tuple[np.ndarray, str | None]:
    with TemporaryFile() as target:
        about = decode_plane(path, name, LIMITS, target)
        target.seek(0)
        return np.fromfile(target, "<f4").reshape(about.shape), about.unit


def field(shape: tuple[int, int] = (300, 211), seed: int = 3) -> np.ndarray:
    """Positive whole numbers, so that every way to store them is exact."""
    return np.random.default_rng(seed).poisson(900, shape).astype(np.int32)


def test_plain_pixels_and_the_planes_of_a_product(tmp_path: Path) -> None:
    for kind, ending in (("u2", ".fits"), ("i4", ".fits.gz"), ("f4", ".fits.gz"), ("f8", ".fits")):
        stored = field().astype(kind)
        if kind in ("f4", "f8"):
            stored[3, 5], stored[7, 9] = np.nan, np.inf
        path = tmp_path / f"{kind}{ending}"
        fits.PrimaryHDU(stored, fits.Header({"BUNIT": "DN/s"})).writeto(path)
        pixels, unit = decoded(path)
        np.testing.assert_array_equal(pixels, stored.astype("f4"))
        assert unit == "DN/s"
    for name, plane in write_product(tmp_path / "p.fits").items():
        pixels, unit = decoded(tmp_path / "p.fits", name.lower())
        np.testing.assert_array_equal(pixels, plane.astype("f4"))
        assert unit == (None if name == "QUALITY" else "DN/s")
    fits.PrimaryHDU(field()).writeto(tmp_path / "x.fits")
    with pytest.raises(DataError, match=r"^no-such-plane: .*\(image\); got error: .*error_draws"):
        decoded(tmp_path / "x.fits", "error")
    (tmp_path / "x.fits").write_bytes(raw_files.compressed("GZIP_1"))
    with pytest.raises(DataError, match=r"^(unreadable-pixels)"):
        decoded(tmp_path / "x.fits")


def write_product(path: Path) -> dict[str, np.ndarray]:
    """A product with planes; returns its planes as they were given."""
    rng = np.random.default_rng(5)
    shape = (40, 60)
    planes: dict[str, Any] = {
        "QUALITY": rng.integers(0, 128, shape).astype(np.uint8),
        "ERROR": rng.normal(2, 0.1, shape).astype("f4"),
    }
    planes["ERROR"][1, 2] = np.nan
    pixels = rng.normal(100, 1, shape)
    image = Image(pixels, np.zeros(shape, np.uint8), fits.Header({"BUNIT": "DN/s"}), "DN/s", 1.0)
    write_image(path, image, cards={}, planes=planes)
    return planes | {"IMAGE": pixels.astype("f4")}


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
    monkeypatch.setattr(kept_planes, "MOST_PLANES", 2)
    decode = Decoder()
    for name in ("a", "b", "a", "c"):
        planes.decoded((name, "image"), decode)
    assert [planes.kept((name, "image")) is not None for name in "abc"] == [True, False, True]
    assert decode.times == 3


def test_a_plane_larger_than_the_room_is_served_and_not_kept(
    planes: Planes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_planes, "MOST_BYTES", 100)
    plane = planes.decoded(("large", "image"), Decoder(pixels=26))
    assert planes.kept(("large", "image")) is None
    assert plane.rows(0, 1) == bytes(104)
    with pytest.raises(EOFError, match="expected 208 bytes of a decoded plane; got 104"):
        plane.rows(0, 2)


def test_the_space_is_free_once_nobody_reads_the_plane(
    planes: Planes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_planes, "MOST_BYTES", 0)

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


def plane_of(path: Path, content: np.ndarray) -> Plane:
    path.write_bytes(content.astype("<f4").tobytes())
    return Plane(path, Decoded(content.shape, None))  # type: ignore[arg-type]


def got(plane: Plane, window: Window, *, bits: bool = False) -> np.ndarray:
    content = b"".join(pixels_of(plane, window, bits=bits))
    assert len(content) == window.length
    return np.frombuffer(content, "<f4").reshape(window.shape)


def block_by_block(content: np.ndarray, window: Window, *, bits: bool) -> np.ndarray:
    cut = content[window.y : window.y + window.height, window.x : window.x + window.width]
    ny, nx = window.shape
    result = np.full((ny, nx), np.nan)
    for j in range(ny):
        for i in range(nx):
            block = cut[j * window.step : (j + 1) * window.step, i * window.step : (i + 1) * window.step]
            if bits:
                result[j, i] = np.bitwise_or.reduce(block.astype(int), axis=None)
            elif np.isfinite(block).any():
                result[j, i] = block[np.isfinite(block)].astype(float).mean()
    return result


WINDOWS = [{}, {"x": 5, "y": 11, "width": 40, "height": 23}, {"x": 60, "y": 52}]


def test_means_of_blocks(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    content = rng.normal(0, 1000, (53, 61)).astype("f4")
    content[rng.random(content.shape) < 0.3] = np.nan
    content[20:40, 10:30] = np.nan  # whole blocks without a value
    content[0, 0], content[50, 3] = np.inf, -np.inf
    plane = plane_of(tmp_path / "p", content)
    for window in WINDOWS:
        whole = window_of(plane.shape, **window)
        cut = content[whole.y : whole.y + whole.height, whole.x : whole.x + whole.width]
        np.testing.assert_array_equal(got(plane, whole), cut)  # also infinities
        for step in (2, 3, 7, 50, 1000):
            part = window_of(plane.shape, **window, step=step)
            expected = block_by_block(content, part, bits=False)
            # Sums in float64 of another order: equal to a rounding of the float32 answer.
            np.testing.assert_allclose(got(plane, part), expected, rtol=2**-23, atol=1e-9)
    content = np.full((4, 4), np.finfo("f4").max, "f4")  # the sum must not overflow
    plane = plane_of(tmp_path / "p", content)
    np.testing.assert_array_equal(got(plane, window_of(plane.shape, step=4)), content[:1, :1])


def test_means_and_bits_of_a_plane_read_two_rows_at_a_time(tmp_path: Path) -> None:
    """A read takes a mebibyte, which is two rows of this plane; steps are smaller and larger than two."""
    content = np.zeros((23, 120_000), "f4")
    content[:, 500:530] = np.random.default_rng(3).integers(0, 256, (23, 30))
    plane = plane_of(tmp_path / "p", content)
    for step, bits in product((1, 2, 3, 7, 1000), (False, True)):
        part = window_of(plane.shape, x=500, width=30, y=1, step=step)
        expected = block_by_block(content, part, bits=bits)
        np.testing.assert_allclose(got(plane, part, bits=bits), expected, rtol=2**-23)


def test_a_window_outside_the_plane_is_refused() -> None:
    for window in ({"x": 4}, {"y": 3}, {"width": 5}, {"x": 2, "width": 3}, {"y": 1, "height": 3}):
        with pytest.raises(DataError, match=r"^window-outside: .*plane of 4 x 3 px"):
            window_of((3, 4), **window)


def test_every_card_of_every_hdu_is_listed_even_a_damaged_one(
    tmp_path: Path,
) -> None:
    header = fits.Header([("TELESCOP", "TEST", "who"), ("ANSWER", 42), ("RATE", 0.25, "Hz"), ("YES", True)])
    header["ESO TEL X"] = 3  # HIERARCH
    header["LONG"] = "x" * 100
    for line in ("first", "second"):
        header.add_comment(line)
        header.add_history(line)
    header["LAST"] = fits.card.Undefined()
    path = tmp_path / "x.fits"
    plane = fits.ImageHDU(np.zeros((2, 2), np.uint8), name="QUALITY")
    fits.HDUList([fits.PrimaryHDU(np.zeros((4, 4), "f4"), header), plane]).writeto(path)
    first, second = all_cards(path, LIMITS)
    assert (first.index, first.name, second.index, second.name) == (0, "PRIMARY", 1, "QUALITY")
    with fits.open(path) as hdus:
        for listed, hdu in zip((first, second), hdus, strict=True):
            expected = [
                (c.keyword, None if isinstance(c.value, fits.card.Undefined) else c.value, c.comment)
                for c in hdu.header.cards
            ]
            assert listed.cards == expected
    assert ("HISTORY", "first", "") in first.cards and ("LAST", None, "") in first.cards
    cards = ["BAD     = 1 2 3", "NOTNUM  = NaN", "HUGE    = 1E400", "COMPLEX = (1.0, 2.0)", "UNCLOSED= 'abc"]
    path = tmp_path / "x.fits"
    path.write_bytes(raw_files.block(*raw_files.image_cards(4, 2, 8, *cards), data=bytes(8)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Python would remember each text of a warning for ever
        (listed,) = all_cards(path, LIMITS)
    values = {keyword: value for keyword, value, _comment in listed.cards}
    assert values["BAD"] == "1 2 3" and values["NOTNUM"] == "NaN" and values["HUGE"] == "inf"
    assert values["COMPLEX"] == "(1+2j)" and values["UNCLOSED"] == "'abc"
    assert json.loads(json.dumps(listed.cards, allow_nan=False))
