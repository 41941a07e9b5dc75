"""A cache of PSFs for later images. They are already read, resampled to the pixels of an image and Fourier-transformed.

Only one thread at a time may use the cache, because all calls of an engine share its buffers. A worker process runs its
jobs one after the other, so one cache for each process is enough.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import TypeVar

from astropy.io.fits import Header

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Shape, new_engine
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.psf import Psf
from psfcore.psf_sampling import AS_BUILT, sampling_of, with_scale

Thing = TypeVar("Thing", Psf, tuple[Psf, Engine])


class PreparedPsfs:
    """Keeps the PSFs and engines that were used last, up to ``max_bytes`` together; it always keeps the newest one."""

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self._kept: OrderedDict[Hashable, tuple[object, int]] = OrderedDict()

    def on_pixels_of(
        self,
        header: Header,
        name: Hashable,
        find: Callable[[], Path],
        limits: FitsLimits,
        *,
        plate_scale_arcsec: float | None = None,
    ) -> Psf:
        """The PSF of a file on the pixels of an image with this header; repeated calls return the same object.

        name: a key that identifies the content of the file. find: returns the path of the file; it is called only if
        the PSF is not kept. plate_scale_arcsec: the plate scale of a PSF whose file gives none.
        """

        def read() -> Psf:
            return with_scale(read_psf(find(), limits, parts=False), plate_scale_arcsec)

        whole = self._once((name, limits, plate_scale_arcsec), read, _kernel_bytes)
        sampling = sampling_of(whole, header)
        if sampling == AS_BUILT:
            return whole
        return self._once(
            (name, limits, plate_scale_arcsec, sampling), lambda: sampling.of(whole), _kernel_bytes
        )

    def engine_for(self, psf: Psf, shape: Shape, span: Shape, threads: int) -> Engine:
        """The engine for a PSF and a shape. Pass the same PSF object again: the cache compares identity, not content."""

        def make() -> tuple[Psf, Engine]:
            return psf, new_engine(psf, shape, span, threads)

        # The PSF is kept together with its engine, so that Python cannot give the id() of the PSF to another object.
        return self._once((id(psf), shape, span, threads), make, lambda made: made[1].nbytes)[1]

    def _once(self, key: Hashable, make: Callable[[], Thing], size: Callable[[Thing], int]) -> Thing:
        if key not in self._kept:
            made = make()
            self._kept[key] = (made, size(made))
        self._kept.move_to_end(key)
        while len(self._kept) > 1 and sum(nbytes for _, nbytes in self._kept.values()) > self.max_bytes:
            self._kept.popitem(last=False)
        return self._kept[key][0]  # type: ignore[return-value]  # the object that was stored under this key above


def _kernel_bytes(psf: Psf) -> int:
    return int(psf.kernel.nbytes)
