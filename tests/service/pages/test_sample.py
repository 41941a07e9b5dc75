"""The pictures of the sample image on the first page."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from studies.sample_image import draw

BLOCK_PX = 8
JPEG_ERROR = 4.0  # rms of the means of blocks, levels; those of the two pictures differ by 9


@pytest.mark.slow
def test_the_pictures_on_the_first_page_are_those_of_the_sample_image() -> None:
    for path, drawn in draw().items():
        with Image.open(path) as shipped:
            difference = np.subtract(shipped.reduce(BLOCK_PX), drawn.reduce(BLOCK_PX), dtype=np.float64)
        assert np.sqrt((difference**2).mean()) < JPEG_ERROR, path.name
