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
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits, read_summary
from psfcore.fits.images import write_image
from psfcore.fits.observation import read_observation
from psfcore.image import Image, MaskBit
from psfcore.simulate.observe import demo_image
from tests.psfcore.conftest import gaussian, make_psf
from tests.psfcore.fits.raw_files import block, image_cards

Find = Callable[[str], Path]
CARDS: dict[str, tuple[str | int | float | bool, str]] = {"PSFNAME": ("hri_euv", "point-spread function")}
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


def test_any_storage_becomes_native_float64(tmp_path: Path, limits: FitsLimits) -> None:
    for dtype in (">u1", ">i2", ">i4", ">f4", ">f8", ">u2"):
        data = (ramp() % 200).astype(dtype)
        path = save(tmp_path / f"{dtype[1:]}.fits", data, BUNIT="DN", EXPTIME=2.0)
        image = read_observation(path, limits)
        assert image.pixels.dtype == np.dtype("=f8")
        np.testing.assert_array_equal(image.pixels, ramp() % 200)
        assert (image.unit, image.exposure_s) == ("DN", 2.0) and image.valid.all()
    path.write_bytes(gzip.compress(path.read_bytes()))
    np.testing.assert_array_equal(read_observation(path, limits).pixels, ramp() % 200)


def test_blank_is_masked_in_plain_and_compressed_integers(tmp_path: Path, limits: FitsLimits) -> None:
    data = ramp().astype(np.int16)
    data[3, 4] = -32768
    save(tmp_path / "plain.fits", data, BLANK=-32768)
    for codec in ("RICE_1", "GZIP_1", "GZIP_2"):
        hdu = fits.CompImageHDU(data, fits.Header({"BLANK": -32768}), compression_type=codec)
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / f"{codec}.fits")
    for name in ("plain", "RICE_1", "GZIP_1", "GZIP_2"):
        image = read_observation(tmp_path / f"{name}.fits", limits)
        assert np.argwhere(~image.valid).tolist() == [[3, 4]], name
        assert image.mask[3, 4] == MaskBit.NONFINITE
        np.testing.assert_array_equal(image.pixels[image.valid], ramp()[image.valid])


def test_blank_is_masked_in_unsigned_images_too(tmp_path: Path, limits: FitsLimits) -> None:
    stored = np.arange(32 * 32, dtype=">i2").reshape(32, 32)
    stored[3, 4] = -32768
    cards = image_cards(32, 32, 16, "BZERO   = 32768", "BSCALE  = 1", "BLANK   = -32768")
    (tmp_path / "unsigned.fits").write_bytes(block(*cards, data=stored.tobytes()))
    image = read_observation(tmp_path / "unsigned.fits", limits)
    assert image.mask[3, 4] == MaskBit.NONFINITE and np.isnan(image.pixels[3, 4])
    assert image.pixels[0, 5] == 32773 and np.count_nonzero(image.mask) == 1


def test_nan_is_masked_and_negative_is_data(tmp_path: Path, limits: FitsLimits) -> None:
    data = ramp()
    data[0, 0], data[1, 1], data[2, 2] = np.nan, -5.0, np.inf
    image = read_observation(save(tmp_path / "n.fits", data), limits)
    assert np.argwhere(~image.valid).tolist() == [[0, 0], [2, 2]]
    assert image.pixels[1, 1] == -5.0


def test_saturation(tmp_path: Path, limits: FitsLimits) -> None:
    """The cards' level is in the unit of the image, that of the request in DN; the lowest one counts."""
    for number, (cards, saturation_dn, level) in enumerate(
        (
            ({"SATURATE": 400.0, "BUNIT": "DN"}, None, 400.0),
            ({"DSATVAL": 300.0, "BUNIT": "DN/s", "XPOSURE": 2.0}, None, 300.0),
            ({"BUNIT": "DN"}, 350.0, 350.0),
            ({"BUNIT": "DN/s", "XPOSURE": 2.0}, 500.0, 250.0),
            ({"BUNIT": "DN / s", "EXPTIME": 2.0, "SATURATE": 400}, 500.0, 250.0),
            ({"BUNIT": "DN"}, None, None),
        )
    ):
        path = save(tmp_path / f"{number}.fits", ramp(), **cards)
        image = read_observation(path, limits, saturation_dn=saturation_dn)
        expected = ramp() >= (np.inf if level is None else level)
        np.testing.assert_array_equal(image.mask == MaskBit.SATURATED, expected)


UNUSABLE = [
    (np.full((20, 20), np.nan), {}, None, "all-nan"),
    (np.full((20, 20), -9, np.int16), {"BLANK": -9}, None, "all-nan"),
    (np.full((20, 20), 500.0), {"SATURATE": 400.0}, None, "all-saturated"),
    (np.full((20, 20), 16383, np.int16), {}, None, "all-saturated"),
    (np.full((20, 20), 65535, np.uint16), {}, None, "all-saturated"),
    (np.zeros((20, 20)), {}, None, "no-signal"),
    (np.full((20, 20), -3.0), {}, None, "no-signal"),
    (ramp(), {"BUNIT": "DN/s"}, 100.0, "no-exposure"),
    (np.ones((10, 40)), {}, None, "too-small"),
]


