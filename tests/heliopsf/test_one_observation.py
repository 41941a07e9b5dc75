"""The same content in seven forms: pixels, QUALITY and warnings do not depend on what an image came in."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sunpy.map
from astropy.io import fits
from astropy.nddata import NDData
from numpy.typing import NDArray

import heliopsf
from heliopsf import DataError, Deconvolution
from heliopsf.inputs import image_of, on_disk
from psfcore.deconvolve.assess.quality import QualityBit
from psfcore.fits.cards import number_of
from psfcore.image import Image

N = 128
HOLE = (slice(20, 24), slice(30, 34))
AIA: dict[str, Any] = {
    "TELESCOP": "SDO/AIA",
    "INSTRUME": "AIA_3",
    "WAVELNTH": 171,
    "WAVEUNIT": "angstrom",
    "EXPTIME": 2.0,
}
AIA |= {"BUNIT": "DN", "CDELT1": 0.6, "CDELT2": 0.6, "CUNIT1": "arcsec", "CUNIT2": "arcsec"}
AIA |= {
    "CTYPE1": "HPLN-TAN",
    "CTYPE2": "HPLT-TAN",
    "CRPIX1": 64.5,
    "CRPIX2": 64.5,
    "CRVAL1": 0.0,
    "CRVAL2": 0.0,
}
AIA |= {"SAT_ROT": 0.0, "INST_ROT": 0.02, "CROTA2": 0.02, "LVL_NUM": 1.0, "DATE-OBS": "2013-03-10T06:00:00"}
AIA |= {"HGLN_OBS": 0.0, "HGLT_OBS": 0.0, "DSUN_OBS": 1.5e11}
EUVI = AIA | {
    "TELESCOP": "STEREO",
    "OBSRVTRY": "STEREO_A",
    "INSTRUME": "SECCHI",
    "DETECTOR": "EUVI",
    "WAVELNTH": 195,
    "EXPTIME": 8.0,
}
Pixels = NDArray[Any]


def scene(level: float = 300.0, seed: int = 1) -> Pixels:
    """Light in whole DN, with two bright points."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((N, N))
    light = level * np.exp(0.4 * np.sin(x / 7) * np.cos(y / 9) + 0.05 * rng.normal(size=(N, N)))
    for row, column in ((30, 60), (66, 20)):
        light += 20 * level * np.exp(-((y - row) ** 2 + (x - column) ** 2) / 18)
    return np.round(light)


def saturated() -> Pixels:
    """100 pixels above 15000 DN that a flat field made unequal; the others are below 12100 DN."""
    light = np.minimum(scene(), 12000 + np.arange(N * N).reshape(N, N) % 97)
    light[30:40, 50:60] = (
        15001 + np.random.default_rng(2).integers(0, 400, (10, 10)) + np.arange(100).reshape(10, 10) / 128
    )
    return light


@dataclass(frozen=True)
class Content:
    """stored: the numbers in the file. bad: pixels [y, x] that QUALITY must mark with `bit`. codes: of the warnings
    about the image. planes: further HDUs. cut: forms that cannot hold this content."""

    stored: Pixels
    cards: dict[str, Any] = field(default_factory=dict)
    bad: Any = None
    bit: int = int(QualityBit.NONFINITE)
    codes: frozenset[str] = frozenset()
    base: dict[str, Any] = field(default_factory=lambda: AIA)
    compressed: bool = False
    planes: tuple[tuple[str, Pixels], ...] = ()
    not_in: tuple[str, ...] = ()


def holed(fill: int, dtype: type = np.int16, level: float = 300.0, shift: int = 0, scale: int = 1) -> Pixels:
    raw = np.round(scene(level) * scale - shift).astype(dtype)
    raw[HOLE] = fill
    return raw


def flags() -> Pixels:
    bad = np.zeros((N, N), np.uint8)
    bad[HOLE] = 4
    return bad


def cut_off() -> Pixels:
    light = scene() + 5
    light[70:] = 0
    return light.astype(np.float32)


def wrapped() -> Pixels:
    light = np.minimum(scene(1500), 30000.0)
    light[29:32, 59:62] = 40000 + np.arange(9).reshape(3, 3) * 500
    return ((light.astype(int) + 32768) % 65536 - 32768).astype(np.int16)


