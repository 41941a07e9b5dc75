from __future__ import annotations

import pickle

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError, HeaderError
from psfcore.image import Image, MaskBit


def test_a_wrong_image_is_refused() -> None:
    for pixels, mask_shape, code in (
        (np.ones(400), (400,), "not-2d"),
        (np.ones((15, 200)), (15, 200), "too-small"),
        (np.ones((20, 20)), (20, 21), "mask-shape"),
        (np.full((20, 20), np.nan), (20, 20), "unmasked-nonfinite"),
    ):
        with pytest.raises(DataError) as caught:
            Image(pixels, np.zeros(mask_shape, np.uint8), fits.Header(), None, None)
        assert caught.value.code == code


def test_any_bit_makes_a_pixel_invalid() -> None:
    mask = np.zeros((16, 16), np.uint8)
    mask[0, 0], mask[1, 1] = MaskBit.NONFINITE, MaskBit.SATURATED
    image = Image(np.ones((16, 16)), mask, fits.Header(), None, None)
    assert not image.valid[0, 0]
    assert not image.valid[1, 1]
    assert image.valid.sum() == 254


def test_errors_can_be_pickled() -> None:
    error = pickle.loads(pickle.dumps(HeaderError("not-fits", "expected FITS; got soup")))
    assert isinstance(error, HeaderError)
    assert (error.code, error.message) == ("not-fits", "expected FITS; got soup")
