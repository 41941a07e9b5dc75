"""Images, products and masks of mounts: what is read, what is masked, and what is written."""

from __future__ import annotations

import gzip
import warnings
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import sunpy.map
from astropy.io import fits
from astropy.wcs import WCS
from numpy.typing import NDArray

from psfcore.deconvolve.assess.quality import MEANINGS, QualityBit
from psfcore.errors import DataError
from psfcore.fits.header import read_summary
from psfcore.fits.images import described, read_mask_image, read_planes, write_image
from psfcore.fits.observation import read_observation
from psfcore.image import Image, MaskBit, Saturation
from psfcore.simulate.scene import demo_image
from tests.psfcore.conftest import LIMITS, gaussian, make_psf
from tests.psfcore.fits.raw_files import block, image_cards

Find = Callable[[str], Path]
CARDS: dict[str, tuple[str | int | float | bool, str]] = {"PSFNAME": ("hri_euv", "point-spread function")}
AIA = "aia/aia_171_cutout_20130310.fits"

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


def test_any_storage_becomes_native_float64(tmp_path: Path) -> None:
    """Values that are not finite are masked; negative ones are data."""
    for dtype in (">u1", ">i2", ">i4", ">f4", ">f8", ">u2"):
        data = (ramp() % 200).astype(dtype)
        path = save(tmp_path / f"{dtype[1:]}.fits", data, BUNIT="DN", EXPTIME=2.0)
        image = read_observation(path, LIMITS)
        assert image.pixels.dtype == np.dtype("=f8")
        np.testing.assert_array_equal(image.pixels, ramp() % 200)
        assert (image.unit, image.exposure_s) == ("DN", 2.0) and image.valid.all()
    path.write_bytes(gzip.compress(path.read_bytes()))
    np.testing.assert_array_equal(read_observation(path, LIMITS).pixels, ramp() % 200)
    data = ramp()
    data[0, 0], data[1, 1], data[2, 2] = np.nan, -5.0, np.inf
    image = read_observation(save(tmp_path / "n.fits", data), LIMITS)
    assert np.argwhere(~image.valid).tolist() == [[0, 0], [2, 2]]
    assert image.pixels[1, 1] == -5.0


def test_blank_is_masked_in_plain_unsigned_and_compressed_integers(tmp_path: Path) -> None:
    data = ramp().astype(np.int16)
    data[3, 4] = -32768
    save(tmp_path / "plain.fits", data, BLANK=-32768)
    for codec in ("RICE_1", "GZIP_1", "GZIP_2"):
        hdu = fits.CompImageHDU(data, fits.Header({"BLANK": -32768}), compression_type=codec)
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / f"{codec}.fits")
    for name in ("plain", "RICE_1", "GZIP_1", "GZIP_2"):
        image = read_observation(tmp_path / f"{name}.fits", LIMITS)
        assert np.argwhere(~image.valid).tolist() == [[3, 4]], name
        assert image.mask[3, 4] == MaskBit.NONFINITE | MaskBit.LOST and "1 pixels" in image.warnings["lost"]
        np.testing.assert_array_equal(image.pixels[image.valid], ramp()[image.valid])
    cards = image_cards(24, 20, 16, "BZERO   = 32768", "BSCALE  = 1", "BLANK   = -32768")
    (tmp_path / "unsigned.fits").write_bytes(block(*cards, data=data.astype(">i2").tobytes()))
    image = read_observation(tmp_path / "unsigned.fits", LIMITS)
    assert np.argwhere(image.mask).tolist() == [[3, 4]] and image.pixels[0, 4] == 32773