LOST, SATURATED = int(QualityBit.LOST), int(QualityBit.SATURATED)
FLARE = (slice(30, 40), slice(50, 60))
MEMORY = ("hdu", "map", "nddata", "pair")  # forms that know no other image of the file
CONTENTS: dict[str, Content] = {
    "integers": Content(scene().astype(np.int16)),
    "floats": Content(scene().astype(np.float32) / 3),
    "blank": Content(holed(-32768), {"BLANK": -32768}, HOLE, LOST, frozenset({"lost"})),
    "blank of 0": Content(holed(0), {"BLANK": 0}, HOLE, LOST, frozenset({"lost"})),
    "blank of unsigned": Content(
        holed(32767, shift=32768),
        {"BZERO": 32768, "BSCALE": 1, "BLANK": 32767},
        HOLE,
        LOST,
        frozenset({"lost"}),
    ),
    "blank of unsigned, compressed": Content(
        holed(32767, shift=32768),
        {"BZERO": 32768, "BSCALE": 1, "BLANK": 32767},
        HOLE,
        LOST,
        frozenset({"lost"}),
        compressed=True,
    ),
    "blank of scaled": Content(
        holed(-32768, level=50, scale=16),
        {"BSCALE": 1 / 16, "BZERO": 0, "BLANK": -32768},
        HOLE,
        LOST,
        frozenset({"lost"}),
    ),
    "filled": Content(holed(-999), {"NMISSING": 16}, HOLE, LOST, frozenset({"lost"})),
    "nan": Content(np.where(flags() > 0, np.nan, scene()).astype(np.float32), {}, HOLE),
    "interrupted": Content(cut_off(), {}, (slice(70, N), slice(0, N)), codes=frozenset({"zeros"})),
    "faint": Content(np.random.default_rng(4).poisson(0.4, (N, N)).astype(np.int16)),
    "wrapped": Content(wrapped(), {}, (slice(29, 32), slice(59, 62)), codes=frozenset({"wrapped"})),
    "level": Content(saturated().astype(np.float32), {"NSATPIX": 100}, FLARE, SATURATED),
    "level of a rate": Content(
        (saturated() / 2).astype(np.float32), {"NSATPIX": 100, "BUNIT": "DN/s"}, FLARE, SATURATED
    ),
    "level without exposure": Content(
        (saturated() / 2).astype(np.float32),
        {"NSATPIX": 100, "BUNIT": "DN/s", "EXPTIME": None},
        FLARE,
        SATURATED,
        frozenset({"saturation"}),
    ),
    "level after a correction": Content(
        (saturated() / 0.3).astype(np.float32), {"NSATPIX": 100}, FLARE, SATURATED, frozenset({"saturation"})
    ),
    "level in DN of a rate": Content(
        (saturated() / 8).astype(np.float32),
        {"DSATVAL": 15000.0, "DATASAT": 100, "BUNIT": "DN/s"},
        FLARE,
        SATURATED,
        base=EUVI,
    ),
    "numbers as text": Content(
        (saturated() / 2).astype(np.float32),
        {"NSATPIX": "100", "BUNIT": "DN/s", "EXPTIME": "2.0"},
        FLARE,
        SATURATED,
    ),
    "quality plane": Content(
        scene().astype(np.float32),
        {},
        HOLE,
        codes=frozenset({"quality-plane"}),
        planes=(("DQF", flags()),),
        not_in=MEMORY,
    ),
    "several images": Content(
        scene().astype(np.int16),
        codes=frozenset({"several-images"}),
        planes=(("OTHER", scene()),),
        not_in=MEMORY,
    ),
}


