"""Wrong files raise an error with the right code. tests/fuzz reads random and damaged bytes."""

from __future__ import annotations

import dataclasses
import gzip
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import HeaderError
from psfcore.fits.hdus import read_pixels
from psfcore.fits.header import FitsLimits, all_hdus, read_summary, wavelength_angstrom
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
    "only an empty primary": (empty_primary(), "no-image"),
    "only a table": (table(), "table-only"),
    "one axis": (cube(100), "not-2d"),
    "three axes": (cube(4, 4, 4), "three-axes"),
    "four axes": (cube(4, 4, 2, 2), "not-2d"),
    "60000 x 60000": (block(*image_cards(60000, 60000)), "too-many-pixels"),
    "huge axes": (block(*image_cards(2**40, 2**40)), "too-many-pixels"),
    "20 axes": (
        block(
            "SIMPLE  =                    T", "BITPIX  =                   16", "NAXIS   =                   20",
            *(f"NAXIS{axis:<3}= {2**63 - 1:>20}" for axis in range(1, 21)),
        ),
        "bad-card",
    ),
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
    "gzip of many members": (20_000 * gzip.compress(b"") + gzip.compress(b"x"), "not-fits"),
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
    with path.open("rb") as file:  # as a bulk run names a file that it has opened
        assert read_summary(f"/dev/fd/{file.fileno()}", SMALL) == read_summary(path, SMALL)
    path.write_bytes(b"".join(parts[:3]) + parts[3][:60_015])
    with pytest.raises(HeaderError, match=r"^truncated-gzip"):
        read_summary(path, SMALL)


def test_a_gzip_bomb_is_refused_and_no_pixel_is_inflated(tmp_path: Path) -> None:
    """A file of a few kilobytes declares a table of 300 GB before the image, or holds more bytes than the limits
    allow."""
    rows = 3 * 10**11 // 8
    cards = ["BITPIX  = 8", "NAXIS   = 2", "NAXIS1  = 8", f"NAXIS2  = {rows}", "PCOUNT  = 0", "GCOUNT  = 1"]
    path = tmp_path / "bomb.fits.gz"
    path.write_bytes(gzip.compress(empty_primary() + block("XTENSION= 'BINTABLE'", *cards) + bytes(10**7)))
    with pytest.raises(HeaderError, match=r"^truncated-data"):
        read_summary(path, SMALL)
    with pytest.raises(HeaderError, match=r"^too-many-bytes"):
        read_summary(path, FitsLimits(max_pixels=1000, max_header_bytes=10_000))
    # The compressed data of this file are zero bytes, so reading them would fail.
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


# --- the summary of a header ---


@pytest.mark.parametrize("name", ["two.fits", "two.fits.gz"])
def test_the_first_image_is_used_and_its_cards_are_read(tmp_path: Path, name: str) -> None:
    header = fits.Header()
    header.update(TELESCOP="SOLO/EUI/HRI_EUV", INSTRUME="EUI", DETECTOR="HRI_EUV", WAVELNTH=174, XPOSURE=1.4)
    header.update(BUNIT="DN/s", CDELT1=0.492, CDELT2=0.492, GAINCOMB="combined", PXBEG1=641, PXEND1=700)
    header.update(PXBEG2=577, PXEND2=600)
    header["DATE-BEG"] = "2022-04-01T10:30:05.920"
    rows = fits.BinTableHDU.from_columns([fits.Column("A", "D", array=np.arange(500.0))])
    images = fits.ImageHDU(np.ones((24, 60), ">i2"), header), fits.ImageHDU(np.ones((99, 99)))
    fits.HDUList([fits.PrimaryHDU(), rows, *images]).writeto(tmp_path / name)
    summary = read_summary(tmp_path / name, SMALL)
    assert (summary.hdu, summary.shape, summary.bitpix, summary.codec) == (2, (24, 60), 16, None)
    assert summary.gzipped is name.endswith(".gz")
    assert (summary.instrument, summary.detector, summary.wavelnth) == ("hri_euv", "HRI_EUV", 174.0)
    assert (summary.exposure_s, summary.unit, summary.gain_mode) == (1.4, "DN/s", "combined")
    assert (summary.pxbeg, summary.pxend) == ((641, 577), (700, 600))
    assert summary.date_obs == "2022-04-01T10:30:05.920"
    assert json.loads(json.dumps(dataclasses.asdict(summary), allow_nan=False))["shape"] == [24, 60]


def test_unusable_cards_count_as_missing_and_units_are_converted(tmp_path: Path) -> None:
    odd = ["CDELT1  = 1E999", "XPOSURE = -1.0", "WAVELNTH= 'long'", "BUNIT   = ''", "DETECTOR= 12"]
    path = tmp_path / "odd.fits"
    path.write_bytes(block(*image_cards(32, 16, 16, *odd, "DATE-OBS= 1 2 3"), data=bytes(1024)))
    summary = read_summary(path, SMALL)
    assert (summary.cdelt1, summary.exposure_s, summary.wavelnth, summary.unit) == (None, None, None, None)
    assert (summary.detector, summary.date_obs, summary.instrument) == (None, None, None)
    # The card of XRT and TRACE for the date.
    cards = image_cards(32, 16, 16, "DATE_OBS= '2012-06-05T22:00:00.123'")
    path.write_bytes(block(*cards, data=bytes(1024)))
    assert read_summary(path, SMALL).date_obs == "2012-06-05T22:00:00.123"
    for cards, angstrom in (
        ({"WAVELNTH": 171}, 171.0),
        ({"WAVELNTH": 17.1, "WAVEUNIT": "nm"}, 171.0),
        ({"WAVELNTH": 171, "WAVEUNIT": -10}, 171.0),
        ({"WAVELNTH": 171, "WAVEUNIT": None}, 171.0),
        ({"WAVELNTH": 1710, "WAVEUNIT": "0.01 nm"}, None),
        ({"TELESCOP": "TRACE", "WAVE_LEN": "171"}, 171.0),
        ({"TELESCOP": "TRACE", "WAVE_LEN": "WL"}, None),
        ({"WAVELNTH": 0}, None),
        ({}, None),
    ):
        assert wavelength_angstrom(fits.Header(cards)) == pytest.approx(angstrom), cards


REAL = [
    ("eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits", (2048, 2048), "GZIP_2", "hri_euv"),
    ("eui/solo_L2_eui-fsi174-image_20240109T200055237_V01.fits", (3072, 3040), "RICE_1", None),
    ("aia/AIA20110319_105400_0171.fits.gz", (1024, 1024), None, "aia_171"),
    ("aia/aia.lev1_euv_12s.2022-04-02T132423Z.304.image.fits", (400, 450), "RICE_1", "aia_304"),
    ("aia/derived_aia193_coronalhole_20161123_map.fits.gz", (667, 667), None, "aia_193"),
    ("occultation/AIA1600_venus_20120606_040731_UTC.0041.fits", (480, 854), "RICE_1", None),
    ("other/swap_lv1_20110607_063329.fits.gz", (1024, 1024), None, None),
    ("other/trace_19980519_222143_171.fits.gz", (1024, 1024), None, "trace_171"),
    ("occultation/L1_XRT20120605_215839.9.fits", (384, 384), None, None),
]


def test_real_headers(real: Callable[[str], Path]) -> None:
    for name, shape, codec, instrument in REAL:
        summary = read_summary(real(name), SMALL)
        assert (summary.shape, summary.codec, summary.instrument) == (shape, codec, instrument), name
        assert summary.gzipped is name.endswith(".gz"), name
