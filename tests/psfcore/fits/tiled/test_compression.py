"""Counts and parameters of compressed images are checked in the header, before a decoder trusts them."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import HeaderError
from psfcore.fits.header import FitsLimits, read_summary
from tests.conftest import REPOSITORY
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
    "TFIELDS missing": compressed(TFIELDS=""),
    "TFIELDS of 2^32 in a table before the image": table_before_an_image(f"TFIELDS = {2**32}"),
    "ZNAXIS of 2^32 in a table before the image": table_before_an_image("TFIELDS = 0", f"ZNAXIS  = {2**32}", "ZIMAGE  = 1"),
    "a row shorter than its columns": compressed(TFORM1="'99999999D'"),
    "NAXIS1 longer than its columns": compressed(NAXIS1=9),
    "a column that is no format": compressed(TFORM1="'1PB1PB'"),
    "pixels in a column without descriptors": compressed(TFORM1="'8B'"),
    "a heap of floats": compressed(TFORM1="'1PE(50)'"),
    "no column of pixels": compressed(TTYPE1="'OTHER'"),
    "a scale of the column": compressed(TSCAL1=2),
    "PCOUNT negative": compressed(PCOUNT=-1),
    "a heap that starts in the rows": compressed(THEAP=8),
    "a heap that starts after the data": compressed(THEAP=8 * 16 + 101),
    "BYTEPIX 8": codec_settings(BLOCKSIZE=32, BYTEPIX=8),
    "BYTEPIX 3": codec_settings(BYTEPIX=3),
    "BYTEPIX 4 of pixels of 2 bytes": codec_settings(BYTEPIX=4),
    "BYTEPIX of text": codec_settings(BYTEPIX="'2'"),
    "BYTEPIX 2.0": codec_settings(BYTEPIX="2.0"),
    "BYTEPIX in small letters": codec_settings(bytepix=8),
    "BYTEPIX twice": compressed(ZNAME1="'BYTEPIX'", ZVAL1=2, ZNAME2="'BYTEPIX'", ZVAL2=8),
    "BLOCKSIZE 33": codec_settings(BLOCKSIZE=33, BYTEPIX=2),
    "an unknown parameter": codec_settings(OTHER=1),
    "ZDITHER0 missing": compressed(ZQUANTIZ="'SUBTRACTIVE_DITHER_1'"),
    "ZDITHER0 of 0": compressed(ZQUANTIZ="'SUBTRACTIVE_DITHER_1'", ZDITHER0=0),
    "ZDITHER0 of 10001": compressed(ZQUANTIZ="'SUBTRACTIVE_DITHER_2'", ZDITHER0=10_001),
    "an unknown dither": compressed(ZQUANTIZ="'OTHER'"),
    "a keyword that is a pattern": compressed(**{"ZTILE*": 1}),
    "a keyword that is no pattern": compressed(**{"ZTIL?[J": 1}),
    "a long pattern": compressed().replace(
        b"ZCMPTYPE= ", b"HIERARCH TFORM" + b"*A" * 20 + b"B = 1" + b" " * 21 + b"HIERARCH TFORM" + b"A" * 40 + b" = 1" + b" " * 22 + b"ZCMPTYPE= "
    ),
    "ZBLANK of 2^40": compressed(ZBLANK=2**40),
    "PCOUNT of a plain image": block(*image_cards(32, 16, 16, "PCOUNT  = 8"), data=bytes(2000)),
    "GCOUNT of a plain image": block(*image_cards(32, 16, 16, "GCOUNT  = 2"), data=bytes(4000)),
    "an END with a comment": good().replace(b"END " + b" " * 76, b"END / it ends".ljust(80) + b"X" * 0, 1),
}  # fmt: skip


def test_a_count_or_parameter_outside_the_standard_is_refused_in_the_header(
    tmp_path: Path, subtests: pytest.Subtests
) -> None:
    for name, content in BAD_CARDS.items():
        (tmp_path / "file.fits").write_bytes(content)
        with subtests.test(name), pytest.raises(HeaderError, match=r"^bad-card: .*expected.*got"):
            read_summary(tmp_path / "file.fits", LIMITS)


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
from psfcore.fits.images import read_image
for path in sys.argv[1:]:
    try:
        print(read_image(path, FitsLimits(max_pixels=10**6)).pixels.shape)
    except DataError as error:
        print(error.code)
"""


def test_the_decoder_never_sees_what_it_cannot_handle(tmp_path: Path) -> None:
    """In a process that may use 600 MiB of private memory, because a wrong parameter could crash the decoder.

    With BYTEPIX 8, it would return as much memory of the process as pixels. astropy makes a list of TFIELDS columns, and
    looks at the second HDU when it opens a file.
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
