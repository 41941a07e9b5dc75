"""Decoded planes hold the numbers of the file, however it stores them."""

from __future__ import annotations

import io
import tracemalloc
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.images import write_image
from psfcore.fits.viewing.decode import decode_plane
from psfcore.image import Image
from tests.psfcore.fits import raw_files

LIMITS = FitsLimits(max_pixels=2048 * 2048)


def decoded(path: Path, name: str = "image") -> tuple[np.ndarray, str | None]:
    target = io.BytesIO()
    about = decode_plane(path, name, LIMITS, target)
    return np.frombuffer(target.getvalue(), "<f4").reshape(about.shape), about.unit


def field(shape: tuple[int, int] = (300, 211), seed: int = 3) -> np.ndarray:
    """Positive whole numbers, so that every way to store them is exact."""
    return np.random.default_rng(seed).poisson(900, shape).astype(np.int32)


def test_plain_pixels(tmp_path: Path) -> None:
    for kind, ending in product(("u2", "i4", "f4", "f8"), (".fits", ".fits.gz")):
        stored = field().astype(kind)
        if kind in ("f4", "f8"):
            stored[3, 5], stored[7, 9] = np.nan, np.inf
        path = tmp_path / f"{kind}{ending}"
        fits.PrimaryHDU(stored, fits.Header({"BUNIT": "DN/s"})).writeto(path)
        pixels, unit = decoded(path)
        np.testing.assert_array_equal(pixels, stored.astype("f4"))
        assert unit == "DN/s"


def test_tile_compressed_pixels(tmp_path: Path) -> None:
    for codec, tile in product(("RICE_1", "GZIP_1", "GZIP_2"), ((1, 211), (64, 50), (300, 211))):
        hdu = fits.CompImageHDU(field(), compression_type=codec, tile_shape=tile)
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "x.fits", overwrite=True)
        pixels, unit = decoded(tmp_path / "x.fits")
        np.testing.assert_array_equal(pixels, field().astype("f4"))
        assert unit is None


def test_a_plane_of_several_blocks_with_quantised_tiles(tmp_path: Path) -> None:
    """More rows than one block holds, tiles that do not divide them, and dither, which depends on the number of the tile."""
    noise = np.random.default_rng(4).normal(50, 3, (1700, 1024)).astype("f4")
    hdu = fits.CompImageHDU(noise, compression_type="RICE_1", tile_shape=(7, 300), quantize_method=1)
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "x.fits")
    pixels, _ = decoded(tmp_path / "x.fits")
    np.testing.assert_array_equal(pixels, fits.getdata(tmp_path / "x.fits", 1))
    assert 0 < np.abs(pixels - noise).max() < 3, "quantised, but of the same scene"


def test_blank_and_scaled_pixels(tmp_path: Path) -> None:
    cards = raw_files.image_cards(32, 16, 16, "BSCALE  = 0.5", "BZERO   = 10.0", "BLANK   = -1")
    stored = np.arange(-1, 32 * 16 - 1, dtype=">i2").reshape(16, 32)
    (tmp_path / "x.fits").write_bytes(raw_files.block(*cards, data=stored.tobytes()))
    expected = np.where(stored == -1, np.nan, 0.5 * stored + 10)
    np.testing.assert_array_equal(decoded(tmp_path / "x.fits")[0], expected)


def write_product(path: Path) -> dict[str, np.ndarray]:
    """A product with planes; returns its planes as they were given."""
    rng = np.random.default_rng(5)
    shape = (40, 60)
    planes: dict[str, Any] = {
        "QUALITY": rng.integers(0, 128, shape).astype(np.uint8),
        "ERROR": rng.normal(2, 0.1, shape).astype("f4"),
    }
    planes["ERROR"][1, 2] = np.nan
    pixels = rng.normal(100, 1, shape)
    image = Image(pixels, np.zeros(shape, np.uint8), fits.Header({"BUNIT": "DN/s"}), "DN/s", 1.0)
    write_image(path, image, cards={}, planes=planes)
    return planes | {"IMAGE": pixels.astype("f4")}


def test_the_planes_of_a_product(tmp_path: Path) -> None:
    for name, plane in write_product(tmp_path / "p.fits").items():
        pixels, unit = decoded(tmp_path / "p.fits", name.lower())
        np.testing.assert_array_equal(pixels, plane.astype("f4"))
        assert unit == (None if name == "QUALITY" else "DN/s")


def test_a_plane_of_an_early_product_in_a_table(tmp_path: Path) -> None:
    plane = np.arange(12, dtype=np.uint8).reshape(3, 4)
    table = fits.BinTableHDU.from_columns(
        [fits.Column("QUALITY", "12B", dim="(4,3)", array=plane[None])], name="QUALITY"
    )
    table.header["PLANE"] = True
    fits.HDUList([fits.PrimaryHDU(np.zeros((3, 4), "f4")), table]).writeto(tmp_path / "p.fits")
    np.testing.assert_array_equal(decoded(tmp_path / "p.fits", "quality")[0], plane)


def test_a_plane_that_is_not_there_is_told_with_those_that_are(tmp_path: Path) -> None:
    fits.PrimaryHDU(field()).writeto(tmp_path / "x.fits")
    with pytest.raises(DataError, match=r"^no-such-plane: .*\(image\); got error: .*error_draws"):
        decoded(tmp_path / "x.fits", "error")


def test_a_damaged_file_is_an_error_of_its_data(tmp_path: Path) -> None:
    (tmp_path / "x.fits").write_bytes(raw_files.compressed("GZIP_1"))
    with pytest.raises(DataError, match=r"^(bad-tile|unreadable-pixels)"):
        decoded(tmp_path / "x.fits")


def test_memory_holds_some_rows_and_not_the_plane(tmp_path: Path) -> None:
    fits.PrimaryHDU(np.zeros((2048, 2048), "f4")).writeto(tmp_path / "x.fits")
    with (tmp_path / "out").open("wb") as target:
        decode_plane(tmp_path / "x.fits", "image", LIMITS, target)  # loads what is loaded once
        tracemalloc.start()
        decode_plane(tmp_path / "x.fits", "image", LIMITS, target)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 2048 * 2048 * 4, "less than the plane itself"
