"""Tiles that do not hold exactly their pixels are refused before they use memory; correct tiles pass."""

from __future__ import annotations

import gzip
import tracemalloc
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits, read_summary
from psfcore.fits.images import read_image
from psfcore.fits.psfs import read_psf
from tests.fits_bombs import lying_tiles, psf_with_a_tail

MIB = 2**20
LIMITS = FitsLimits(max_pixels=4096 * 4096)
RNG = np.random.default_rng(0)


def written(path: Path, pixels: np.ndarray, **options: object) -> Path:
    hdus = [fits.PrimaryHDU(), fits.CompImageHDU(pixels, **options)]
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


def peak_mib_of_refusal(path: Path, code: str, *, psf: bool = False) -> float:
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=f"^{code}: .*expected"):
            (read_psf if psf else read_image)(path, LIMITS)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak / MIB


@pytest.mark.parametrize(("column", "packed"), [("COMPRESSED_DATA", False), ("GZIP_COMPRESSED_DATA", True)])
def test_a_tenth_of_a_megabyte_that_inflates_to_100_uses_no_memory(
    tmp_path: Path, column: str, packed: bool
) -> None:
    content = lying_tiles(gzip.compress(bytes(100_000_000)), column=column)
    assert len(content) < 120_000
    path = tmp_path / "bomb.fits"
    path.write_bytes(gzip.compress(content) if packed else content)
    assert peak_mib_of_refusal(path, "tile-too-large") < 30


def test_a_stream_that_is_too_long_for_its_tile_is_refused(tmp_path: Path) -> None:
    """By a byte; or a stream of empty deflate blocks, which each of 64 descriptors would read, before it is inflated."""
    nothing = gzip.compress(b"")
    empty = nothing[:10] + bytes.fromhex("000000ffff") * 20_000 + nothing[10:]
    for stream in (gzip.compress(bytes(64 * 8 + 1)), empty):
        (tmp_path / "bomb.fits").write_bytes(lying_tiles(stream))
        assert peak_mib_of_refusal(tmp_path / "bomb.fits", "tile-too-large") < 10


def first_row(path: Path) -> int:
    """Where the table of the tiles begins."""
    with fits.open(path, disable_image_compression=True) as hdus:
        return int(hdus[1].fileinfo()["datLoc"])


def with_first_length(path: Path, change: Callable[[int], int]) -> None:
    """Change the length that the first descriptor gives for its tile."""
    at, content = first_row(path), bytearray(path.read_bytes())
    content[at : at + 4] = change(int.from_bytes(content[at : at + 4], "big")).to_bytes(4, "big")
    path.write_bytes(content)


def test_a_stream_of_rice_that_ends_too_early_is_refused(tmp_path: Path) -> None:
    """Cut anywhere, for each width of a pixel: astropy's encoder writes no byte that the decoder does not read."""
    rows = {
        "constant": np.full(100, 7),
        "smooth": np.arange(100) // 3,
        "noise": RNG.integers(0, 120, 100),
        "spikes": np.where(np.arange(100) % 41 == 0, 120, 0),
        "short": RNG.integers(0, 120, 5),
    }
    cuts: list[Callable[[int], int]] = [lambda n: 1, lambda n: n // 2, lambda n: n - 5, lambda n: n - 1]
    for name, dtype, cut in product(rows, ("u1", "i2", "i4"), cuts):
        pixels = np.tile(rows[name], (20, 1)).astype(dtype)
        path = written(tmp_path / "t.fits", pixels, compression_type="RICE_1")
        with_first_length(path, lambda length, cut=cut: max(cut(length), 1))
        with pytest.raises(DataError, match=r"bad-tile: .*ends too early"):
            read_image(path, LIMITS)


def test_zeros_to_the_end_of_a_stream_of_rice_are_not_followed_past_it(tmp_path: Path) -> None:
    """The code of the first block is 1: a difference is a number of zeros and a one. There is no one."""
    pixels = RNG.integers(0, 9999, (20, 100)).astype("i2")
    path = written(tmp_path / "t.fits", pixels, compression_type="RICE_1", tile_shape=(20, 100))
    heap, content = first_row(path) + 8, path.read_bytes()
    path.write_bytes(content[:heap] + (bytes(2) + b"\x20").ljust(len(content) - heap, b"\0"))
    with pytest.raises(DataError, match=r"bad-tile: .*ends too early"):
        read_image(path, LIMITS)


def test_scaled_pixels_of_8_bytes_are_refused(tmp_path: Path) -> None:
    """astropy would return memory that it has not written. The first tile is said to be as long as two."""
    pixels = RNG.normal(100, 1, (40, 50))
    options = {"tile_shape": (1, 50), "quantize_level": 4.0, "quantize_method": 1}
    path = written(tmp_path / "t.fits", pixels, compression_type="NOCOMPRESS", **options)
    assert np.allclose(read_image(path, LIMITS).pixels, pixels, atol=1)
    with_first_length(path, lambda length: 2 * length)
    with pytest.raises(DataError, match="bad-tile"):
        read_image(path, LIMITS)


WHOLE, FLOATS = ("u1", "i2", "i4"), ("f4", "f8")
EXACT = [(codec, dtype) for codec in ("GZIP_1", "GZIP_2", "NOCOMPRESS") for dtype in (*WHOLE, *FLOATS)]


def test_correct_tiles_pass(tmp_path: Path) -> None:
    for codec, dtype in (*EXACT, *(("RICE_1", dtype) for dtype in WHOLE)):
        pixels = RNG.integers(1, 200, (40, 50)).astype(dtype)
        for tile in ((7, 9), (1, 50), (40, 50)):
            options = {"compression_type": codec, "tile_shape": tile, "quantize_level": 0}
            path = written(tmp_path / "tiles.fits", pixels, **options)
            assert read_summary(path, LIMITS).codec == codec
            assert np.array_equal(read_image(path, LIMITS).pixels, pixels), (codec, dtype, tile)


def test_quantised_floats_pass_with_tiles_that_could_not_be_quantised(tmp_path: Path) -> None:
    pixels = RNG.normal(100, 1, (40, 50)).astype("f4")
    pixels[3] *= 1e30  # stored in GZIP_COMPRESSED_DATA
    for codec in ("RICE_1", "GZIP_1", "GZIP_2"):
        path = written(tmp_path / "tiles.fits", pixels, compression_type=codec)
        assert np.allclose(read_image(path, LIMITS).pixels, pixels, rtol=0.01), codec


@pytest.mark.parametrize(
    ("tail", "code"),
    [("many HDUs", "too-many-hdus"), ("long header", "header-too-long"), ("inflated data", "too-many-bytes")],
)
def test_hdus_after_the_kernel_of_a_psf_obey_the_limits(tmp_path: Path, tail: str, code: str) -> None:
    path = tmp_path / "psf.fits"
    path.write_bytes(psf_with_a_tail(tail))
    read_psf(path, LIMITS, parts=False)  # a convolution does not read them
    assert peak_mib_of_refusal(path, code, psf=True) < 60


def test_a_compressed_component_is_not_inflated(tmp_path: Path) -> None:
    path = tmp_path / "psf.fits"
    path.write_bytes(psf_with_a_tail("component of tiles"))
    assert read_psf(path, LIMITS).components == {}
