"""Options that all deconvolution methods have in common, and a cache of prepared PSFs."""

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
# (psf, shape of the plane, span within which the convolution is exact, threads)
EngineFor = Callable[[Psf, Shape, Shape, int], Engine]


def new_engine(psf: Psf, shape: Shape, span: Shape, threads: int) -> Engine:
    """Make a new engine."""
    return Engine(psf.kernel, shape, span=span, threads=threads)


@dataclass(frozen=True)
class Conditions:
    """Options of a deconvolution. Raises DataError "bad-margin" for a negative margin.

    edges: assumption about the scene beyond the field; None: the default of the method, EDGES.
    margin_px: width of the margin beyond the field; None: the width is computed from the PSF. Edges "zero" have no
    margin. noise: noise of the camera; required if the stopping rule is "discrepancy".
    threads: number of threads; it does not change the result.
    progress(step, steps) is called after each step; its exceptions are not caught.
    engine_for: function that makes the engine; an `EngineCache` keeps engines between images.
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
    """A cache of engines by PSF, shape, span and threads. If it is full, it drops the least recently used engine.

    An engine processes one image at a time, so threads must not share a cache. An engine is used again only if the same
    `Psf` object is passed again; an equal copy of the object gets a new engine.
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