def test_unusable_pixels_are_data_errors(
    tmp_path: Path, limits: FitsLimits, subtests: pytest.Subtests
) -> None:
    for number, (data, cards, saturation_dn, code) in enumerate(UNUSABLE):
        path = save(tmp_path / f"{number}.fits", data, **cards)
        with subtests.test(code), pytest.raises(DataError, match=f"^{code}: .*expected"):
            read_observation(path, limits, saturation_dn=saturation_dn)


def test_damaged_tiles_are_data_errors(tmp_path: Path, limits: FitsLimits) -> None:
    path = tmp_path / "d.fits"
    hdu = fits.CompImageHDU(ramp(64, 64).astype(np.int32), compression_type="GZIP_1")
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    path.write_bytes(path.read_bytes()[:-2880] + b"\xff" * 2880)
    with pytest.raises(DataError, match=r"^unreadable-pixels"):
        read_observation(path, limits)


# --- products ---


STORAGE = {
    *("BITPIX", "BSCALE", "BZERO", "BLANK", "EXTEND", "CHECKSUM", "DATASUM", "EXTNAME", "SIMPLE", "XTENSION"),
    *("PCOUNT", "GCOUNT", "NAXIS", "HISTORY", "COMMENT", "", "EXTVER", "INHERIT", "DATAMIN", "DATAMAX"),
    *("DATAMEAN", "DATAMEDN", "DATARMS", "DATASTD", "DATASKEW", "DATAKURT", "DATACENT"),
}


@pytest.mark.parametrize("name", [AIA, GZ])
def test_a_product_without_planes_keeps_header_and_wcs_and_opens_as_one_map(
    tmp_path: Path, limits: FitsLimits, real: Find, name: str
) -> None:
    source = real(name)
    image = read_observation(source, limits)
    product = tmp_path / "product.fits"
    write_image(product, image, cards=CARDS, history=["Richardson-Lucy, 20 steps"])
    again = read_observation(product, limits)
    np.testing.assert_array_equal(again.pixels, image.pixels.astype(np.float32))
    before, after = sunpy.map.Map(source), sunpy.map.Map(product)
    assert isinstance(after, type(before))
    assert after.wcs.wcs.compare(before.wcs.wcs, tolerance=1e-12)
    with fits.open(source) as hdus:
        hdus.verify("silentfix")
        original = hdus[1 if hdus[0].header["NAXIS"] == 0 else 0].header
        for key in original:
            if key not in STORAGE and not key.startswith(("DATAP", "ZNAXIS", "ZHECK", "ZDATA")):
                assert str(again.header[key]) == str(original[key]), key
        kept = "\n".join(map(str, again.header["HISTORY"]))
        assert all(str(line) in kept for line in original.get("HISTORY", []))
        assert len(again.header.get("COMMENT", [])) == len(original.get("COMMENT", []))
    assert again.header["PSFNAME"] == "hri_euv"
    assert "Richardson-Lucy, 20 steps" in kept


def test_equal_products_are_equal_bytes_with_true_checksums(tmp_path: Path, limits: FitsLimits) -> None:
    image = read_observation(save(tmp_path / "in.fits", ramp(), BUNIT="DN"), limits)
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
    image = read_observation(save(tmp_path / "in.fits", ramp(), LONGTEXT=long.strip(), BUNIT="DN"), limits)
    image.header["HIERARCH a long name"] = 7
    image.header.append(fits.Card.fromstring("BADCARD = 1 2 3 / not a value".ljust(80)))
    image.header.append(fits.Card.fromstring("NANCARD =                  NaN".ljust(80)))
    image.header.append(fits.Card.fromstring("TEMPCOMM= 'x' / 20 \xb0C".ljust(80)))
    image.header.add_comment("a comment")
    write_image(
        tmp_path / "out.fits", image, cards={"NOTE": ("dünn\nund lang", "é")}, history=["a\nb " + "y" * 200]
    )
    header = read_observation(tmp_path / "out.fits", limits).header
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
    image = read_observation(tmp_path / "a.fits", limits)
    assert "SIMULATED" in image.header["ORIGIN"]
    seen = sunpy.map.Map(tmp_path / "a.fits")
    assert seen.detector == "HRI_EUV"
    assert seen.observer_coordinate.radius.to_value("m") == pytest.approx(5.19e10)
    assert seen.scale.axis1.value == pytest.approx(0.492)


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
def test_a_product_of_an_image_with_a_garbage_card_is_written(tmp_path: Path, limits: FitsLimits) -> None:
    header = fits.Header({"FILLER": "to be replaced", "OBSERVER": "me"})
    fits.PrimaryHDU(np.arange(400.0).reshape(20, 20), header).writeto(tmp_path / "good.fits")
    content = (tmp_path / "good.fits").read_bytes()
    at = content.index(b"FILLER  ")
    for card in GARBAGE:
        (tmp_path / "bad.fits").write_bytes(content[:at] + card.ljust(80) + content[at + 80 :])
        read_summary(tmp_path / "bad.fits", limits)
        write_image(tmp_path / "product.fits", read_observation(tmp_path / "bad.fits", limits), cards={})
        with fits.open(tmp_path / "product.fits") as hdus:
            hdus.verify("exception")
            assert hdus[0].header["OBSERVER"] == "me", card
