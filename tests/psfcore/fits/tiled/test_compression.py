"""Counts and parameters of compressed images are checked in the header, before a decoder trusts them."""

from __future__ import annotations

import io
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError, HeaderError
from psfcore.fits.header import FitsLimits, read_summary
from psfcore.fits.images import read_image
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


def settings(**values: object) -> bytes:
    """A compressed image with these parameters of its codec."""
    cards = {}
    for number, (name, value) in enumerate(values.items(), 1):
        cards |= {f"ZNAME{number}": f"'{name}'", f"ZVAL{number}": value}
    return compressed(**cards)


BAD = {
    "TFIELDS of 2^32": compressed(TFIELDS=2**32),
    "TFIELDS of 1000": compressed(TFIELDS=1000),
    "TFIELDS negative": compressed(TFIELDS=-1),
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
    "GCOUNT of 2": compressed(GCOUNT=2),
    "PCOUNT negative": compressed(PCOUNT=-1),
    "a heap that starts in the rows": compressed(THEAP=8),
    "a heap that starts after the data": compressed(THEAP=8 * 16 + 101),
    "BYTEPIX 8": settings(BLOCKSIZE=32, BYTEPIX=8),
    "BYTEPIX -1": settings(BYTEPIX=-1),
    "BYTEPIX 2^31 - 1": settings(BYTEPIX=2**31 - 1),
    "BYTEPIX 3": settings(BYTEPIX=3),
    "BYTEPIX 4 of pixels of 2 bytes": settings(BYTEPIX=4),
    "BYTEPIX of text": settings(BYTEPIX="'2'"),
    "BYTEPIX 2.0": settings(BYTEPIX="2.0"),
    "BYTEPIX in small letters": settings(bytepix=8),
    "BYTEPIX twice": compressed(ZNAME1="'BYTEPIX'", ZVAL1=2, ZNAME2="'BYTEPIX'", ZVAL2=8),
    "BLOCKSIZE 2^24": settings(BLOCKSIZE=2**24, BYTEPIX=2),
    "BLOCKSIZE 0": settings(BLOCKSIZE=0, BYTEPIX=2),
    "BLOCKSIZE 33": settings(BLOCKSIZE=33, BYTEPIX=2),
    "an unknown parameter": settings(OTHER=1),
    "ZDITHER0 missing": compressed(ZQUANTIZ="'SUBTRACTIVE_DITHER_1'"),
    "ZDITHER0 of 0": compressed(ZQUANTIZ="'SUBTRACTIVE_DITHER_1'", ZDITHER0=0),
    "ZDITHER0 negative": compressed(ZQUANTIZ="'SUBTRACTIVE_DITHER_2'", ZDITHER0=-5),
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


@pytest.mark.parametrize("name", BAD)
def test_a_count_or_parameter_outside_the_standard_is_refused_in_the_header(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / "file.fits").write_bytes(BAD[name])
    with pytest.raises(HeaderError) as caught:
        read_summary(tmp_path / "file.fits", LIMITS)
    assert caught.value.code == "bad-card"
    assert "expected" in caught.value.message and "got" in caught.value.message


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"ZTILE1": 1, "ZTILE2": 1, "ZNAXIS1": 300, "ZNAXIS2": 300, "NAXIS2": 90_000}, "65536 tiles"),
        ({"ZTILE1": 2**40}, "tiles of 1 to 2147483647 pixels"),
        ({"ZTILE2": -1}, "integer from 0"),
    ],
)
def test_tiles_are_counted(tmp_path: Path, changes: dict[str, int], said: str) -> None:
    rows = compressed(**changes) + bytes(8 * 90_000)
    (tmp_path / "file.fits").write_bytes(rows)
    with pytest.raises(HeaderError, match=said):
        read_summary(tmp_path / "file.fits", LIMITS)


def compressed_file(path: Path, pixels: np.ndarray, **options: object) -> bytes:
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(pixels, **options)]).writeto(path)
    return path.read_bytes()


def replaced(content: bytes, key: str, value: object) -> bytes:
    """The file with another value in a card of its second header."""
    at = content.index(key.ljust(8).encode() + b"=", content.index(b"XTENSION"))
    return content[:at] + f"{key:<8}= {value:>20}".ljust(80).encode() + content[at + 80 :]


@pytest.mark.parametrize(("bytepix", "blocksize"), [(8, 32), (2, 2**24), (-1, 32), (2, 0)])
def test_the_decoder_of_rice_never_sees_a_parameter_that_it_cannot_handle(
    tmp_path: Path, bytepix: int, blocksize: int
) -> None:
    """With BYTEPIX 8, it would return as much memory of the process as pixels; with the others, it could crash."""
    pixels = np.arange(40 * 50, dtype=np.int16).reshape(40, 50)
    content = compressed_file(tmp_path / "good.fits", pixels, compression_type="RICE_1")
    content = replaced(replaced(content, "ZVAL1", blocksize), "ZVAL2", bytepix)
    (tmp_path / "bad.fits").write_bytes(content)
    done = read_in_a_child(tmp_path / "bad.fits", 200)
    assert done.stdout == "bad-card\n", f"{done.returncode}: {done.stdout}{done.stderr}"


