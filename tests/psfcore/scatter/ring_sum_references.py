"""Simple, slow methods for the sums of an image over segments, for tests and benchmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.scatter.segments import Segments


def segment_sums_plain(
    image: NDArray[np.floating], targets: NDArray[np.integer], segments: Segments
) -> NDArray[np.float64]:
    """Eq. (3) of psfcore.scatter.segments, (n, segments), by the label map."""
    ny, nx = image.shape
    # Targets lie on the image, so every offset is shorter than the longer side of the image.
    size = 2 * max(ny, nx) + 1
    label, middle = segments.label_map(size) + 1, size // 2
    weights = np.asarray(image, dtype=np.float64)[::-1, ::-1].ravel()
    out = np.empty((len(targets), segments.size))
    for n, (y, x) in enumerate(targets):
        # Labels of the offsets (y, x) - source, for sources from the last to the first.
        seen = label[middle + y - ny + 1 : middle + y + 1, middle + x - nx + 1 : middle + x + 1]
        out[n] = np.bincount(seen.ravel(), weights=weights, minlength=segments.size + 1)[1:]
    return out


def segment_sums_fft(
    image: NDArray[np.floating], targets: NDArray[np.integer], segments: Segments, *, threads: int = 1
) -> NDArray[np.float64]:
    """The same by one convolution of the whole image per segment, in float64."""
    label = segments.label_map(segments.reach_grid_px)
    out = np.empty((len(targets), segments.size))
    for k in range(segments.size):
        convolver = Convolver((label == k).astype(np.float64), image.shape, dtype=np.float64, threads=threads)
        out[:, k] = convolver.apply(image)[tuple(np.transpose(targets))]
    return out