def write(path: Path, content: Content) -> Path:
    """The file: stored numbers and scaling cards as they are."""
    cards = fits.Header(
        {key: value for key, value in (content.base | content.cards).items() if value is not None}
    )
    scaling = {key: cards.pop(key) for key in ("BZERO", "BSCALE", "BLANK") if key in cards}
    planes = [fits.ImageHDU(plane, name=name) for name, plane in content.planes]
    if content.compressed:
        whole = (content.stored.astype(np.int32) + 32768).astype(np.uint16)
        image = fits.CompImageHDU(whole, cards, compression_type="RICE_1")
        image.header["BLANK"] = scaling["BLANK"]
        fits.HDUList([fits.PrimaryHDU(), image]).writeto(path)
        return path
    fits.HDUList([fits.PrimaryHDU(content.stored, cards), *planes]).writeto(path)
    with fits.open(path, mode="update", do_not_scale_image_data=True) as hdus:
        hdus[0].header.update(scaling)
    return path


def opened(path: Path) -> tuple[Pixels, fits.Header]:
    """Pixels and header as a script reads them: the header first, which astropy would otherwise change."""
    with fits.open(path) as hdus:
        (hdu,) = [one for one in hdus if one.header["NAXIS"] == 2][:1]
        header = hdu.header.copy()
        return np.array(hdu.data), header


def in_a_map(path: Path) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = sunpy.map.Map(path)
    return made[0] if isinstance(made, list) else made


def first_hdu(path: Path) -> Any:
    return next(one for one in fits.open(path) if one.header["NAXIS"] == 2)


FORMS: dict[str, Callable[[Path], Any]] = {
    "path": lambda path: path,
    "bytes": lambda path: path.read_bytes(),
    "hdu": first_hdu,
    "hdulist": fits.open,
    "map": in_a_map,
    "nddata": lambda path: NDData(opened(path)[0], meta=dict(opened(path)[1])),
    "pair": opened,
}


def observed(image: Any) -> Image:
    """The observation of which every deconvolution begins."""
    with on_disk(image) as there:
        return image_of(there, saturation=None)


def all_warnings(image: Image) -> dict[str, str]:
    assert image.saturation is not None
    of_level = image.saturation.warning
    return dict(image.warnings) | ({} if of_level is None else {"saturation": of_level})


def write_psf(path: Path) -> Path:
    at = np.arange(33) - 16
    r2 = at[:, None] ** 2 + at[None] ** 2
    core, halo = np.exp(-r2 / 1.5), (1 + r2 / 25) ** -1.5
    cards = fits.Header({"CDELT1": 0.6, "CDELT2": 0.6, "CUNIT1": "arcsec", "CUNIT2": "arcsec"})
    fits.PrimaryHDU(0.9 * core / core.sum() + 0.1 * halo / halo.sum(), cards).writeto(path)
    return path


@pytest.fixture(scope="module")
def psf_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_psf(tmp_path_factory.mktemp("psf") / "psf.fits")


def deconvolved(image: Any, psf_file: Path) -> Deconvolution:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = heliopsf.deconvolve(image, psf_file, steps=2, other_channel=True, full=True)
    assert isinstance(result, Deconvolution)
    return result


@pytest.mark.parametrize("name", CONTENTS)
def test_every_form_gives_the_same_observation(name: str, tmp_path: Path) -> None:
    content = CONTENTS[name]
    path = write(tmp_path / "image.fits", content)
    wanted = observed(path)
    marked = (wanted.mask & content.bit) != 0
    expected = np.zeros((N, N), bool)
    if content.bad is not None:
        expected[content.bad] = True
    np.testing.assert_array_equal(marked, expected)
    assert all_warnings(wanted).keys() == content.codes
    for form, made in FORMS.items():
        if form in content.not_in:
            continue
        found = observed(made(path))
        np.testing.assert_array_equal(found.mask, wanted.mask, err_msg=form)
        np.testing.assert_allclose(found.pixels, wanted.pixels, rtol=1e-6, err_msg=form)
        assert all_warnings(found) == all_warnings(wanted), form


