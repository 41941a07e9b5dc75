"""What all deconvolution methods have in common: their options, their result, and a cache of prepared PSFs."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.box import Box
from psfcore.deconvolve.declaration import Edges
from psfcore.errors import DataError
from psfcore.fits.cards import Cards
from psfcore.image import Image
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.psf_sampling import AS_BUILT, sampling_of

Progress = Callable[[int, int], None]
Shape = tuple[int, int]
# (psf, shape of the plane, span within which the convolution is exact, threads, width of the margin around the image)
EngineFor = Callable[[Psf, Shape, Shape, int, int], Engine]
Thing = TypeVar("Thing", Psf, tuple[Psf, Engine])


def new_engine(psf: Psf, shape: Shape, span: Shape, threads: int, margin_px: int = 0) -> Engine:
    """Make a new engine, for a plane that consists of an image and a margin around it."""
    terms = [term for term in psf.field_terms if term.kernel.any()]
    if not terms:
        return Engine(psf.kernel, shape, span=span, threads=threads)
    from psfcore.convolution.field_engine import FieldEngine  # few PSFs change over the field

    assert psf.place is not None
    coordinates = psf.place.from_pixel(-margin_px, -margin_px).coordinates(shape)
    return FieldEngine(psf.kernel, terms, coordinates, shape, span=span, threads=threads)


@dataclass(frozen=True)
class Conditions:
    """Options that all methods have. Raises DataError "bad-margin" for a negative margin.

    Attributes
    ----------
    edges
        Assumption about the scene beyond the field; None: the default of the method.
    margin_px
        Width of the margin beyond the field; None: the width is computed from the PSF. Edges "zero" and "periodic" have
        no margin.
    noise
        Noise of the camera; required if the stopping rule is "discrepancy".
    threads
        Number of threads; it does not change the result.
    progress
        Function of the step and the number of steps that is called after each step; its exceptions are not caught.
    engine_for
        Function that makes the engine; `PreparedPsfs.engine_for` keeps engines between images.
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


@dataclass(frozen=True)
class OfBox:
    """How a box of an image was deconvolved alone (`psfcore.deconvolve.work`).

    Attributes
    ----------
    box
        The box in the pixels of the whole image.
    rim_px
        Largest width of the rim around the box.
    error
        Bound of the difference from the deconvolution of the whole image, in the unit of the image; 0: there is no
        difference.
    mean
        Mean of the valid pixels of the box in the image, in the unit of the image.
    """

    box: Box
    rim_px: int
    error: float
    mean: float

    @property
    def error_pct(self) -> float:
        """The bound in percent of the mean of the box, as the option `region_error` gives it."""
        return 100 * self.error / abs(self.mean) if self.error else 0.0


@dataclass(frozen=True)
class Deconvolved:
    """An estimate of the scene, and how the method reached it.

    Attributes
    ----------
    pixels
        Estimate [y, x] in the image's unit, float32 if this type can represent it; NaN where the image has no finite
        value.
    stopped_because
        Reason why the iteration ended.
    flux_in
        Sum of the image over its valid pixels. Negative pixels are included.
    flux_out
        Sum of the estimate over the same pixels.
    negative_pixels
        Number of valid pixels below 0 in the image.
    last_change
        Rms of the change in the last step, divided by the rms of the estimate.
    edges, margin_px
        Assumption about the scene beyond the field, and width of the margin.
    edge_band_px
        Width of the band along the edges in which the result depends on light from beyond the field.
    noise_amplification
        The rms noise of the estimate divided by the rms noise of the image, for uncorrelated noise; None if the method
        is not linear.
    chi2_per_pixel
        The chi2 of the fit divided by the number of judged pixels (`psfcore.deconvolve.problem`); None if the noise
        is not known.
    of_box
        How the box was deconvolved, if the result is a box of an image; None for a whole image.
    """

    pixels: NDArray[np.floating]
    method: str
    steps_done: int
    stopped_because: str
    flux_in: float
    flux_out: float
    negative_pixels: int
    last_change: float
    edges: Edges
    margin_px: int
    edge_band_px: int
    noise_amplification: float | None = None
    chi2_per_pixel: float | None = None
    of_box: OfBox | None = None

    @property
    def flux_change_pct(self) -> float:
        """Change of the flux, percent of the absolute value of the flux before; 0 if that is 0."""
        return 100 * (self.flux_out - self.flux_in) / abs(self.flux_in) if self.flux_in else 0.0


def fluxes(image: Image, pixels: NDArray[np.floating]) -> tuple[float, float, int]:
    """`flux_in`, `flux_out` and `negative_pixels` of a `Deconvolved` with these pixels."""
    # The sums use no copies of planes: here most of the memory of a deconvolution is in use.
    counted = image.valid
    negative = image.pixels < 0
    negative &= counted
    return (
        float(image.pixels.sum(where=counted)),
        float(pixels.sum(where=counted, dtype=np.float64)),
        int(np.count_nonzero(negative)),
    )


class PreparedPsfs:
    """A cache of PSFs for later images: read, resampled to the pixels of an image, and Fourier-transformed as an
    engine.

    It keeps what was used last, up to ``max_bytes`` together, and always the newest. Only one thread at a time may use
    it, because all calls of an engine share its buffers.
    """

    def __init__(self, max_bytes: int = 2**29) -> None:
        self.max_bytes = max_bytes
        self._kept: OrderedDict[Hashable, tuple[object, int]] = OrderedDict()

    def __reduce__(self) -> tuple[type[PreparedPsfs], tuple[int]]:
        # A copy, also in another process, is empty: engines hold threads and buffers, and are made again when needed.
        return PreparedPsfs, (self.max_bytes,)

    def as_built(self, key: Hashable, read: Callable[[], Psf]) -> Psf:
        """The PSF that `read` returns; repeated calls with the same key return the same object."""
        return self._once(key, read, _kernel_bytes)

    def on_pixels_of(
        self, header: Cards, key: Hashable, read: Callable[[], Psf], shape: Shape | None = None
    ) -> Psf:
        """The PSF of `as_built` on the pixels of an image with this header; repeated calls return the same object.

        Parameters
        ----------
        shape
            Shape (ny, nx) of the image; None: as the header says.
        """
        whole = self.as_built(key, read)
        sampling = sampling_of(whole, header, shape)
        if sampling == AS_BUILT:
            return whole
        return self._once((key, sampling), lambda: sampling.of(whole), _kernel_bytes)

    def engine_for(self, psf: Psf, shape: Shape, span: Shape, threads: int, margin_px: int = 0) -> Engine:
        """The engine for a PSF and a shape. Pass the same PSF object again: the cache compares identity, not
        content.
        """

        def make() -> tuple[Psf, Engine]:
            return psf, new_engine(psf, shape, span, threads, margin_px)

        # The PSF is kept together with its engine, so that Python cannot give the id() of the PSF to another object.
        return self._once((id(psf), shape, span, threads, margin_px), make, lambda pair: pair[1].nbytes)[1]

    def _once(self, key: Hashable, make: Callable[[], Thing], size: Callable[[Thing], int]) -> Thing:
        if key not in self._kept:
            thing = make()
            self._kept[key] = (thing, size(thing))
        self._kept.move_to_end(key)
        while len(self._kept) > 1 and sum(nbytes for _, nbytes in self._kept.values()) > self.max_bytes:
            self._kept.popitem(last=False)
        return self._kept[key][0]  # type: ignore[return-value]  # the object that was stored under this key above


def _kernel_bytes(psf: Psf) -> int:
    return int(psf.kernel.nbytes) + sum(term.kernel.nbytes for term in psf.field_terms)