UNUSABLE = [
    (np.full((20, 20), np.nan), {}, None, "all-nan"),
    (np.full((20, 20), -9, np.int16), {"BLANK": -9}, None, "all-nan"),
    (np.full((20, 20), 500.0), {"SATURATE": 400.0}, None, "all-saturated"),
    (np.full((20, 20), 16383, np.int16), {}, None, "all-saturated"),
    (np.full((20, 20), 65535, np.uint16), {}, None, "all-saturated"),
    (np.zeros((20, 20)), {}, None, "no-signal"),
    (np.full((20, 20), -3.0), {}, None, "no-signal"),
    (ramp() * 1e-300, {}, None, "no-signal"),
    (np.where(ramp() > 100, 500.0, 0.0), {"SATURATE": 400.0}, None, "no-signal: .* 380 brighter pixels"),
    (np.where(ramp() == 5.0, 1e300, ramp()), {}, None, "pixel-too-large"),
    (ramp() * 1e14, {}, None, "pixel-too-large"),
    (np.where(ramp() == 5.0, -1e300, ramp()), {}, None, "pixel-too-large"),
    (ramp(), {"BUNIT": "DN/s"}, 100.0, "no-exposure"),
    (np.ones((10, 40)), {}, None, "too-small"),
]


def test_unusable_pixels_are_data_errors(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for number, (data, cards, saturation_dn, code) in enumerate(UNUSABLE):
        path = save(tmp_path / f"{number}.fits", data, **cards)
        with subtests.test(code), pytest.raises(DataError, match=f"^(?=.*: expected){code}"):
            read_observation(path, LIMITS, saturation_dn=saturation_dn)


# --- products ---


def test_cards_with_nan_are_kept_as_text_without_a_word_of_astropy(tmp_path: Path) -> None:
    lines = (
        "OSCNMEAN=                  nan",
        "INFVALUE= -inf",
        "HIERARCH a key = nan",
        "QUOTE   = 'it's wrong'",
    )
    header = fits.Header.fromstring("".join(line.ljust(80) for line in lines))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = described(header, filename="f", creator="c", sha256="0").header
        write_image(
            tmp_path / "product.fits",
            Image(ramp(), np.zeros(ramp().shape, np.uint8), kept, None, None),
            cards={},
        )


STORAGE = {
    *("BITPIX", "BSCALE", "BZERO", "BLANK", "EXTEND", "CHECKSUM", "DATASUM", "EXTNAME", "SIMPLE", "XTENSION"),
    *("PCOUNT", "GCOUNT", "NAXIS", "HISTORY", "COMMENT", "", "EXTVER", "INHERIT", "DATAMIN", "DATAMAX"),
    *("DATAMEAN", "DATAMEDN", "DATARMS", "DATASTD", "DATASKEW", "DATAKURT", "DATACENT"),
}


def test_a_product_without_planes_keeps_header_and_wcs_and_opens_as_one_map(
    tmp_path: Path, real: Find
) -> None:
    source = real(AIA)
    image = read_observation(source, LIMITS)
    product = tmp_path / "product.fits"
    write_image(product, image, cards=CARDS, history=["Richardson-Lucy, 20 steps"])
    again = read_observation(product, LIMITS)
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


def test_odd_cards_survive(tmp_path: Path) -> None:
    long = "word " * 40
    image = read_observation(save(tmp_path / "in.fits", ramp(), LONGTEXT=long.strip(), BUNIT="DN"), LIMITS)
    image.header["HIERARCH a long name"] = 7
    image.header.append(fits.Card.fromstring("BADCARD = 1 2 3 / not a value".ljust(80)))
    image.header.append(fits.Card.fromstring("NANCARD =                  NaN".ljust(80)))
    image.header.append(fits.Card.fromstring("TEMPCOMM= 'x' / 20 \xb0C".ljust(80)))
    image.header.add_comment("a comment")
    write_image(
        tmp_path / "out.fits", image, cards={"NOTE": ("dünn\nund lang", "é")}, history=["a\nb " + "y" * 200]
    )
    header = read_observation(tmp_path / "out.fits", LIMITS).header
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
    assert read_planes(tmp_path / "p.fits") == {}
    header = fits.getheader(tmp_path / "p.fits")
    assert (header["DATAMIN"], header["DATAMAX"]) == (1.0, np.nanmax(pixels))
    assert "DATAP50" not in header


def test_the_demo_opens_in_sunpy_and_says_it_is_simulated(tmp_path: Path) -> None:
    for name in ("a.fits", "b.fits"):
        demo_image(tmp_path / name, make_psf(gaussian(32, 1.0), plate_scale_arcsec=0.492), size=128, seed=3)
    assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()
    image = read_observation(tmp_path / "a.fits", LIMITS)
    assert image.saturation == Saturation(None, None, None)
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
def test_a_product_of_an_image_with_a_garbage_card_is_written(tmp_path: Path) -> None:
    header = fits.Header({"FILLER": "to be replaced", "OBSERVER": "me"})
    fits.PrimaryHDU(np.arange(400.0).reshape(20, 20), header).writeto(tmp_path / "good.fits")
    content = (tmp_path / "good.fits").read_bytes()
    at = content.index(b"FILLER  ")
    for card in GARBAGE:
        (tmp_path / "bad.fits").write_bytes(content[:at] + card.ljust(80) + content[at + 80 :])
        read_summary(tmp_path / "bad.fits", LIMITS)
        write_image(tmp_path / "product.fits", read_observation(tmp_path / "bad.fits", LIMITS), cards={})
        with fits.open(tmp_path / "product.fits") as hdus:
            hdus.verify("exception")
            assert hdus[0].header["OBSERVER"] == "me", card


# --- the planes of products, and the cards that say what a product was made from ---

Planes = dict[str, NDArray[np.generic]]


def example_planes(shape: tuple[int, ...]) -> Planes:
    rng = np.random.default_rng(1)
    error = rng.random(shape)
    error[3, 4] = np.nan
    return {
        "QUALITY": rng.integers(0, 128, shape).astype(np.uint8),
        "ERROR": error,
        "PSF_ERROR": rng.random(shape).astype(np.float32),
        "WIDE": rng.integers(0, 2**16, shape).astype(np.uint16),
    }


def write_example(path: Path, source: Path) -> Planes:
    image = read_observation(source, LIMITS)
    planes = example_planes(image.pixels.shape)
    write_image(path, image, cards=CARDS, planes=planes, plane_bits={"QUALITY": MEANINGS})
    return planes


def test_planes_are_plain_images_and_read_back(tmp_path: Path) -> None:
    source = save(tmp_path / "in.fits", ramp(), BUNIT="DN", CRPIX1=3.0, CDELT1=0.5, CTYPE1="HPLN-TAN")
    for name in ("one.fits", "two.fits"):
        planes = write_example(tmp_path / name, source)
    product = tmp_path / "one.fits"
    assert product.read_bytes() == (tmp_path / "two.fits").read_bytes()
    with fits.open(product, checksum=True) as hdus:
        assert [hdu.name for hdu in hdus] == ["PRIMARY", *planes]
        assert all(type(hdu) is fits.ImageHDU for hdu in hdus[1:])
        assert all((hdu.verify_checksum(), hdu.verify_datasum()) == (1, 1) for hdu in hdus)
        assert hdus["QUALITY"].data.shape == ramp().shape and hdus["QUALITY"].header["BITPIX"] == 8
        assert hdus["ERROR"].header["BUNIT"] == "DN" and "BUNIT" not in hdus["QUALITY"].header
        np.testing.assert_array_equal(hdus["WIDE"].data, planes["WIDE"])
    back = read_planes(product)
    assert list(back) == list(planes)
    for name, plane in planes.items():
        stored = np.dtype(np.float32) if plane.dtype.kind == "f" else plane.dtype
        assert back[name].dtype == stored
        np.testing.assert_array_equal(back[name], plane.astype(stored))
    np.testing.assert_array_equal(read_observation(product, LIMITS).pixels, ramp())
    header = fits.getheader(product, "QUALITY")
    for bit in QualityBit:
        card = f"QBIT{int(bit).bit_length() - 1}"
        assert header[card] == bit.name
        assert header.comments[card] == f"value {int(bit)}: {MEANINGS[bit]}", "it fits into the card"


def test_sunpy_shows_the_image_first_and_every_plane_at_the_same_place(tmp_path: Path, real: Find) -> None:
    product = tmp_path / "p.fits"
    planes = write_example(product, real(AIA))
    maps = sunpy.map.Map(product)
    before = sunpy.map.Map(real(AIA))
    assert len(maps) == 1 + len(planes)
    np.testing.assert_array_equal(maps[0].data, read_observation(product, LIMITS).pixels)
    for shown in maps:
        assert isinstance(shown, type(before))
        assert shown.wcs.wcs.compare(before.wcs.wcs, tolerance=1e-12)
    with fits.open(product) as hdus:
        corner = [WCS(hdu.header).wcs_pix2world([[0, 0]], 0) for hdu in hdus]
    assert all(np.array_equal(place, corner[0]) for place in corner)


def test_a_wrong_plane_is_refused(tmp_path: Path) -> None:
    image = read_observation(save(tmp_path / "in.fits", ramp()), LIMITS)
    for name, plane in (
        ("ERROR", np.zeros((3, 3))),
        ("PRIMARY", np.zeros((20, 24))),
        ("lower", np.zeros((20, 24))),
        ("ERROR", np.zeros((20, 24), np.int32)),
        ("QUALITY", np.zeros((20, 24), np.uint32)),
    ):
        with pytest.raises(DataError, match=r"^bad-plane"):
            write_image(tmp_path / "out.fits", image, cards=CARDS, planes={name: plane})
        assert not (tmp_path / "out.fits").exists(), name


SHA = "a" * 64


def made(**cards: object) -> tuple[fits.Header, dict[str, object], list[str]]:
    own = described(
        fits.Header(list(cards.items())), filename="own.fits", creator="heliopsf 1.2.3", sha256=SHA
    )
    return own.header, {key: value for key, (value, _) in own.cards.items()}, own.history


def test_a_product_describes_itself_and_points_to_its_input() -> None:
    source = {"DATE": "2022-04-19T17:47:09", "PARENT": "solo_L1.fits", "LEVEL": "L2", "VERSION": 1}
    source |= {"FILENAME": "solo_L2.fits", "ORIGIN": "Royal Observatory of Belgium"}
    header, cards, history = made(
        **source, CREATOR="euiprep.py", JOBID="7", LVL_NUM=1.5, TELESCOP="SOLO/EUI/FSI"
    )
    own = {"FILENAME": "own.fits", "PARENT": "solo_L2.fits", "CREATOR": "heliopsf 1.2.3"}
    assert cards == own | {"LEVEL": "L3", "DCNVPASS": 1}
    assert not {"DATE", "ORIGIN", "VERSION", "JOBID"} & set(header)
    assert header["TELESCOP"] == "SOLO/EUI/FSI" and header["LVL_NUM"] == 1.5
    assert SHA in history
    assert {f"input {key}: {value}" for key, value in source.items()} <= set(history)
    header, cards, history = made(PARENT="earlier.fits", TELESCOP="X")  # the rest is not invented
    assert set(cards) == {"FILENAME", "CREATOR", "DCNVPASS"} and "PARENT" not in header
    assert history == ["SHA-256 of the input file:", SHA, "input PARENT: earlier.fits"]
    assert made(PSFID="x")[1]["DCNVPASS"] == 2, "a product whose count was lost"
    assert made(PSFID="x", DCNVPASS=2)[1]["DCNVPASS"] == 3
    assert made(DCNVPASS=2)[1]["DCNVPASS"] == 1, "the card alone makes no product"
    assert made(PSFSUM=1.0)[1]["DCNVPASS"] == 1


# --- masks of mounts ---


def test_png_and_fits_of_one_mask_agree_and_other_files_are_refused(tmp_path: Path) -> None:
    """The top row of a PNG is the row with the highest y."""
    mask = np.zeros((8, 8))
    mask[6, 1] = 1  # upper left
    fits.PrimaryHDU(mask).writeto(tmp_path / "mask.fits")
    matplotlib.image.imsave(tmp_path / "mask.png", mask[::-1], cmap="gray")
    np.testing.assert_allclose(read_mask_image(tmp_path / "mask.png"), mask, atol=1e-6)
    np.testing.assert_allclose(read_mask_image(tmp_path / "mask.fits"), mask)
    for content in (b"", b"no picture", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"):
        (tmp_path / "broken.png").write_bytes(content)
        with pytest.raises(DataError, match=r"^bad-mount: mount\.mask_image\.file: expected a PNG"):
            read_mask_image(tmp_path / "broken.png")
    for name in ("missing.png", "missing.fits"):
        with pytest.raises(DataError, match=r"mount\.mask_image\.file: expected"):
            read_mask_image(tmp_path / name)
