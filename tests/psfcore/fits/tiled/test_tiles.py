"""Tiles that inflate to more than they declare are refused before they use memory; correct tiles pass."""

from __future__ import annotations

import gzip
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits, check_all_headers
from psfcore.fits.images import read_image
from psfcore.fits.psfs import read_psf
from tests.fits_bombs import lying_tiles, psf_with_a_tail

MIB = 2**20
LIMITS = FitsLimits(max_pixels=4096 * 4096)


def peak_mib_of_refusal(path: Path, code: str, *, psf: bool = False) -> float:
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as caught:
            (read_psf if psf else read_image)(path, LIMITS)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert caught.value.code == code and "expected" in caught.value.message
    return peak / MIB


@pytest.mark.parametrize("column", ["COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"])
@pytest.mark.parametrize("packed", [False, True])
def test_half_a_megabyte_that_inflates_to_537_uses_no_memory(
    tmp_path: Path, column: str, packed: bool
) -> None:
    content = lying_tiles(gzip.compress(bytes(537_000_000)), column=column)
    assert len(content) < 540_000
    path = tmp_path / "bomb.fits"
    path.write_bytes(gzip.compress(content) if packed else content)
    assert peak_mib_of_refusal(path, "tile-too-large") < 30


def test_a_stream_slightly_too_long_for_its_tile_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bomb.fits").write_bytes(lying_tiles(gzip.compress(bytes(64 * 8 + 1))))
    assert peak_mib_of_refusal(tmp_path / "bomb.fits", "tile-too-large") < 10


def test_a_long_empty_stream_shared_by_many_tiles_takes_no_time(tmp_path: Path) -> None:
    """The stream consists of empty deflate blocks; each of 64 descriptors would read all of it."""
    nothing = gzip.compress(b"")[:10] + bytes.fromhex("000000ffff") * 2_000_000 + gzip.compress(b"")[10:]
    (tmp_path / "bomb.fits").write_bytes(lying_tiles(nothing))
    started = time.monotonic()
    peak_mib_of_refusal(tmp_path / "bomb.fits", "tile-too-large")
    assert time.monotonic() - started < 10  # guards against a hang; about 0.3 s normally


WHOLE, FLOATS = ("u1", "i2", "i4"), ("f4", "f8")
EXACT = [(codec, dtype) for codec in ("GZIP_1", "GZIP_2", "NOCOMPRESS") for dtype in (*WHOLE, *FLOATS)]


@pytest.mark.parametrize(("codec", "dtype"), [*EXACT, *(("RICE_1", dtype) for dtype in WHOLE)])
@pytest.mark.parametrize("tile", [(7, 9), (1, 50), (40, 50)])
def test_correct_tiles_pass(tmp_path: Path, codec: str, dtype: str, tile: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).integers(1, 200, (40, 50)).astype(dtype)
    hdu = fits.CompImageHDU(pixels, compression_type=codec, tile_shape=tile, quantize_level=0)
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "tiles.fits")
    assert np.array_equal(read_image(tmp_path / "tiles.fits", LIMITS).pixels, pixels)


@pytest.mark.parametrize("codec", ["RICE_1", "GZIP_1", "GZIP_2"])
def test_quantised_floats_pass_with_tiles_that_could_not_be_quantised(tmp_path: Path, codec: str) -> None:
    pixels = np.random.default_rng(0).normal(100, 1, (40, 50)).astype("f4")
    pixels[3] *= 1e30  # stored in GZIP_COMPRESSED_DATA
    hdu = fits.CompImageHDU(pixels, compression_type=codec)
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "tiles.fits")
    assert np.allclose(read_image(tmp_path / "tiles.fits", LIMITS).pixels, pixels, rtol=0.01)


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


def test_all_headers_together_obey_one_limit(tmp_path: Path) -> None:
    long = fits.PrimaryHDU()
    for number in range(400):
        long.header.add_history(f"{number}")
    more = [fits.ImageHDU(header=long.header.copy()) for _ in range(5)]
    fits.HDUList([long, *more]).writeto(tmp_path / "long.fits")
    check_all_headers(tmp_path / "long.fits", FitsLimits(max_pixels=100, max_header_bytes=250_000))
    with pytest.raises(DataError) as caught:
        check_all_headers(tmp_path / "long.fits", FitsLimits(max_pixels=100, max_header_bytes=150_000))
    assert caught.value.code == "header-too-long"
