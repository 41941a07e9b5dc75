"""Products: planes that any viewer shows, with the coordinates of the image, and cards that say what it was made from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sunpy.map
from astropy.io import fits
from astropy.wcs import WCS
from numpy.typing import NDArray

from psfcore.deconvolve.assess.quality import MEANINGS, QualityBit
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.images import described, read_planes, write_image
from psfcore.fits.observation import read_observation
from tests.psfcore.fits.test_images import AIA, CARDS, ramp, save

Find = Callable[[str], Path]
Planes = dict[str, NDArray[np.generic]]

pytestmark = [
    pytest.mark.filterwarnings("ignore::astropy.utils.exceptions.AstropyUserWarning"),
    pytest.mark.filterwarnings("ignore::sunpy.util.exceptions.SunpyUserWarning"),
]


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


def write_example(path: Path, source: Path, limits: FitsLimits) -> Planes:
    image = read_observation(source, limits)
    planes = example_planes(image.pixels.shape)
    write_image(path, image, cards=CARDS, planes=planes, plane_bits={"QUALITY": MEANINGS})
    return planes


def test_planes_are_plain_images_and_read_back(tmp_path: Path, limits: FitsLimits) -> None:
    source = save(tmp_path / "in.fits", ramp(), BUNIT="DN", CRPIX1=3.0, CDELT1=0.5, CTYPE1="HPLN-TAN")
    for name in ("one.fits", "two.fits"):
        planes = write_example(tmp_path / name, source, limits)
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
    np.testing.assert_array_equal(read_observation(product, limits).pixels, ramp())


def test_the_header_of_a_plane_of_bits_says_what_they_mean(tmp_path: Path, limits: FitsLimits) -> None:
    write_example(tmp_path / "p.fits", save(tmp_path / "in.fits", ramp()), limits)
    header = fits.getheader(tmp_path / "p.fits", "QUALITY")
    for bit in QualityBit:
        card = f"QBIT{int(bit).bit_length() - 1}"
        assert header[card] == bit.name
        assert header.comments[card] == f"value {int(bit)}: {MEANINGS[bit]}", (
            "the whole meaning fits into the card"
        )
    assert "0 marks a good pixel" in str(header["COMMENT"])


def test_sunpy_shows_the_image_first_and_every_plane_at_the_same_place(
    tmp_path: Path, limits: FitsLimits, real: Find
) -> None:
    product = tmp_path / "p.fits"
    planes = write_example(product, real(AIA), limits)
    maps = sunpy.map.Map(product)
    before = sunpy.map.Map(real(AIA))
    assert len(maps) == 1 + len(planes)
    np.testing.assert_array_equal(maps[0].data, read_observation(product, limits).pixels)
    for shown in maps:
        assert isinstance(shown, type(before))
        assert shown.wcs.wcs.compare(before.wcs.wcs, tolerance=1e-12)
    with fits.open(product) as hdus:
        corner = [WCS(hdu.header).wcs_pix2world([[0, 0]], 0) for hdu in hdus]
    assert all(np.array_equal(place, corner[0]) for place in corner)


def test_a_product_without_planes_has_none(tmp_path: Path, limits: FitsLimits) -> None:
    image = read_observation(save(tmp_path / "in.fits", ramp()), limits)
    write_image(tmp_path / "out.fits", image, cards=CARDS)
    assert read_planes(tmp_path / "out.fits") == {}


def test_a_wrong_plane_is_refused(tmp_path: Path, limits: FitsLimits) -> None:
    image = read_observation(save(tmp_path / "in.fits", ramp()), limits)
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


def test_what_the_input_does_not_say_is_not_invented() -> None:
    header, cards, history = made(PARENT="earlier.fits", TELESCOP="X")
    assert set(cards) == {"FILENAME", "CREATOR", "DCNVPASS"} and "PARENT" not in header
    assert history == ["SHA-256 of the input file:", SHA, "input PARENT: earlier.fits"]


def test_passes_are_counted() -> None:
    assert made(PSFID="x")[1]["DCNVPASS"] == 2, "a product whose count was lost"
    assert made(PSFID="x", DCNVPASS=2)[1]["DCNVPASS"] == 3
    assert made(DCNVPASS=2)[1]["DCNVPASS"] == 1, "the card alone makes no product"
    assert made(PSFSUM=1.0)[1]["DCNVPASS"] == 1
