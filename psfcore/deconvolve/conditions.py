"""Under which conditions an image is deconvolved: what all methods have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.edges import Edges
from psfcore.errors import DataError
from psfcore.noise import Noise
from psfcore.psf import Psf

Progress = Callable[[int, int], None]
Shape = tuple[int, int]
# (psf, shape of the plane, how far apart pixels are joined exactly, threads)
EngineFor = Callable[[Psf, Shape, Shape, int], Engine]


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
