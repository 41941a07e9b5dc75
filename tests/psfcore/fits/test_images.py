"""Images and products: what is read, what is masked, and what is written."""

from __future__ import annotations

import gzip
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sunpy.map
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits, read_summary
from psfcore.fits.images import read_image, write_image
from psfcore.image import Image, MaskBit
from psfcore.simulate.observe import demo_image
from tests.psfcore.conftest import gaussian, make_psf

Find = Callable[[str], Path]
CARDS: dict[str, tuple[str | int | float | bool, str]] = {"PSFNAME": ("hri_euv", "point-spread function")}
FSI = "eui/solo_L2_eui-fsi174-image_20240109T200055237_V01.fits"
HRI = "eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits"
AIA = "aia/aia_171_cutout_20130310.fits"
GZ = "aia/AIA20110319_105400_0171.fits.gz"

pytestmark = [
    pytest.mark.filterwarnings("ignore::astropy.utils.exceptions.AstropyUserWarning"),
    pytest.mark.filterwarnings("ignore::sunpy.util.exceptions.SunpyUserWarning"),
]


def ramp(ny: int = 20, nx: int = 24) -> NDArray[np.float64]:
    return np.arange(1.0, 1 + ny * nx).reshape(ny, nx)


def save(path: Path, data: NDArray[np.generic], **cards: object) -> Path:
    fits.PrimaryHDU(data, fits.Header(list(cards.items()))).writeto(path)
    return path


# --- reading ---


@pytest.mark.parametrize("dtype", [">u1", ">i2", ">i4", ">f4", ">f8", ">u2"])
def test_any_storage_becomes_native_float64(tmp_path: Path, limits: FitsLimits, dtype: str) -> None:
    data = (ramp() % 200).astype(dtype)
    image = read_image(save(tmp_path / "a.fits", data, BUNIT="DN", EXPTIME=2.0), limits)
    assert image.pixels.dtype == np.dtype("=f8")
    np.testing.assert_array_equal(image.pixels, ramp() % 200)
    assert (image.unit, image.exposure_s) == ("DN", 2.0)
    assert image.valid.all()


@pytest.mark.parametrize("codec", ["RICE_1", "GZIP_1", "GZIP_2"])
def test_tile_compressed_integers_with_blank(tmp_path: Path, limits: FitsLimits, codec: str) -> None:
    data = ramp().astype(np.int16)
    data[3, 4] = -32768
    hdu = fits.CompImageHDU(data, fits.Header({"BLANK": -32768}), compression_type=codec)
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "c.fits")
    image = read_image(tmp_path / "c.fits", limits)
    assert np.argwhere(~image.valid).tolist() == [[3, 4]]
    assert image.mask[3, 4] == MaskBit.NONFINITE
    np.testing.assert_array_equal(image.pixels[image.valid], ramp()[image.valid])


def test_plain_integers_with_blank(tmp_path: Path, limits: FitsLimits) -> None:
    data = ramp().astype(np.int16)
    data[0, 1] = -1
    image = read_image(save(tmp_path / "b.fits", data, BLANK=-1), limits)
    assert np.argwhere(~image.valid).tolist() == [[0, 1]]


def test_nan_is_masked_and_negative_is_data(tmp_path: Path, limits: FitsLimits) -> None:
    data = ramp()
    data[0, 0], data[1, 1], data[2, 2] = np.nan, -5.0, np.inf
    image = read_image(save(tmp_path / "n.fits", data), limits)
    assert np.argwhere(~image.valid).tolist() == [[0, 0], [2, 2]]
    assert image.pixels[1, 1] == -5.0


def test_a_file_compressed_as_a_whole(tmp_path: Path, limits: FitsLimits) -> None:
    plain = save(tmp_path / "w.fits", ramp())
    packed = tmp_path / "w.fits.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    np.testing.assert_array_equal(read_image(packed, limits).pixels, ramp())