@pytest.mark.parametrize("tfields", [2**32, 2**40])
def test_a_table_of_billions_of_columns_needs_no_memory(tmp_path: Path, tfields: int) -> None:
    (tmp_path / "bad.fits").write_bytes(compressed(TFIELDS=tfields))
    done = read_in_a_child(tmp_path / "bad.fits", 200)
    assert done.stdout == "bad-card\n", f"{done.returncode}: {done.stdout}{done.stderr}"


def test_what_follows_an_image_is_not_prepared(tmp_path: Path) -> None:
    """astropy looks at the second HDU when it opens a file."""
    (tmp_path / "file.fits").write_bytes(good() + compressed(TFIELDS=2**32)[2880:])
    done = read_in_a_child(tmp_path / "file.fits", 200)
    assert done.stdout == "no-signal\n", f"{done.returncode}: {done.stdout}{done.stderr}"


def read_in_a_child(path: Path, mib: int) -> subprocess.CompletedProcess[str]:
    """Read an image in a process that may use `mib` MiB of private memory; it prints the code of the error."""
    code = (
        "import sys\nfrom psfcore.errors import DataError\nfrom psfcore.fits.header import FitsLimits\n"
        "from psfcore.fits.images import read_image\n"
        "try:\n    print(read_image(sys.argv[1], FitsLimits(max_pixels=10**6)).pixels.shape)\n"
        "except DataError as error:\n    print(error.code)\n"
    )
    return subprocess.run(
        [sys.executable, "-c", code, str(path)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, ((mib + 400) * MIB, (mib + 400) * MIB)),
    )


@pytest.mark.parametrize(("dtype", "bytepix"), [("u1", 1), ("i2", 2), ("i4", 4)])
def test_the_parameters_of_the_standard_pass(tmp_path: Path, dtype: str, bytepix: int) -> None:
    pixels = np.random.default_rng(0).integers(1, 100, (40, 50)).astype(dtype)
    content = compressed_file(tmp_path / "good.fits", pixels, compression_type="RICE_1")
    assert f"ZVAL2   = {bytepix:>20}".encode() in content
    assert np.array_equal(read_image(tmp_path / "good.fits", LIMITS).pixels, pixels)


@pytest.mark.parametrize("codec", ["GZIP_1", "GZIP_2", "NOCOMPRESS"])
def test_scaled_pixels_of_8_bytes_are_refused(tmp_path: Path, codec: str) -> None:
    """astropy would return memory that it has not written."""
    pixels = np.random.default_rng(0).normal(100, 1, (4, 50))
    options = {"compression_type": codec, "tile_shape": (1, 50), "quantize_level": 4.0, "quantize_method": 1}
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(pixels, **options)]).writeto(tmp_path / "good.fits")
    with fits.open(tmp_path / "good.fits", disable_image_compression=True) as hdus:
        table, names = hdus[1], hdus[1].columns.names
        assert "ZSCALE" in names
    wide = np.arange(4 * 50, dtype=">i8").reshape(4, 50)
    streams = [_stored(codec, row) for row in wide]
    (tmp_path / "bad.fits").write_bytes(_with_streams(table.header, names, streams))
    with pytest.raises(DataError, match="expected") as caught:
        read_image(tmp_path / "bad.fits", LIMITS)
    assert caught.value.code in ("bad-tile", "tile-too-large")


def _stored(codec: str, row: np.ndarray) -> bytes:
    import gzip

    if codec == "NOCOMPRESS":
        return row.tobytes()
    shuffled = row.view(np.uint8).reshape(-1, 8).T.tobytes() if codec == "GZIP_2" else row.tobytes()
    return gzip.compress(shuffled)


def _with_streams(header: fits.Header, names: list[str], streams: list[bytes]) -> bytes:
    """A compressed image whose column COMPRESSED_DATA holds these streams, of one row each."""
    kinds = {"ZSCALE": ">f8", "ZZERO": ">f8"}
    rows = np.zeros(
        len(streams), dtype=[(name, *((kinds[name],) if name in kinds else (">i4", (2,)))) for name in names]
    )
    offsets = np.cumsum([0, *map(len, streams)])[:-1]
    rows["COMPRESSED_DATA"] = np.stack([[len(one) for one in streams], offsets], axis=1)
    rows["ZSCALE"] = 1.0
    header = header.copy()
    header["NAXIS1"], header["PCOUNT"] = rows.itemsize, sum(map(len, streams))
    for key in ("THEAP", "CHECKSUM", "DATASUM"):
        header.remove(key, ignore_missing=True)
    file = io.BytesIO()
    fits.PrimaryHDU().writeto(file)
    data = rows.tobytes() + b"".join(streams)
    return file.getvalue() + header.tostring().encode() + data + bytes(-len(data) % 2880)
