from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.mask_file import read_mask_image


def test_png_and_fits_of_one_mask_agree(tmp_path: Path) -> None:
    """The top row of a PNG is the row with the highest y."""
    mask = np.zeros((8, 8))
    mask[6, 1] = 1  # upper left
    fits.PrimaryHDU(mask).writeto(tmp_path / "mask.fits")
    matplotlib.image.imsave(tmp_path / "mask.png", mask[::-1], cmap="gray")
    np.testing.assert_allclose(read_mask_image(tmp_path / "mask.png"), mask, atol=1e-6)
    np.testing.assert_allclose(read_mask_image(tmp_path / "mask.fits"), mask)


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"])
def test_a_broken_png_is_a_data_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mask.png"
    path.write_bytes(content)
    with pytest.raises(
        DataError, match=r"mount\.mask_image\.file: expected a PNG that can be read"
    ) as caught:
        read_mask_image(path)
    assert caught.value.code == "bad-mount"


@pytest.mark.parametrize("name", ["mask.png", "mask.fits"])
def test_a_missing_file_is_named_by_its_key(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match=r"mount\.mask_image\.file: expected"):
        read_mask_image(tmp_path / name)
