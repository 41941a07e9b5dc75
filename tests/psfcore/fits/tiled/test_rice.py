"""A stream of RICE_1 is accepted exactly if it holds all pixels of its tile."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.images import read_image
from psfcore.fits.tiled.rice import rice_is_complete

LIMITS = FitsLimits(max_pixels=10_000)
RNG = np.random.default_rng(0)
ROWS = {
    "constant": np.full(100, 7),
    "smooth": np.arange(100) // 3,
    "noise": RNG.integers(0, 120, 100),
    "spikes": np.where(np.arange(100) % 41 == 0, 120, 0),
    "short": RNG.integers(0, 120, 5),
    "one block": RNG.integers(0, 120, 32),
}


def stream_of(folder: Path, row: np.ndarray, bytepix: int) -> bytes:
    """The stream of a tile of one row, as astropy compresses it."""
    pixels = row.astype({1: "u1", 2: "i2", 4: "i4"}[bytepix])[None]
    hdu = fits.CompImageHDU(pixels, compression_type="RICE_1", tile_shape=pixels.shape)
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(folder / "tile.fits")
    with fits.open(folder / "tile.fits", disable_image_compression=True) as hdus:
        return bytes(np.asarray(hdus[1].data["COMPRESSED_DATA"][0], dtype=np.uint8))


@pytest.mark.parametrize("bytepix", [1, 2, 4])
@pytest.mark.parametrize("name", ROWS)
def test_a_whole_stream_is_accepted_and_a_cut_one_refused(tmp_path: Path, name: str, bytepix: int) -> None:
    row = ROWS[name]
    stream = stream_of(tmp_path, row, bytepix)
    assert rice_is_complete(stream, len(row), bytepix, 32)
    cut = [rice_is_complete(stream[:end], len(row), bytepix, 32) for end in range(len(stream))]
    assert not any(cut), "astropy's encoder writes no byte that the decoder does not read"
    assert not rice_is_complete(stream, len(row) + 1000, bytepix, 32)


def test_zeros_to_the_end_are_not_followed_past_it() -> None:
    """The code of the first block is 1: a difference is a number of zeros and a one. There is no one."""
    assert not rice_is_complete(bytes(2) + b"\x20" + bytes(10_000), 10, 2, 32)


def test_a_file_with_a_cut_stream_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    pixels = RNG.integers(0, 1000, (2, 100)).astype("i2")
    hdu = fits.CompImageHDU(pixels, compression_type="RICE_1", tile_shape=(1, 100))
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "tiles.fits")
    with fits.open(tmp_path / "tiles.fits", disable_image_compression=True) as hdus:
        first_row = hdus[1].fileinfo()["datLoc"]
    content = bytearray((tmp_path / "tiles.fits").read_bytes())
    length = int.from_bytes(content[first_row : first_row + 4], "big")
    content[first_row : first_row + 4] = (length - 5).to_bytes(4, "big")
    (tmp_path / "cut.fits").write_bytes(bytes(content))
    with pytest.raises(DataError) as caught:
        read_image(tmp_path / "cut.fits", LIMITS)
    assert (caught.value.code, "ends too early" in caught.value.message) == ("bad-tile", True)