@pytest.mark.parametrize(
    ("cards", "saturation_dn", "level"),
    [
        ({"SATURATE": 400.0, "BUNIT": "DN"}, None, 400.0),
        ({"DATASAT": 300.0, "BUNIT": "DN/s", "XPOSURE": 2.0}, None, 300.0),
        ({"BUNIT": "DN"}, 350.0, 350.0),
        ({"BUNIT": "DN/s", "XPOSURE": 2.0}, 500.0, 250.0),
        ({"BUNIT": "DN / s", "EXPTIME": 2.0, "SATURATE": 400}, 500.0, 250.0),
        ({"BUNIT": "DN"}, None, None),
    ],
)
def test_saturation(
    tmp_path: Path,
    limits: FitsLimits,
    cards: dict[str, object],
    saturation_dn: float | None,
    level: float | None,
) -> None:
    image = read_image(save(tmp_path / "s.fits", ramp(), **cards), limits, saturation_dn=saturation_dn)
    expected = ramp() >= level if level is not None else np.zeros(ramp().shape, bool)
    np.testing.assert_array_equal(image.mask == MaskBit.SATURATED, expected)


@pytest.mark.parametrize(
    ("data", "cards", "saturation_dn", "code"),
    [
        (np.full((20, 20), np.nan), {}, None, "all-nan"),
        (np.full((20, 20), -9, np.int16), {"BLANK": -9}, None, "all-nan"),
        (np.full((20, 20), 500.0), {"SATURATE": 400.0}, None, "all-saturated"),
        (np.full((20, 20), 16383, np.int16), {}, None, "all-saturated"),
        (np.full((20, 20), 65535, np.uint16), {}, None, "all-saturated"),
        (np.zeros((20, 20)), {}, None, "no-signal"),
        (np.full((20, 20), -3.0), {}, None, "no-signal"),
        (ramp(), {"BUNIT": "DN/s"}, 100.0, "no-exposure"),
        (np.ones((10, 40)), {}, None, "too-small"),
    ],
)
def test_unusable_pixels_are_data_errors(
    tmp_path: Path,
    limits: FitsLimits,
    data: NDArray[np.generic],
    cards: dict[str, object],
    saturation_dn: float | None,
    code: str,
) -> None:
    path = save(tmp_path / "x.fits", data, **cards)
    with pytest.raises(DataError) as caught:
        read_image(path, limits, saturation_dn=saturation_dn)
    assert caught.value.code == code
    assert "expected" in caught.value.message


def test_damaged_tiles_are_data_errors(tmp_path: Path, limits: FitsLimits) -> None:
    path = tmp_path / "d.fits"
    hdu = fits.CompImageHDU(ramp(64, 64).astype(np.int32), compression_type="GZIP_1")
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    content = bytearray(path.read_bytes())
    content[-2880:] = b"\xff" * 2880
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read_image(path, limits)
    assert caught.value.code == "unreadable-pixels"


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from(["RICE_1", "GZIP_1", "GZIP_2", "NOCOMPRESS"]),
    st.lists(
        st.tuples(st.integers(2880, 2880 * 6), st.binary(min_size=1, max_size=20)), min_size=1, max_size=5
    ),
)
def test_mutated_files_raise_nothing_but_data_errors(
    tmp_path: Path, codec: str, changes: list[tuple[int, bytes]]
) -> None:
    path = tmp_path / "mutated.fits"
    hdu = fits.CompImageHDU(ramp(32, 40).astype(np.int16), compression_type=codec, tile_shape=(8, 10))
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path, overwrite=True)
    content = bytearray(path.read_bytes())
    for at, new in changes:
        content[at : at + len(new)] = new
    path.write_bytes(content)
    try:
        image = read_image(path, FitsLimits(max_pixels=10**6, max_header_bytes=50_000, max_hdus=4))
    except DataError as error:
        assert error.code
    else:
        assert image.valid.any()


# --- products ---


