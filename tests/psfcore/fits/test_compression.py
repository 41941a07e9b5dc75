"""Compressed images: wrong parameters are refused in the header, and wrong tiles before a decoder or the memory sees
them."""

from __future__ import annotations

import gzip
import resource
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from itertools import cycle, product
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError, HeaderError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import read_summary
from psfcore.fits.observation import read_observation
from psfcore.fits.psfs import read_psf
from tests.conftest import REPOSITORY
from tests.fits_bombs import lying_tiles, psf_with_a_tail
from tests.psfcore.fits.raw_files import block, compressed, empty_primary, good, image_cards

LIMITS = FitsLimits(max_pixels=4096 * 4096)
MIB = 2**20
TABLE = ["BITPIX  = 8", "NAXIS   = 2", "NAXIS1  = 8", "NAXIS2  = 4", "PCOUNT  = 0", "GCOUNT  = 1"]


def table_before_an_image(*cards: str) -> bytes:
    image = block(
        "XTENSION= 'IMAGE'", *image_cards()[1:], "PCOUNT  = 0", "GCOUNT  = 1", data=bytes(32 * 16 * 2)
    )
    return empty_primary() + block("XTENSION= 'BINTABLE'", *TABLE, *cards, data=bytes(32)) + image


def codec_settings(**values: object) -> bytes:
    """A compressed image with these parameters of its codec."""
    cards = {}
    for number, (name, value) in enumerate(values.items(), 1):
        cards |= {f"ZNAME{number}": f"'{name}'", f"ZVAL{number}": value}
    return compressed(**cards)


BAD_CARDS = {
    "TFIELDS of 1000": compressed(TFIELDS=1000),
    "TFIELDS of 2^32 in a table before the image": table_before_an_image(f"TFIELDS = {2**32}"),
    "ZNAXIS of 2^32 in a table before the image": table_before_an_image(
        "TFIELDS = 0", f"ZNAXIS  = {2**32}", "ZIMAGE  = 1"
    ),
    "PCOUNT negative": compressed(PCOUNT=-1),
    "BYTEPIX 8": codec_settings(BLOCKSIZE=32, BYTEPIX=8),
    "BYTEPIX 4 of pixels of 2 bytes": codec_settings(BYTEPIX=4),
    "BYTEPIX of text": codec_settings(BYTEPIX="'2'"),
    "BYTEPIX in small letters": codec_settings(bytepix=8),
    "BYTEPIX twice": compressed(ZNAME1="'BYTEPIX'", ZVAL1=2, ZNAME2="'BYTEPIX'", ZVAL2=8),
    "BLOCKSIZE 33": codec_settings(BLOCKSIZE=33, BYTEPIX=2),
    "an unknown parameter": codec_settings(OTHER=1),
    "ZDITHER0 missing": compressed(ZQUANTIZ="'SUBTRACTIVE_DITHER_1'"),
    "ZDITHER0 of 0": compressed(ZQUANTIZ="'SUBTRACTIVE_DITHER_1'", ZDITHER0=0),
    "ZDITHER0 of 10001": compressed(ZQUANTIZ="'SUBTRACTIVE_DITHER_2'", ZDITHER0=10_001),
    "an unknown dither": compressed(ZQUANTIZ="'OTHER'"),
    "ZBLANK of 2^40": compressed(ZBLANK=2**40),
    "PCOUNT of a plain image": block(*image_cards(32, 16, 16, "PCOUNT  = 8"), data=bytes(2000)),
    "GCOUNT of a plain image": block(*image_cards(32, 16, 16, "GCOUNT  = 2"), data=bytes(4000)),
    "an END with a comment": good().replace(b"END " + b" " * 76, b"END / it ends".ljust(80) + b"X" * 0, 1),
}


def test_a_count_or_parameter_outside_the_standard_is_refused_in_the_header(
    tmp_path: Path, subtests: pytest.Subtests
) -> None:
    for name, content in BAD_CARDS.items():
        (tmp_path / "file.fits").write_bytes(content)
        with subtests.test(name), pytest.raises(HeaderError, match=r"^bad-card: .*expected.*got"):
            read_summary(tmp_path / "file.fits", LIMITS)


# Wrong cards that the decoder does not trust: it fails in its process.
BAD_TABLES = {
    "TFIELDS missing": compressed(TFIELDS=""),
    "a row shorter than its columns": compressed(TFORM1="'99999999D'"),
    "NAXIS1 longer than its columns": compressed(NAXIS1=9),
    "a column that is no format": compressed(TFORM1="'1PB1PB'"),
    "pixels in a column without descriptors": compressed(TFORM1="'8B'"),
    "a heap of floats": compressed(TFORM1="'1PE(50)'"),
    "no column of pixels": compressed(TTYPE1="'OTHER'"),
    "a scale of the column": compressed(TSCAL1=2),
    "a heap that starts in the rows": compressed(THEAP=8),
    "a heap that starts after the data": compressed(THEAP=8 * 16 + 101),
    "a keyword that is a pattern": compressed(**{"ZTILE*": 1}),
    "a keyword that is no pattern": compressed(**{"ZTIL?[J": 1}),
    "a long pattern": compressed().replace(
        b"ZCMPTYPE= ",
        b"HIERARCH TFORM" + b"*A" * 20 + b"B = 1" + b" " * 21 + b"HIERARCH TFORM" + b"A" * 40 + b" = "
        b"1" + b" " * 22 + b"ZCMPTYPE= ",
    ),
}


