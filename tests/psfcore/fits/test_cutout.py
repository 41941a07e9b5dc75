"""Cut-outs: the pixels of the centre, byte by byte, and no more memory than a piece of them."""

from __future__ import annotations

import io
import tracemalloc
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
    fits.PrimaryHDU(weights).writeto(path)
    return weights


@pytest.mark.parametrize("shape", [(64, 64), (63, 65), (7, 5)])
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("size", [1, 2, 5])
def test_the_pixels_are_those_of_the_centre(
    tmp_path: Path, shape: tuple[int, int], kind: str, size: int
) -> None:
    weights = random_psf(tmp_path / "psf.fits", shape, kind)
    made = cutout(tmp_path / "psf.fits", size, LIMITS)
    content = b"".join(made.pieces())
    assert len(content) == made.length and made.length % 2880 == 0
    ny, nx = shape
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
        made = cutout(tmp_path / "psf.fits", 2048, LIMITS)
        length = sum(map(len, made.pieces()))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert length == made.length == (tmp_path / "psf.fits").stat().st_size
    assert peak < 2 * MIB


def test_a_psf_that_was_cut_short_is_not_padded(tmp_path: Path) -> None:
    random_psf(tmp_path / "psf.fits", (64, 64), "f4")
    made = cutout(tmp_path / "psf.fits", 64, LIMITS)
    content = (tmp_path / "psf.fits").read_bytes()
    (tmp_path / "psf.fits").write_bytes(content[:8000])
    with pytest.raises(EOFError, match="of row"):
        list(made.pieces())
