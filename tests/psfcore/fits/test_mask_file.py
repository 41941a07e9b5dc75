"""Masks of the aperture from PNG and FITS files."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.images import read_mask_image


def test_png_and_fits_of_one_mask_agree(tmp_path: Path) -> None:
    """The top row of a PNG is the row with the highest y."""
    mask = np.zeros((8, 8))
    mask[6, 1] = 1  # upper left
    fits.PrimaryHDU(mask).writeto(tmp_path / "mask.fits")
    matplotlib.image.imsave(tmp_path / "mask.png", mask[::-1], cmap="gray")
    np.testing.assert_allclose(read_mask_image(tmp_path / "mask.png"), mask, atol=1e-6)
    np.testing.assert_allclose(read_mask_image(tmp_path / "mask.fits"), mask)


def test_a_file_that_cannot_be_read_is_named_by_its_key(tmp_path: Path) -> None:
    for content in (b"", b"no picture", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"):
        (tmp_path / "broken.png").write_bytes(content)
        with pytest.raises(DataError, match=r"^bad-mount: mount\.mask_image\.file: expected a PNG"):
            read_mask_image(tmp_path / "broken.png")
    for name in ("mask.png", "mask.fits"):
        with pytest.raises(DataError, match=r"mount\.mask_image\.file: expected"):
            read_mask_image(tmp_path / name)