def test_a_table_that_contradicts_itself_is_refused_by_the_decoder(
    tmp_path: Path, subtests: pytest.Subtests
) -> None:
    for name, content in BAD_TABLES.items():
        (tmp_path / "file.fits").write_bytes(content)
        with subtests.test(name), pytest.raises(DataError, match=r"^unreadable-pixels: .*expected"):
            read_observation(tmp_path / "file.fits", LIMITS)


def test_tiles_are_counted(tmp_path: Path) -> None:
    for changes, limit in (
        ({"ZTILE1": 1, "ZTILE2": 1, "ZNAXIS1": 300, "ZNAXIS2": 300, "NAXIS2": 90_000}, "65536 tiles"),
        ({"ZTILE1": 2**40}, "tiles of 1 to 2147483647 pixels"),
        ({"ZTILE2": -1}, "integer from 0"),
    ):
        (tmp_path / "file.fits").write_bytes(compressed(**changes) + bytes(8 * 90_000))
        with pytest.raises(HeaderError, match=limit):
            read_summary(tmp_path / "file.fits", LIMITS)


def replaced(content: bytes, key: str, value: object) -> bytes:
    """The file with another value in a card of its second header."""
    at = content.index(key.ljust(8).encode() + b"=", content.index(b"XTENSION"))
    return content[:at] + f"{key:<8}= {value:>20}".ljust(80).encode() + content[at + 80 :]


READER = """
import sys
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.observation import read_observation
for path in sys.argv[1:]:
    try:
        print(read_observation(path, FitsLimits(max_pixels=10**6)).pixels.shape)
    except DataError as error:
        print(error.code)
"""


def test_the_decoder_never_sees_what_it_cannot_handle(tmp_path: Path) -> None:
    """In a process that may use 600 MiB of private memory, because a wrong parameter could crash the decoder.

    With BYTEPIX 8, it would return as much memory of the process as pixels. astropy makes a list of TFIELDS columns,
    and looks at the second HDU when it opens a file.
    """
    pixels = np.arange(40 * 50, dtype=np.int16).reshape(40, 50)
    packed = fits.CompImageHDU(pixels, compression_type="RICE_1")
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "good.fits")
    content = (tmp_path / "good.fits").read_bytes()
    cases = [
        *(
            (replaced(replaced(content, "ZVAL1", blocksize), "ZVAL2", bytepix), "bad-card")
            for bytepix, blocksize in ((8, 32), (2, 2**24), (-1, 32), (2, 0))
        ),
        *((compressed(TFIELDS=fields), "bad-card") for fields in (2**32, 2**40)),
        (good() + compressed(TFIELDS=2**32)[2880:], "no-signal"),
    ]
    for number, (file, _) in enumerate(cases):
        (tmp_path / f"{number}.fits").write_bytes(file)
    done = subprocess.run(
        [sys.executable, "-c", READER, *(str(tmp_path / f"{number}.fits") for number in range(len(cases)))],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (600 * MIB, 600 * MIB)),
    )
    assert done.stdout.split() == [code for _, code in cases], f"{done.returncode}: {done.stderr}"


RNG = np.random.default_rng(0)


def written(path: Path, pixels: np.ndarray, **options: object) -> Path:
    hdus = [fits.PrimaryHDU(), fits.CompImageHDU(pixels, **options)]
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


def peak_mib_of_refusal(path: Path, code: str, *, psf: bool = False) -> float:
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=f"^{code}: .*expected"):
            (read_psf if psf else read_observation)(path, LIMITS)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak / MIB


def test_a_stream_too_long_for_its_tile_is_not_inflated(tmp_path: Path) -> None:
    """By a hundred megabytes, by a byte, or by empty deflate blocks, which each of 64 descriptors would read."""
    nothing, path = gzip.compress(b""), tmp_path / "bomb.fits"
    empty = nothing[:10] + bytes.fromhex("000000ffff") * 20_000 + nothing[10:]
    large = gzip.compress(bytes(100_000_000))
    packed = gzip.compress(lying_tiles(large, column="GZIP_COMPRESSED_DATA"))
    for content, most_mib in (
        (lying_tiles(large), 30),
        (packed, 30),
        (lying_tiles(gzip.compress(bytes(64 * 8 + 1))), 10),
        (lying_tiles(empty), 10),
    ):
        path.write_bytes(content)
        assert len(content) < 120_000 and peak_mib_of_refusal(path, "unreadable-pixels") < most_mib


