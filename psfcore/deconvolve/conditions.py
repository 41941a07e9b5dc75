"""Under which conditions an image is deconvolved: what all methods have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from psfcore.deconvolve.edges import Edges
from psfcore.engine import Engine
from psfcore.errors import DataError
from psfcore.image import Image
from psfcore.psf import Psf

# Units of pixels that count per second of exposure, as FITS headers spell them.
_PER_SECOND = ("/s", "/sec", "s-1", "s^-1", "s**-1")

Progress = Callable[[int, int], None]
Shape = tuple[int, int]
# (psf, shape of the plane, how far apart pixels are joined exactly, threads)
EngineFor = Callable[[Psf, Shape, Shape, int], Engine]


@dataclass(frozen=True)
class Noise:
    """What a pixel scatters by: variance (DN^2) = photon_gain_dn * signal (DN) + read_noise_dn^2.

    photon_gain_dn: DN a detected photon. read_noise_dn: rms of the readout, DN. Both are those of the gain mode
    in which the image was taken. Raises DataError "bad-noise".
    """

    photon_gain_dn: float
    read_noise_dn: float

    def __post_init__(self) -> None:
        if not (self.photon_gain_dn >= 0 and self.read_noise_dn >= 0):
            raise DataError("bad-noise", f"expected noise figures of at least 0; got {self}")
        if not self.photon_gain_dn + self.read_noise_dn > 0:
            raise DataError("bad-noise", "expected photon noise or read noise above 0; got neither")

    def variance_terms(self, image: Image) -> tuple[float, float]:
        """(slope, readout): variance of a pixel of `image` = slope * signal + readout^2, in its own unit.

        Raises DataError "no-exposure" where the unit is per second and the exposure is not known.
        """
        exposure_s = 1.0
        if (image.unit or "").replace(" ", "").lower().endswith(_PER_SECOND):
            if not image.exposure_s:
                raise DataError("no-exposure", f"expected an exposure with pixels in {image.unit}; got none")
            exposure_s = image.exposure_s
        return self.photon_gain_dn / exposure_s, self.read_noise_dn / exposure_s


def new_engine(psf: Psf, shape: Shape, span: Shape, threads: int) -> Engine:
    """An engine for this call alone."""
    return Engine(psf.kernel, shape, span=span, threads=threads)


@dataclass(frozen=True)
class Conditions:
    """edges: what is taken to lie beyond the field; none: what the method does best with, its EDGES.

    margin_px: how far the scene is followed beyond the field (not with zero edges); none: as far as the PSF asks for.
    noise: needed where a method stops by discrepancy. threads: the result is the same for any number.
    progress(step, steps) is called after each step; what it raises passes through.
    engine_for: where engines come from; an `EngineCache` keeps them between images.
    """

    edges: Edges | None = None
    margin_px: int | None = None
    noise: Noise | None = None
    threads: int = 1
    progress: Progress | None = None
    engine_for: EngineFor = new_engine

    def __post_init__(self) -> None:
        if self.margin_px is not None and self.margin_px < 0:
            raise DataError("bad-margin", f"expected a margin of at least 0 px; got {self.margin_px}")


class EngineCache:
    """Engines by PSF, shape, span and threads, the least recently used forgotten first.

    An engine works on one image at a time, and so does a cache. A PSF is known by identity: pass the same object.
    """

    def __init__(self, capacity: int = 2) -> None:
        self.capacity = capacity
        self._kept: list[tuple[Psf, tuple[Shape, Shape, int], Engine]] = []

    def __call__(self, psf: Psf, shape: Shape, span: Shape, threads: int) -> Engine:
        asked = (shape, span, threads)
        for n, (kept_psf, kept, engine) in enumerate(self._kept):
            if kept_psf is psf and kept == asked:
                self._kept.append(self._kept.pop(n))
                return engine
        engine = new_engine(psf, shape, span, threads)
        self._kept.append((psf, asked, engine))
        del self._kept[: -self.capacity]
        return engine