def test_damaged_pixels_are_told_where_the_bytes_are_known(tmp_path: Path) -> None:
    """Of a plain and of a compressed image; a file whose sum is right has no warning."""
    light = scene().astype(np.int16)
    for name, hdus in (
        ("plain", [fits.PrimaryHDU(light, fits.Header(AIA))]),
        ("odd", [fits.PrimaryHDU(light[:127, :127].astype(np.uint8), fits.Header(AIA))]),
        ("rice", [fits.PrimaryHDU(), fits.CompImageHDU(light, fits.Header(AIA), compression_type="RICE_1")]),
    ):
        path = tmp_path / f"{name}.fits"
        fits.HDUList(hdus).writeto(path, checksum=True)
        assert "damaged" not in observed(path).warnings, name
        with fits.open(path, disable_image_compression=True) as stored:
            start, at = (
                stored[-1].fileinfo()["datLoc"],
                stored[-1].header["NAXIS1"] * (40 if name != "rice" else N) + 300,
            )
        raw = bytearray(path.read_bytes())
        raw[start + at] ^= 4
        path.write_bytes(bytes(raw))
        for form in ("path", "bytes", *(["hdu", "hdulist"] if name != "rice" else [])):
            assert "damaged" in observed(FORMS[form](path)).warnings, (name, form)


def test_numbers_of_metadata_may_be_of_any_type(psf_file: Path) -> None:
    numbers = (np.int64, np.float32, str, np.array, lambda value: np.float64(value))
    for kind in numbers:
        image = NDData(
            saturated() / 2, meta=AIA | {"BUNIT": "DN/s", "NSATPIX": kind(100), "EXPTIME": kind(2)}
        )
        assert np.count_nonzero(observed(image).mask & SATURATED) == 100, kind
    with pytest.raises(DataError, match="channel"):
        heliopsf.deconvolve(
            NDData(scene(), meta=AIA | {"WAVELNTH": np.float32(171)}), aia_193(psf_file), steps=1
        )


def test_what_is_no_number_and_masks_that_broadcast() -> None:
    for nothing in (Decimal("NaN"), np.ma.masked, np.inf, True, 1 + 2j, "1_000", 10**400):
        assert number_of(nothing) is None, nothing
    assert number_of(np.longdouble(2)) == number_of(Decimal(2)) == number_of("2D0") == 2.0
    column = np.zeros(N, bool)
    column[3] = True
    assert np.argwhere(observed(NDData(scene(), mask=column, meta=AIA)).mask)[:, 1].tolist() == [3] * N
    with pytest.raises(DataError, match="mask-shape"):
        observed(NDData(scene(), mask=np.zeros((10, N), bool), meta=AIA))


def test_a_region_of_another_hdu_is_that_of_this_hdu(psf_file: Path) -> None:
    hdus = fits.HDUList([fits.PrimaryHDU(scene()[:32, :32]), fits.ImageHDU(scene(), fits.Header(AIA))])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cut = heliopsf.deconvolve(
            hdus, psf_file, hdu=1, region=np.s_[0:40, 0:40], steps=1, other_channel=True, full=True
        )
    assert cut.pixels.shape == (40, 40)


def aia_193(psf_file: Path) -> Path:
    path = psf_file.with_name("aia_193.fits")
    cards = fits.Header(fits.getheader(psf_file), copy=True)
    cards.update({"TELESCOP": "SDO/AIA", "WAVELNTH": 193})
    fits.PrimaryHDU(fits.getdata(psf_file), cards).writeto(path, overwrite=True)
    return path


def test_a_region_moves_reference_pixels_of_any_type(psf_file: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for kind in (np.float32, np.int64, str):
            pair = scene(), AIA | {"CRPIX1": kind(48)}
            pixels, meta = heliopsf.deconvolve(
                pair, psf_file, region="20:80,10:70", steps=1, other_channel=True
            )
            assert pixels.shape == (60, 60) and float(meta["CRPIX1"]) == 28, kind


def test_a_list_of_another_class_and_a_result_that_travels(psf_file: Path, tmp_path: Path) -> None:
    from collections import UserList

    path = write(tmp_path / "image.fits", CONTENTS["integers"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first, second = heliopsf.deconvolve(
            UserList([path, path.read_bytes()]), psf_file, steps=1, other_channel=True
        )
    again = pickle.loads(pickle.dumps(first))
    np.testing.assert_array_equal(again.pixels, second.pixels)


def test_no_warning_of_astropy_about_long_keywords(psf_file: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", fits.verify.VerifyWarning)
        heliopsf.deconvolve((scene(), AIA | {"LONG_KEYWORD": 3}), psf_file, steps=1, other_channel=True)