def first_row(path: Path) -> int:
    """Where the table of the tiles begins."""
    with fits.open(path, disable_image_compression=True) as hdus:
        return int(hdus[1].fileinfo()["datLoc"])


def with_first_length(path: Path, change: Callable[[int], int]) -> None:
    """Change the length that the first descriptor gives for its tile."""
    at, content = first_row(path), bytearray(path.read_bytes())
    content[at : at + 4] = change(int.from_bytes(content[at : at + 4], "big")).to_bytes(4, "big")
    path.write_bytes(content)


def test_streams_of_rice_that_end_too_early_or_do_not_end_are_refused(tmp_path: Path) -> None:
    """Cut anywhere, for each width of a pixel: astropy's encoder writes no byte that the decoder does not read."""
    rows = {
        "constant": np.full(100, 7),
        "smooth": np.arange(100) // 3,
        "noise": RNG.integers(0, 120, 100),
        "spikes": np.where(np.arange(100) % 41 == 0, 120, 0),
        "short": RNG.integers(0, 120, 5),
    }
    cuts: list[Callable[[int], int]] = [lambda n: 1, lambda n: n // 2, lambda n: n - 5, lambda n: n - 1]
    for number, (name, dtype) in enumerate(product(rows, ("u1", "i2", "i4"))):
        pixels = np.tile(rows[name], (20, 1)).astype(dtype)
        path = written(tmp_path / "t.fits", pixels, compression_type="RICE_1")
        with_first_length(path, lambda length, cut=cuts[number % 4]: max(cut(length), 1))
        with pytest.raises(DataError, match=r"unreadable-pixels"):
            read_observation(path, LIMITS)
    # The code of the first block is 1: a difference is a number of zeros and a one. There is no one.
    pixels = RNG.integers(0, 9999, (20, 100)).astype("i2")
    path = written(tmp_path / "t.fits", pixels, compression_type="RICE_1", tile_shape=(20, 100))
    heap, content = first_row(path) + 8, path.read_bytes()
    path.write_bytes(content[:heap] + (bytes(2) + b"\x20").ljust(len(content) - heap, b"\0"))
    with pytest.raises(DataError, match=r"unreadable-pixels"):
        read_observation(path, LIMITS)


def test_scaled_pixels_of_8_bytes_are_refused(tmp_path: Path) -> None:
    """astropy would return memory that it has not written. The first tile is said to be as long as two."""
    pixels = RNG.normal(100, 1, (40, 50))
    options = {"tile_shape": (1, 50), "quantize_level": 4.0, "quantize_method": 1}
    path = written(tmp_path / "t.fits", pixels, compression_type="NOCOMPRESS", **options)
    assert np.allclose(read_observation(path, LIMITS).pixels, pixels, atol=1)
    with_first_length(path, lambda length: 2 * length)
    with pytest.raises(DataError, match="unreadable-pixels"):
        read_observation(path, LIMITS)


WHOLE, FLOATS = ("u1", "i2", "i4"), ("f4", "f8")
EXACT = [(codec, dtype) for codec in ("GZIP_1", "GZIP_2", "NOCOMPRESS") for dtype in (*WHOLE, *FLOATS)]


def test_correct_tiles_pass(tmp_path: Path) -> None:
    stored = [*EXACT, *(("RICE_1", dtype) for dtype in WHOLE)]
    for (codec, dtype), tile in zip(stored, cycle([(7, 9), (1, 50), (40, 50), (7, 9)]), strict=False):
        pixels = RNG.integers(1, 200, (40, 50)).astype(dtype)
        options = {"compression_type": codec, "tile_shape": tile, "quantize_level": 0}
        path = written(tmp_path / "tiles.fits", pixels, **options)
        assert read_summary(path, LIMITS).codec == codec
        assert np.array_equal(read_observation(path, LIMITS).pixels, pixels), (codec, dtype, tile)
    pixels = RNG.normal(100, 1, (40, 50)).astype("f4")
    pixels[3] *= 1e12  # stored in GZIP_COMPRESSED_DATA
    for codec in ("RICE_1", "GZIP_1", "GZIP_2"):
        path = written(tmp_path / "tiles.fits", pixels, compression_type=codec)
        assert np.allclose(read_observation(path, LIMITS).pixels, pixels, rtol=0.01), codec


TAILS = {"many HDUs": "too-many-hdus", "long header": "header-too-long", "inflated data": "truncated-data"}


def test_hdus_after_the_kernel_of_a_psf_obey_the_limits(tmp_path: Path) -> None:
    path = tmp_path / "psf.fits"
    for tail, code in TAILS.items():
        path.write_bytes(psf_with_a_tail(tail))
        read_psf(path, LIMITS, parts=False)  # a convolution does not read them
        assert peak_mib_of_refusal(path, code, psf=True) < 60, tail
    path.write_bytes(psf_with_a_tail("component of tiles"))
    assert read_psf(path, LIMITS).components == {}, "a compressed component is not inflated"
