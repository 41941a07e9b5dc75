"""Wrong files raise an error with the right code. tests/fuzz reads random and damaged bytes."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import HeaderError
from psfcore.fits.hdus import read_pixels
from psfcore.fits.header import FitsLimits, all_hdus, read_summary
from tests.fits_bombs import gzip_named
from tests.psfcore.fits.raw_files import block, compressed, cube, empty_primary, good, image_cards, table

SMALL = FitsLimits(max_pixels=4096 * 4096, max_header_bytes=64 * 1024, max_hdus=8)

# The tests contain damaged cards, and astropy warns of many of them.
pytestmark = pytest.mark.filterwarnings("ignore::astropy.utils.exceptions.AstropyUserWarning")


BAD = {
    "empty": (b"", "empty-file"),
    "text": (b"hello, I am an image\n" * 200, "not-fits"),
    "SIMPLE with other bytes": (b"SIMPLE  =       \x1f>\xde\x0b!        T".ljust(80) + good()[80:], "bad-card"),
    "jpeg 2000": (b"\x00\x00\x00\x0cjP  \r\n\x87\n" + bytes(5000), "not-fits"),
    "five bytes": (b"SIMPL", "truncated-header"),
    "cut in the header": (good()[:400], "truncated-header"),
    "END never comes": (b"SIMPLE  =                    T".ljust(80 * 1024), "header-too-long"),
    "cut in the data": (good()[: 2880 + 500], "truncated-data"),
    "cut in a pixel": (good()[: 2880 + 501], "truncated-data"),
    "no data at all": (good()[:2880], "truncated-data"),
    "only an empty primary": (empty_primary(), "no-image"),
    "only a table": (table(), "table-only"),
    "one axis": (cube(100), "not-2d"),
    "three axes": (cube(4, 4, 4), "three-axes"),
    "three axes, one of length 1": (cube(16, 16, 1), "three-axes"),
    "four axes": (cube(4, 4, 2, 2), "not-2d"),
    "60000 x 60000": (block(*image_cards(60000, 60000)), "too-many-pixels"),
    "huge axes": (block(*image_cards(2**40, 2**40)), "too-many-pixels"),
    "axes beyond 64 bits": (block(*image_cards(10**30, 2)), "bad-card"),
    "no columns": (block(*image_cards(0, 16)), "zero-size"),
    "negative axis": (block(*image_cards(-32, 16)), "bad-card"),
    "axis of text": (block(*image_cards("'many'", 16)), "bad-card"),
    "axis missing": (block(*image_cards()[:-1]), "bad-card"),
    "axis twice": (block(*image_cards(32, 16, 16, "NAXIS1  = 64"), data=bytes(4096)), "bad-card"),
    "odd BITPIX": (block(*image_cards(32, 16, 24)), "bad-card"),
    "negative PCOUNT": (block(*image_cards(32, 16, 16, "PCOUNT  = -5")), "bad-card"),
    "absurd PCOUNT": (block(*image_cards(32, 16, 16, f"PCOUNT  = {2**62}")), "bad-card"),
    "random groups": (block(*image_cards(32, 16, 16, "GROUPS  =                    T")), "random-groups"),
    "codec of loss": (compressed("HCOMPRESS_1"), "codec-not-allowed"),
    "codec PLIO": (compressed("PLIO_1"), "codec-not-allowed"),
    "compressed 60000 x 60000": (compressed(ZNAXIS1=60000, ZNAXIS2=60000), "too-many-pixels"),
    "compressed three axes": (compressed(ZNAXIS=3, ZNAXIS3=2), "three-axes"),
    "tiles of 60000": (compressed(ZTILE1=60000, ZTILE2=60000), "bad-tiles"),
    "tiles of nothing": (compressed(ZTILE1=0), "bad-tiles"),
    "rows and tiles disagree": (compressed(NAXIS2=15), "bad-tiles"),
    "compressed, cut": (compressed()[:-2880], "truncated-data"),
    "nine empty HDUs": (
        empty_primary() + 9 * block("XTENSION= 'IMAGE'", "BITPIX  = 8", "NAXIS   = 0"), "too-many-hdus",
    ),
    "gzip of nothing": (gzip.compress(b""), "empty-file"),
    "gzip cut": (gzip.compress(good() + np.random.default_rng(0).bytes(9000))[:60], "truncated-gzip"),
    "gzip broken": (b"\x1f\x8b" + bytes(100), "bad-gzip"),
    "gzip of a long name": (gzip_named(good(), 2**17), "bad-gzip"),
    "gzip of many members": (20_000 * gzip.compress(b"") + gzip.compress(b"x"), "bad-gzip"),
    "gzip, 60000 x 60000": (gzip.compress(block(*image_cards(60000, 60000))), "too-many-pixels"),
    "gzip, END never comes": (gzip.compress(b"SIMPLE  = T".ljust(50_000_000)), "header-too-long"),
}  # fmt: skip


def test_a_bad_file_raises_its_error_code(tmp_path: Path, subtests: pytest.Subtests) -> None:
    path = tmp_path / "file.fits"
    for name, (content, code) in BAD.items():
        path.write_bytes(content)
        for read in (read_summary, read_pixels):
            with subtests.test(name), pytest.raises(HeaderError, match=f"^{code}: .*expected") as caught:
                read(path, SMALL)
            assert len(caught.value.message) < 300, name


def test_the_error_about_a_cube_says_how_to_write_one_plane(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for shape, hdu in (((1, 5, 6), 0), ((1, 2, 5, 6), 1)):
        cube = np.arange(np.prod(shape), dtype="f4").reshape(shape)
        image = fits.PrimaryHDU(cube) if hdu == 0 else fits.ImageHDU(cube)
        fits.HDUList([*[fits.PrimaryHDU()] * hdu, image]).writeto(tmp_path / "FILE", overwrite=True)
        (tmp_path / "NEW").unlink(missing_ok=True)
        with pytest.raises(HeaderError) as caught:
            read_summary(tmp_path / "FILE", SMALL)
        exec(caught.value.message.partition("astropy: ")[2], {"fits": fits})
        assert read_summary(tmp_path / "NEW", SMALL).shape == (5, 6)
        np.testing.assert_array_equal(fits.getdata(tmp_path / "NEW", hdu), cube.reshape(-1, 5, 6)[0])


def test_a_gzip_file_may_have_a_name_a_comment_several_members_and_zeros(tmp_path: Path) -> None:
    content = good()
    path = tmp_path / "parts.fits.gz"
    parts = [gzip_named(content[at : at + 1000], 60_000) for at in range(0, len(content), 1000)]
    path.write_bytes(bytes(1000).join(parts) + bytes(1000))
    assert read_summary(path, SMALL).gzipped and fits.getdata(path).shape == read_summary(path, SMALL).shape
    path.write_bytes(b"".join(parts[:3]) + parts[3][:60_015])
    with pytest.raises(HeaderError, match=r"^truncated-gzip"):
        read_summary(path, SMALL)


def test_a_gzip_bomb_is_refused_before_it_is_inflated(tmp_path: Path) -> None:
    """A file of a few kilobytes declares a table of 300 GB before the image."""
    rows = 3 * 10**11 // 8
    cards = ["BITPIX  = 8", "NAXIS   = 2", "NAXIS1  = 8", f"NAXIS2  = {rows}", "PCOUNT  = 0", "GCOUNT  = 1"]
    path = tmp_path / "bomb.fits.gz"
    path.write_bytes(gzip.compress(empty_primary() + block("XTENSION= 'BINTABLE'", *cards) + bytes(10**7)))
    with pytest.raises(HeaderError, match=r"^too-many-bytes"):
        read_summary(path, SMALL)


def test_no_pixel_is_inflated(tmp_path: Path) -> None:
    """The compressed data of this file are zero bytes, so reading them would fail."""
    path = tmp_path / "hollow.fits"
    path.write_bytes(compressed())
    summary = read_summary(path, SMALL)
    assert (summary.hdu, summary.shape, summary.codec, summary.bitpix) == (1, (16, 32), "RICE_1", 16)


def test_all_headers_together_obey_one_limit(tmp_path: Path) -> None:
    long = fits.PrimaryHDU()
    for number in range(400):
        long.header.add_history(f"{number}")
    more = [fits.ImageHDU(header=long.header.copy()) for _ in range(5)]
    fits.HDUList([long, *more]).writeto(tmp_path / "long.fits")
    all_hdus(tmp_path / "long.fits", FitsLimits(max_pixels=100, max_header_bytes=250_000))
    with pytest.raises(HeaderError, match=r"^header-too-long"):
        all_hdus(tmp_path / "long.fits", FitsLimits(max_pixels=100, max_header_bytes=150_000))


def test_a_real_jpeg_2000_is_named(real: Callable[[str], Path]) -> None:
    with pytest.raises(HeaderError, match=r"JPEG 2000.*use the FITS file"):
        read_summary(real("aia/2022_01_01__00_03_52_835__SDO_AIA_AIA_193.jp2"), SMALL)
