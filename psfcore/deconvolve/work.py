"""The work on an image or on a box of it: the estimate, its errors, the measured changes, and the quality plane.

A box is deconvolved alone, with a rim around it and a bound of the error. Only the light of the rim and the box is
deconvolved. Light from beyond the rim is computed and subtracted first:

    E[p] = sum over q beyond the rim of h[p - q] u[q]             Eq. (1)
    y'[p] = (y[p] / a[p] - E[p]) b[p]                             Eq. (2)

u is the scene on the whole image and its margin. It is estimated on coarse pixels, the means of k x k pixels, by the
iteration of van Cittert, u <- max(0, u + y / a - H u). The box and the rim y' are then deconvolved with the edges
"zero", because no light of y' comes from beyond the rim.

A linear method converges to H x = y, so a = b = 1. The published step of Richardson-Lucy does not. It conserves the
flux, and it compensates for light that leaves a plane with the factor r of H^T r = 1 (see `methods.richardson_lucy`):
it converges to H x = y / r. So a is r on the plane of the whole image, and b is r on the plane of box and rim. With
these factors, both deconvolutions converge to the same scene.

The difference between the box alone and the same box of the whole image is estimated by

    bound = A max over the box of E        Eq. (3)

If both deconvolutions had converged, the difference would be the error of E alone, which is much smaller. But both stop
before they converge. E is part of the model image of the whole image: after few steps the whole image still contains a
part of it, and it slows down the convergence of the pixels that it covers. The subtraction removes both effects. A =
AMPLIFICATION is the amplification of a slowly varying error by a deconvolution: it is below 2, because more than half
of the light of a PSF falls within the width of the rim. Eq. (3) is not proved; the tests compare it with the
differences for the default number of steps of all methods, and docs/speed.md has a table of them: they are at least 5
times smaller. With fewer steps than the default, the difference near bright pixels may be larger than the bound.

| symbol | name | unit |
|---|---|---|
| p, q | pixels of box and rim, and beyond the rim | - |
| h, H | PSF, convolution with it | - |
| y, u | image, coarse scene | image unit |
| E | light_from_beyond | image unit |
| k | factor | px |
| a, b | 1 / shares of the image and of box and rim | - |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess.changes import Changes, measure_changes
from psfcore.deconvolve.assess.quality import QualityBit, quality_plane
from psfcore.deconvolve.box import LARGEST_ERROR, Box, region_without_discrepancy, region_without_errors
from psfcore.deconvolve.conditions import Conditions, Deconvolved, OfBox, Progress, fluxes, new_engine
from psfcore.deconvolve.declaration import WITHOUT_MARGIN, Edges
from psfcore.deconvolve.edges import margin_for, share_from_beyond
from psfcore.deconvolve.methods.registry import method_named, properties_of
from psfcore.errors import DataError
from psfcore.fits.viewing.regions import moved_header
from psfcore.image import Image
from psfcore.noise import Noise
from psfcore.psf import Psf, psf_from_pixel, with_kernels
from psfcore.psf_sampling import check_compatible, rebinned_kernel

if TYPE_CHECKING:
    from psfcore.convolution.convolver import Convolver
    from psfcore.convolution.engine import Engine
    from psfcore.deconvolve.assess.error_planes import ErrorPlanes

ERROR_ESTIMATE = "error estimate"  # a stage whose steps are noise realisations
MOST_DRAWS = 64
AMPLIFICATION = 2.0
ROUNDING = 1e-5  # rounding error of a deconvolution in float32, as a share of the brightest pixel
# Widths of rims are multiples of this; the factors of the coarse pixels divide it.
RIM_STEP_PX = 32
_COARSE_PX = 512  # largest side of the coarse image, if its pixels are not larger than _LARGEST_FACTOR
_LARGEST_FACTOR = 8
_ITERATIONS = 8  # after these, u and r have converged to about 1 % of their first change

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class Options(Conditions):
    """How an image is deconvolved.

    Raises DataError "bad-draws", "bad-margin", "region-errors", "unknown-method", and the errors of `Method.complete`.

    Attributes
    ----------
    method
        Name of the method.
    parameters
        The parameters of this method, such as steps and stop.
    error_draws
        Number of noise realisations (2 to 64) for the planes of errors; 0: no such planes.
    region
        The box of the image that is deconvolved alone; None: the whole image. Its rim is so wide that the bound of its
        error is at most `region_error`, a share of the mean light of the box.
    """

    method: str = "richardson-lucy"
    parameters: Mapping[str, Any] = field(default_factory=dict)
    error_draws: int = 0
    region: Box | None = None
    region_error: float = LARGEST_ERROR

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.region is not None and self.error_draws:
            raise region_without_errors(self.error_draws)
        if self.error_draws and not 2 <= self.error_draws <= MOST_DRAWS:
            raise DataError(
                "bad-draws", f"error_draws: expected 0, or 2 to {MOST_DRAWS}; got {self.error_draws}"
            )
        of_method = {name: value for name, value in self.parameters.items() if name != "stop"}
        properties_of(self.method).complete(of_method)


@dataclass(frozen=True)
class Assessed:
    """The measured changes of a deconvolution, and the quality plane [y, x] (bits of `QualityBit`)."""

    changes: Changes
    quality: NDArray[np.uint8]


@dataclass(frozen=True)
class Work:
    """One deconvolution of one image.

    The method runs for the image. If errors are requested, it runs again for each noise realisation and for each
    variant of the PSF within its errors.

    Attributes
    ----------
    psf
        The PSF on the image's pixels.
    """

    image: Image
    psf: Psf
    options: Options

    def run(
        self, image: Image | None = None, psf: Psf | None = None, progress: Progress | None = None
    ) -> Deconvolved:
        """Run the method. Either argument replaces the attribute of the same name.

        Parameters
        ----------
        image
            An image with the shape of `self.image`; None: `self.image`.
        psf
            A PSF on the pixels of the image; None: `self.psf`.
        """
        options = replace(self.options, progress=progress)
        return method_named(options.method)(
            image or self.image, psf or self.psf, options, **options.parameters
        )

    def errors(
        self,
        result: Deconvolved,
        *,
        possible_psfs: Callable[[], Sequence[Psf]] = lambda: (),
        begin: Callable[[str, int], Progress | None] = lambda stage, steps: None,
    ) -> ErrorPlanes:
        """The error planes. The options contain the number of noise realisations and the noise.

        Parameters
        ----------
        possible_psfs
            Function that returns variants of the PSF within its errors, on the pixels of the image. It returns no PSF
            if the errors are not known.
        begin
            Function begin(stage, steps) that is called when a stage begins, and returns the progress function of the
            stage.
        """
        # Most deconvolutions compute no errors, and do not load SciPy.
        from psfcore.deconvolve.assess.error_planes import error_planes, spread_of_results

        def pixels(image: Image | None = None, psf: Psf | None = None) -> Plane:
            return self.run(image, psf).pixels.astype(np.float64, copy=False)

        progress = begin(ERROR_ESTIMATE, self.options.error_draws)
        # The first run deconvolves the model image without noise.
        told = None if progress is None else lambda done, of: progress(done - 1, of - 1)
        planes = error_planes(
            self.image,
            self.psf,
            pixels,
            replace(self.options, progress=told),
            estimate=result.pixels.astype(np.float64, copy=False),
            draws=self.options.error_draws,
            edge_px=result.edge_band_px,
        )
        psfs = possible_psfs()
        if not psfs:
            return planes
        spread = spread_of_results(
            psfs,
            lambda psf: pixels(psf=psf),
            progress=begin("errors of the PSF", len(psfs)),
        )
        return replace(planes, psf_error=np.where(np.isnan(planes.error), np.nan, spread))

    def assess(self, result: Deconvolved, errors: ErrorPlanes | None) -> Assessed:
        """Measure the changes, and make the quality plane."""
        # At most a quarter of the shorter side is marked as an edge.
        edge_px = min(result.edge_band_px, min(result.pixels.shape) // 4)
        changes = measure_changes(
            self.image,
            result.pixels,
            self.psf,
            noise=self.options.noise,
            edge_px=edge_px,
            threads=self.options.threads,
        )
        quality = quality_plane(
            self.image,
            result.pixels,
            edge_px=edge_px,
            suspected=changes.artefacts.suspected,
            error=None if errors is None else errors.error,
        )
        return Assessed(changes, quality)


@dataclass(frozen=True)
class BoxWork:
    """The deconvolution of a box. `run` and `assess` correspond to those of `Work`.

    Attributes
    ----------
    image
        The box, as it was observed; its header has the coordinates of the box.
    work
        The deconvolution of box and rim.
    box, rim
        The box, and the box with its rim, in the pixels of the whole image.
    shape
        (ny, nx) of the whole image.
    edges
        The assumption about the scene beyond the whole image.
    of_mask
        QUALITY of the box that follows from the mask of box and rim.
    noise
        Noise of the camera, if known.
    error
        Eq. (3), in the unit of the image; 0 if the rim is the whole image.
    mean
        Mean of the valid pixels of the box, in the unit of the image.
    """

    image: Image
    work: Work
    box: Box
    rim: Box
    shape: tuple[int, int]
    edges: Edges
    of_mask: NDArray[np.uint8]
    noise: Noise | None
    error: float
    mean: float

    @property
    def options(self) -> Options:
        """The options of the deconvolution of box and rim."""
        return self.work.options

    @property
    def rim_px(self) -> int:
        """Largest width of the rim, px."""
        box, rim = self.box, self.rim
        return max(box.x0 - rim.x0, rim.x1 - box.x1, box.y0 - rim.y0, rim.y1 - box.y1)

    def run(self, progress: Progress | None = None) -> Deconvolved:
        """Deconvolve box and rim, and cut out the box. Flux and negative pixels are those of the box."""
        of_rim = self.work.run(progress=progress)
        pixels = np.ascontiguousarray(of_rim.pixels[self.box.inside(self.rim).slices])
        flux_in, flux_out, negative_pixels = fluxes(self.image, pixels)
        return replace(
            of_rim,
            pixels=pixels,
            flux_in=flux_in,
            flux_out=flux_out,
            negative_pixels=negative_pixels,
            edges=self.edges,
            of_box=OfBox(self.box, self.rim_px, self.error, self.mean),
        )

    def assess(self, result: Deconvolved, errors: ErrorPlanes | None = None) -> Assessed:
        """Measure the changes in the box, and make its quality plane."""
        near_edge = self._near_edge(result.edge_band_px)
        changes = measure_changes(
            self.image,
            result.pixels,
            self.work.psf,
            noise=self.noise,
            edge_px=self._counted_edge_px(result.edge_band_px),
            threads=self.options.threads,
        )
        quality = self.of_mask.copy()
        quality[near_edge] |= np.uint8(QualityBit.EDGE)
        quality[changes.artefacts.suspected] |= np.uint8(QualityBit.ARTEFACT)
        return Assessed(changes, quality)

    def _near_edge(self, band_px: int) -> NDArray[np.bool_]:
        """The pixels of the box in the band along the edges of the whole image."""
        ny, nx = self.shape
        y, x = np.ogrid[self.box.slices]
        return np.asarray(np.minimum(np.minimum(y, ny - 1 - y), np.minimum(x, nx - 1 - x)) < band_px)

    def _counted_edge_px(self, band_px: int) -> int:
        """The width of the part of the band that lies in the box, at most a quarter of the box."""
        box, (ny, nx) = self.box, self.shape
        nearest = min(box.x0, box.y0, nx - box.x1, ny - box.y1)
        return max(0, min(band_px - nearest, min(box.shape) // 4))


def box_work(work: Work, box: Box) -> BoxWork:
    """Prepare the deconvolution of a box: choose the rim, and subtract the light from beyond the rim.

    The rim is the narrowest one whose bound is at most the option `region_error`, as a share of the mean light of the
    box, or the whole image if no rim is wide enough.

    Raises DataError "region-outside", "region-too-small", "bad-region-error", "region-discrepancy", "all-masked", and
    "plate-scale-mismatch".

    Parameters
    ----------
    work
        The deconvolution of the whole image.
    """
    image, options, method = work.image, work.options, properties_of(work.options.method)
    shape = (image.pixels.shape[0], image.pixels.shape[1])
    box.checked(shape)
    if not 0 < options.region_error <= 1:
        raise DataError(
            "bad-region-error",
            f"expected an error of the region above 0 and at most 1; got {options.region_error:g}",
        )
    if options.parameters.get("stop") == "discrepancy":
        raise region_without_discrepancy()
    valid = image.valid[box.slices]
    if not valid.any():
        raise DataError(
            "all-masked",
            f"expected a region with pixels that are not masked; all pixels of {box} are masked: move it",
        )
    check_compatible(image, work.psf)
    edges = options.edges or method.edges
    margin_px = 0 if edges in WITHOUT_MARGIN else options.margin_px
    if margin_px is None:
        margin_px = margin_for(share_from_beyond(work.psf), shape, share=method.margin_share)
    far = _FarLight(work, margin_px, method.keeps_flux)
    mean = float(image.pixels[box.slices].mean(where=valid))
    largest = options.region_error * abs(mean)
    for width_px in _widths(shape):
        rim = box.wider(width_px, shape, RIM_STEP_PX)
        if rim.shape == shape:
            break
        light = far.beyond(rim, box)
        if light.error <= largest:
            break
    if rim.shape == shape:
        alone, error = work, 0.0
    else:
        pixels = (image.pixels[rim.slices] * light.kept - light.light) / light.shares
        alone = replace(
            work,
            image=_part(image, rim, pixels),
            psf=psf_from_pixel(work.psf, rim.x0, rim.y0),
            options=replace(options, edges="zero", margin_px=None, noise=None),
        )
        error = light.error
    seen = _part(image, rim, image.pixels[rim.slices])
    return BoxWork(
        image=_part(image, box, image.pixels[box.slices]),
        work=alone,
        box=box,
        rim=rim,
        shape=shape,
        edges=edges,
        of_mask=quality_plane(seen, seen.pixels, edge_px=0)[box.inside(rim).slices],
        noise=options.noise,
        error=error,
        mean=mean,
    )


def _widths(shape: tuple[int, int]) -> list[int]:
    """Widths of rims, each about 1.4 times the one before. The last rim is the whole image."""
    widths = [RIM_STEP_PX]
    while widths[-1] < max(shape):
        widths.append(-(-int(1.42 * widths[-1]) // RIM_STEP_PX) * RIM_STEP_PX)
    return widths


def _part(image: Image, box: Box, pixels: Plane) -> Image:
    rows, columns = box.slices
    return replace(
        image, pixels=pixels, mask=image.mask[box.slices], header=moved_header(image.header, columns, rows)
    )


@dataclass(frozen=True, eq=False)
class _Light:
    """Values for box and rim, [y, x]: E of Eq. (1), 1 / a and 1 / b of Eq. (2); and the bound of the error in the
    box.
    """

    light: Plane
    kept: Plane | float
    shares: Plane | float
    error: float


class _FarLight:
    """The coarse scene u of an image, and its light that comes from beyond any rim."""

    def __init__(self, work: Work, margin_px: int, keeps_flux: bool) -> None:
        image, kernel = work.image, work.psf.kernel
        self.factor = min(_LARGEST_FACTOR, max(1, max(image.pixels.shape) // _COARSE_PX))
        self._brightest = float(np.abs(image.pixels).max(where=image.finite, initial=0))
        self._threads, self._keeps_flux = work.options.threads, keeps_flux
        self._kernel = rebinned_kernel(kernel, self.factor)
        self._field = work.psf if work.psf.field_terms else None
        coarse = _means(image, self.factor)
        margin = margin_px // self.factor
        plane = np.pad(coarse, margin, mode="symmetric")
        field = tuple(slice(margin, margin + n) for n in coarse.shape)
        convolver = self._convolver(plane.shape, (-margin, -margin))
        kept = 1 / _compensation(convolver, plane.shape) if self._keeps_flux else np.ones(plane.shape)
        scene = plane
        for _ in range(_ITERATIONS):
            scene = np.maximum(scene + (plane * kept - convolver.apply(scene)), 0)
        self._kept = kept[field]
        self._scene, self._light = scene[field], convolver.apply(scene)[field]

    def _convolver(self, shape: tuple[int, int], first: tuple[int, int]) -> Convolver | Engine:
        """The operator of a plane of coarse pixels whose first one is the pixel `first` (x, y) of the coarse image."""
        if self._field is not None:
            coarse = with_kernels(self._field, lambda kernel: rebinned_kernel(kernel, self.factor))
            place = coarse.place.binned(self.factor).from_pixel(*first) if coarse.place else None
            return new_engine(replace(coarse, place=place), shape, shape, self._threads)
        # A deconvolution of a whole image does not load SciPy.
        from psfcore.convolution.convolver import Convolver

        return Convolver(self._kernel, shape, threads=self._threads)

    def beyond(self, rim: Box, box: Box) -> _Light:
        """The light from beyond a rim."""
        k = self.factor
        here = slice(rim.y0 // k, -(-rim.y1 // k)), slice(rim.x0 // k, -(-rim.x1 // k))
        convolver = self._convolver(self._scene[here].shape, (here[1].start, here[0].start))
        light = np.maximum(self._light[here] - convolver.apply(self._scene[here]), 0)  # Eq. (1)
        kept, shares = self._kept[here], np.ones(light.shape)
        if self._keeps_flux:
            shares = 1 / _compensation(convolver, light.shape)
        fine, kept, shares = (_between(plane, rim.shape, k) for plane in (light, kept, shares))
        error = AMPLIFICATION * float(fine[box.inside(rim).slices].max())  # Eq. (3)
        error += ROUNDING * self._brightest
        return _Light(fine, kept, shares, error)


def _compensation(convolver: Convolver | Engine, shape: tuple[int, int]) -> Plane:
    """R of H^T r = 1, by the iteration of van Cittert."""
    ones = np.ones(shape)
    ratio = ones
    for _ in range(_ITERATIONS):
        ratio = ratio + (ones - convolver.adjoint(ratio))
    return ratio


def _between(coarse: Plane, shape: tuple[int, int], factor: int) -> Plane:
    """Interpolate linearly between the centres of coarse pixels; the first coarse pixel begins at the first pixel."""
    weights = []
    for size, count in zip(shape, coarse.shape, strict=True):
        place = np.clip((np.arange(size) + 0.5) / factor - 0.5, 0, count - 1)
        weights.append(np.maximum(0, 1 - np.abs(place[:, None] - np.arange(count))))
    rows, columns = weights
    return np.asarray(rows @ coarse @ columns.T)


def _means(image: Image, factor: int) -> Plane:
    """Means of the finite pixels of factor x factor pixels; the mean of the image where there are none."""
    finite = image.finite
    total, count = (_sums(plane, factor) for plane in (np.where(finite, image.pixels, 0.0), finite))
    return np.where(count > 0, total / np.maximum(count, 1), total.sum() / count.sum())


def _sums(plane: NDArray[np.generic], factor: int) -> Plane:
    ny, nx = (-(-size // factor) for size in plane.shape)
    padded = np.zeros((ny * factor, nx * factor))
    padded[: plane.shape[0], : plane.shape[1]] = plane
    return np.asarray(padded.reshape(ny, factor, nx, factor).sum(axis=(1, 3)))
