"""The weights of a PSF that a convolution needs. This module loads no library of transforms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def needed_kernel(
    psf_kernel: NDArray[np.floating], field_shape: tuple[int, int]
) -> tuple[NDArray[np.floating], tuple[int, int]]:
    """Cut a kernel to the offsets that can connect two pixels of the field; also return the offset of its first
    pixel.
    """
    (y0, y1), (x0, x1) = (_needed(n, size) for n, size in zip(psf_kernel.shape, field_shape, strict=True))
    return psf_kernel[y0:y1, x0:x1], (y0 - psf_kernel.shape[0] // 2, x0 - psf_kernel.shape[1] // 2)


def _needed(kernel_size: int, field_size: int) -> tuple[int, int]:
    """Range of indices, along one axis, of the offsets that can connect two pixels of the field."""
    centre = kernel_size // 2
    return max(0, centre - (field_size - 1)), min(kernel_size, centre + field_size)