@pytest.mark.parametrize("name", [FSI, HRI, AIA, GZ])
def test_a_product_without_planes_keeps_header_and_wcs_and_opens_as_one_map(
    tmp_path: Path, limits: FitsLimits, real: Find, name: str
) -> None:
    source = real(name)
    image = read_image(source, limits)
    product = tmp_path / "product.fits"
    write_image(product, image, cards=CARDS, history=["Richardson-Lucy, 20 steps"])
    again = read_image(product, limits)
    np.testing.assert_array_equal(again.pixels, image.pixels.astype(np.float32))
    before, after = sunpy.map.Map(source), sunpy.map.Map(product)
    assert isinstance(after, type(before))
    assert after.wcs.wcs.compare(before.wcs.wcs, tolerance=1e-12)
    changed = (
        "DATAMIN",
        "DATAMAX",
        "DATAMEAN",
        "DATAMEDN",
        "DATARMS",
        "DATASTD",
        "DATASKEW",
        "DATAKURT",
        "DATACENT",
    )
    storage = (
        "BITPIX",
        "BSCALE",
        "BZERO",
        "BLANK",
        "EXTEND",
        "CHECKSUM",
        "DATASUM",
        "EXTNAME",
        "SIMPLE",
        "XTENSION",
    )
    skipped = {*changed, *storage, "PCOUNT", "GCOUNT", "NAXIS", "HISTORY", "COMMENT", "", "EXTVER", "INHERIT"}
    with fits.open(source) as hdus:
        hdus.verify("silentfix")
        original = hdus[1 if hdus[0].header["NAXIS"] == 0 else 0].header
        for card in original.cards:
            if card.keyword in skipped or card.keyword.startswith(("DATAP", "ZNAXIS", "ZHECK", "ZDATA")):
                continue
            wanted = original[card.keyword]
            assert str(again.header[card.keyword]) == str(wanted), card.keyword
        kept = "\n".join(map(str, again.header["HISTORY"]))
        for line in original.get("HISTORY", []):
            assert str(line) in kept
        assert len(again.header.get("COMMENT", [])) == len(original.get("COMMENT", []))
    assert again.header["PSFNAME"] == "hri_euv"
    assert "Richardson-Lucy, 20 steps" in kept


def test_equal_products_are_equal_bytes_with_true_checksums(tmp_path: Path, limits: FitsLimits) -> None:
    image = read_image(save(tmp_path / "in.fits", ramp(), BUNIT="DN"), limits)
    for name in ("one.fits", "two.fits"):
        write_image(tmp_path / name, image, cards=CARDS, history=["x"])
    assert (tmp_path / "one.fits").read_bytes() == (tmp_path / "two.fits").read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with fits.open(tmp_path / "one.fits", checksum=True) as hdus:
            for hdu in hdus:
                assert (hdu.verify_checksum(), hdu.verify_datasum()) == (1, 1)


def test_odd_cards_survive(tmp_path: Path, limits: FitsLimits) -> None:
    long = "word " * 40
    image = read_image(save(tmp_path / "in.fits", ramp(), LONGTEXT=long.strip(), BUNIT="DN"), limits)
    image.header["HIERARCH a long name"] = 7
    image.header.append(fits.Card.fromstring("BADCARD = 1 2 3 / not a value".ljust(80)))
    image.header.append(fits.Card.fromstring("NANCARD =                  NaN".ljust(80)))
    image.header.append(fits.Card.fromstring("TEMPCOMM= 'x' / 20 \xb0C".ljust(80)))
    image.header.add_comment("a comment")
    write_image(
        tmp_path / "out.fits", image, cards={"NOTE": ("dünn\nund lang", "é")}, history=["a\nb " + "y" * 200]
    )
    header = read_image(tmp_path / "out.fits", limits).header
    history = "".join(map(str, header["HISTORY"]))
    assert header["LONGTEXT"] == long.strip()
    assert header["a long name"] == 7
    assert header["NOTE"] == "d?nn und lang"
    assert header["TEMPCOMM"] == "x"
    assert (header["BADCARD"], header["NANCARD"]) == ("1 2 3", "NaN")
    assert "y" * 60 in history
    assert "a comment" in map(str, header["COMMENT"])


