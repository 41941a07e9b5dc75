"""PSFs that this process has read, put on images' pixels and transformed: done once, shared by the images that follow.

An engine works on one image at a time, and so does a worker process.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import TypeVar

from astropy.io.fits import Header

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Shape, new_engine
from psfcore.fits.header import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.psf import Psf
from psfcore.psf_sampling import binning_factor, rebinned

Thing = TypeVar("Thing", Psf, tuple[Psf, Engine])


class PreparedPsfs:
    """The last ones used, as many as ``max_bytes`` hold; the very last one is always kept."""

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self._kept: OrderedDict[Hashable, tuple[object, int]] = OrderedDict()

    def on_pixels_of(self, header: Header, path: Path, limits: FitsLimits) -> Psf:
        """The PSF in a file, which never changes, on the pixels of an image with this header; the same object again."""
        whole = self._once((path, limits), lambda: read_psf(path, limits, parts=False), _kernel_bytes)
        factor = binning_factor(whole, header)
        if factor == 1:
            return whole
        return self._once((path, limits, factor), lambda: rebinned(whole, factor), _kernel_bytes)

    def engine_for(self, psf: Psf, shape: Shape, span: Shape, threads: int) -> Engine:
        """The engine for a PSF and a shape. A PSF is known by identity: pass the same object."""

        def make() -> tuple[Psf, Engine]:
            return psf, new_engine(psf, shape, span, threads)

        # The PSF is kept with its engine, so that no other can have its id meanwhile.
        return self._once((id(psf), shape, span, threads), make, lambda made: made[1].nbytes)[1]

    def _once(self, key: Hashable, make: Callable[[], Thing], size: Callable[[Thing], int]) -> Thing:
        if key not in self._kept:
            made = make()
            self._kept[key] = (made, size(made))
        self._kept.move_to_end(key)
        while len(self._kept) > 1 and sum(nbytes for _, nbytes in self._kept.values()) > self.max_bytes:
            self._kept.popitem(last=False)
        return self._kept[key][0]  # type: ignore[return-value]  # what was kept under this key


def _kernel_bytes(psf: Psf) -> int:
    return int(psf.kernel.nbytes)
