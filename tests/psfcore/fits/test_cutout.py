"""Cut-outs: the pixels of the centre, byte by byte, and no more memory than a piece of them."""

from __future__ import annotations

import io
import tracemalloc
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.fits.cutout import cutout
from psfcore.fits.header import FitsLimits

LIMITS = FitsLimits(max_pixels=2**24)
MIB = 2**20


def random_psf(path: Path, shape: tuple[int, int], kind: str) -> np.ndarray:
    weights = np.random.default_rng(1).random(shape).astype(kind)
    fits.PrimaryHDU(weights).writeto(path, overwrite=True)
    return weights


def test_the_pixels_are_those_of_the_centre(tmp_path: Path) -> None:
    path = tmp_path / "psf.fits"
    for (ny, nx), kind, size in product([(64, 64), (63, 65), (7, 5)], ["f4", "f8"], [1, 2, 5]):
        weights = random_psf(path, (ny, nx), kind)
        part = cutout(path, size, LIMITS)
        content = b"".join(part.pieces())
        assert len(content) == part.length and part.length % 2880 == 0
        top, left = ny // 2 - size // 2, nx // 2 - size // 2
        expected = weights[top : top + size, left : left + size]
        with fits.open(io.BytesIO(content)) as hdus:
            hdus.verify("exception")
            np.testing.assert_array_equal(hdus[0].data, expected)
            assert hdus[0].header["PSFSUM"] == pytest.approx(float(expected.astype("f8").sum()), rel=1e-12)


def test_a_whole_psf_is_cut_out_in_pieces(tmp_path: Path) -> None:
    """Sixteen mebibytes of pixels take less than two of memory."""
    random_psf(tmp_path / "psf.fits", (2048, 2048), "f4")
    cutout(tmp_path / "psf.fits", 8, LIMITS)  # what is imported now does not count
    tracemalloc.start()
    try:
        part = cutout(tmp_path / "psf.fits", 2048, LIMITS)
        length = sum(map(len, part.pieces()))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert length == part.length == (tmp_path / "psf.fits").stat().st_size
    assert peak < 2 * MIB


def test_a_psf_that_was_cut_short_is_not_padded(tmp_path: Path) -> None:
    random_psf(tmp_path / "psf.fits", (64, 64), "f4")
    part = cutout(tmp_path / "psf.fits", 64, LIMITS)
    content = (tmp_path / "psf.fits").read_bytes()
    (tmp_path / "psf.fits").write_bytes(content[:8000])
    with pytest.raises(EOFError, match="of row"):
        list(part.pieces())