def test_statistics_in_the_header_are_those_of_the_finite_pixels(tmp_path: Path) -> None:
    pixels = ramp()
    pixels[2, 3] = np.nan
    mask = np.where(np.isfinite(pixels), 0, 1).astype(np.uint8)
    image = Image(pixels, mask, fits.Header({"DATAMAX": 9e9, "DATAP50": 4.0}), "DN", 1.0)
    write_image(tmp_path / "p.fits", image, cards={}, history=[])
    header = fits.getheader(tmp_path / "p.fits")
    assert (header["DATAMIN"], header["DATAMAX"]) == (1.0, np.nanmax(pixels))
    assert "DATAP50" not in header


def test_the_demo_opens_in_sunpy_and_says_it_is_simulated(tmp_path: Path, limits: FitsLimits) -> None:
    for name in ("a.fits", "b.fits"):
        demo_image(tmp_path / name, make_psf(gaussian(32, 1.0), plate_scale_arcsec=0.492), size=128, seed=3)
    assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()
    image = read_image(tmp_path / "a.fits", limits)
    assert "SIMULATED" in image.header["ORIGIN"]
    seen = sunpy.map.Map(tmp_path / "a.fits")
    assert seen.detector == "HRI_EUV"
    assert seen.observer_coordinate.radius.to_value("m") == pytest.approx(5.19e10)
    assert seen.scale.axis1.value == pytest.approx(0.492)


def test_blank_is_masked_in_unsigned_images_too(tmp_path: Path) -> None:
    stored = np.arange(32 * 32, dtype=np.int16).reshape(32, 32)
    stored[3, 4] = -32768
    hdu = fits.PrimaryHDU(stored)
    hdu.header["BZERO"], hdu.header["BSCALE"], hdu.header["BLANK"] = 32768, 1, -32768
    path = tmp_path / "unsigned.fits"
    with path.open("wb") as file:  # written by hand, because astropy would scale the values
        file.write(hdu.header.tostring().encode())
        data = stored.astype(">i2").tobytes()
        file.write(data + bytes(-len(data) % 2880))
    image = read_image(path, FitsLimits(max_pixels=2**20))
    assert image.mask[3, 4] == MaskBit.NONFINITE and np.isnan(image.pixels[3, 4])
    assert image.pixels[0, 5] == 32773 and np.count_nonzero(image.mask) == 1


GARBAGE = [
    b"PSFNAME = 'dr\x0c\x01|-|'",
    b"TELESCOP= 'not closed",
    b"INSTRUME= 3 2 x / y",
    b"DATE-OBS= \x00\xff",
    b"CDELT1  = 1E999",
    b"HIERARCH = 'x' = 'y'",
    b"\x07BELL   = 1",
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("card", GARBAGE)
def test_a_product_of_an_image_with_a_garbage_card_is_written(
    tmp_path: Path, limits: FitsLimits, card: bytes
) -> None:
    header = fits.Header({"FILLER": "to be replaced", "OBSERVER": "me"})
    fits.PrimaryHDU(np.arange(400.0).reshape(20, 20), header).writeto(tmp_path / "good.fits")
    content = (tmp_path / "good.fits").read_bytes()
    at = content.index(b"FILLER  ")
    (tmp_path / "bad.fits").write_bytes(content[:at] + card.ljust(80) + content[at + 80 :])
    read_summary(tmp_path / "bad.fits", limits)
    write_image(tmp_path / "product.fits", read_image(tmp_path / "bad.fits", limits), cards={})
    with fits.open(tmp_path / "product.fits") as hdus:
        hdus.verify("exception")
        assert hdus[0].header["OBSERVER"] == "me"
