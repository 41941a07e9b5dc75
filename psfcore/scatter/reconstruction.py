"""A transit reconstructed with one PSF: its scenes, the light in its discs that the PSF does not explain, and the fit.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm", steps (d) to (f).
The equations and the symbols are those of `psfcore.scatter.inversion`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from queue import SimpleQueue
from typing import Self, TypeVar

import numpy as np

from psfcore.arrays import Kernel, Matrix, Vector
from psfcore.memory import return_unused_heap
from psfcore.scatter.scenes import Scenes
from psfcore.scatter.shapes import Shape
from psfcore.scatter.total_psf import Blur, Lanes, Optics, Pixels, TotalPsf, put
from psfcore.transit.occulter import LARGEST_SHIFT_PX, FoundPlace, find_occulter, fully_dark
from psfcore.transit.transit import Frame, Transit

Progress = Callable[[str, int, int], None]
Tool = TypeVar("Tool")
Result = TypeVar("Result")

DARK_MARGIN_PX = 0.05
DARK_MARGIN_SIGMAS = 1.5
LARGEST_DARK_MARGIN_PX = 2.5
LEAST_DARK_PIXELS = 30
# The variance of a pixel is computed from its expected intensity, but at least from this fraction of the disc's mean.
LEAST_LEVEL = 0.2
# If the PSF has at least this power at all frequencies, scenes that are continued settle within the rounds of a fit.
SETTLING_TRANSFER = 0.05


def labelled(progress: Progress, label: str) -> Progress:
    """The same progress function; the names of the stages begin with a label."""
    return lambda stage, step, steps: progress(f"{label}: {stage}", step, steps)


def on_threads(
    work: Callable[[Tool, int], Result],
    numbers: Sequence[int],
    tools: Sequence[Tool],
    told: Callable[[int], object],
) -> list[Result]:
    """work(tool, n) for each number, on as many threads as there are tools; no two threads use a tool at the same time.

    Images are computed beside each other, because one image keeps several threads busy only in its transforms.
    told(step) is called before each result is waited for; if it raises an exception, the images that are left are not
    computed.
    """
    free: SimpleQueue[Tool] = SimpleQueue()
    for tool in tools:
        free.put(tool)

    def one(n: int) -> Result:
        tool = free.get()
        try:
            return work(tool, n)
        finally:
            free.put(tool)

    pool = ThreadPoolExecutor(len(tools))
    try:
        pending = pool.map(one, numbers) if len(tools) > 1 else map(one, numbers)
        results = []
        for step in range(len(numbers)):
            told(step)
            results.append(next(pending))
        return results
    finally:
        pool.shutdown(cancel_futures=True)
        if len(tools) > 1:
            return_unused_heap()  # of the threads that ended


@dataclass(eq=False)
class TransitScenes:
    """The latest scenes of all images of a transit, and the positions of their occulters.

    Scenes are stored in the memory order of the convolution engine (see `psfcore.scatter.total_psf`). Images are not,
    because a second copy of them would take half the memory of a fit.
    """

    transit: Transit
    scenes: Scenes
    found: list[FoundPlace] = field(default_factory=list)
    dark: list[Pixels] = field(default_factory=list)

    @classmethod
    def reconstructed(cls, transit: Transit, optics: Optics, progress: Progress) -> TransitScenes:
        """Step (d): the scenes of all images; no occulter is located yet."""
        scenes = Scenes(len(transit.frames), optics.engine.lanes_shape)

        def scene(optics: Optics, n: int) -> None:
            observed, start = optics.fields
            optics.lanes(transit.frames[n].pixels, out=observed)
            start[:] = observed
            scenes[n] = optics.invert(observed, start)

        every = range(len(transit.frames))
        on_threads(scene, every, optics.twins(), lambda step: progress("reconstructing", step, len(every)))
        return cls(transit, scenes)

    def improve(self, n: int, optics: Optics, steps: int) -> Lanes:
        """Step (d) again: continue from the scene of image n for some steps.

        Returns the new scene, which is overwritten when these optics reconstruct the next one.

        If the PSF has little power at some frequencies, each step restores more of them and amplifies their noise more.
        Then the reconstruction begins again, so that the scene does not depend on the number of rounds.
        """
        observed, scene = optics.fields
        optics.lanes(self.transit.frames[n].pixels, out=observed)
        if optics.least_transfer >= SETTLING_TRANSFER:
            optics.invert(observed, self.scenes.stored(n).lanes(out=scene), steps=steps)
        else:
            scene[:] = observed
            optics.invert(observed, scene)
        self.scenes[n] = scene
        return scene

    def copy(self) -> TransitScenes:
        """A second object with the same contents."""
        return replace(self, scenes=self.scenes.copy(), found=list(self.found), dark=list(self.dark))

    def find(
        self,
        optics: Optics,
        psf_kernel: Kernel,
        progress: Progress = lambda stage, step, steps: None,
    ) -> None:
        """Step (e): locate every occulter and select the fully dark pixels."""
        frames = self.transit.frames
        places = [f.place for f in self.found] or [frame.place for frame in frames]
        self.found = []
        for n in range(len(frames)):
            progress("finding occulters", n, len(frames))
            self.found.append(
                find_occulter(n, frames, self.scenes.stored, places, psf_kernel, self.transit.noise)
            )
        self.dark = [dark_pixels(frame, found) for frame, found in zip(frames, self.found, strict=True)]

    def left_out(self) -> dict[str, str]:
        """The files that the fit cannot use, with the reason for each."""
        reasons = {}
        for frame, dark, found in zip(self.transit.frames, self.dark, self.found, strict=True):
            at = f"expected an occulter at ({frame.place.x_px:g}, {frame.place.y_px:g}) px"
            if not found.within_reach:
                reasons[frame.file] = f"{at}; found no occulter within {LARGEST_SHIFT_PX:g} px"
            elif not found.seen:
                reasons[frame.file] = (
                    f"{at}; got a depth of {100 * found.depth:.0f} ± {100 * found.depth_sigma:.0f} % of the light that "
                    "an occulter would block"
                )
            elif dark[0].size < LEAST_DARK_PIXELS:
                reasons[frame.file] = (
                    f"expected at least {LEAST_DARK_PIXELS} fully dark pixels; got {dark[0].size}"
                )
        return reasons


def dark_pixels(frame: Frame, found: FoundPlace) -> Pixels:
    """Rows and columns of the pixels that are certainly dark.

    These pixels lie fully within the disc, with a margin for the uncertainty of the disc's position. Pixels that were
    filled in are excluded. If the centre of the disc lies outside the image, no pixel counts as dark.
    """
    shape = (frame.pixels.shape[0], frame.pixels.shape[1])
    place = found.place
    if not (0 <= place.x_px < shape[1] and 0 <= place.y_px < shape[0]):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    unsure = DARK_MARGIN_SIGMAS * max(found.sigma_x_px, found.sigma_y_px)
    dark = fully_dark(shape, place, min(DARK_MARGIN_PX + unsure, LARGEST_DARK_MARGIN_PX))
    if frame.filled is not None:
        dark &= ~frame.filled
    rows, columns = np.nonzero(dark)
    return rows, columns


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A transit reconstructed with one PSF: its scenes, its dark pixels, and the residuals there.

    Attributes
    ----------
    total
        Computation of total PSFs from coordinates.
    optics
        Convolution with the fitted total PSF.
    sky
        Scenes and dark pixels of all images.
    part
        Indices of the images to which the PSF was fitted.
    """

    transit: Transit
    total: TotalPsf
    optics: Optics
    sky: TransitScenes
    part: tuple[int, ...]
    threads: int

    def blanked_scene(self, n: int) -> Lanes:
        """The scene of frame n with the dark pixels of the occulter set to zero, in the engine's order."""
        return self._blanked(n, self.sky.scenes[n])

    def _blanked(self, n: int, scene: Lanes) -> Lanes:
        put(scene, self.sky.dark[n], 0.0)
        return scene

    def twins(self) -> list[Self]:
        """The same for each thread, see `on_threads`."""
        return [replace(self, optics=optics) for optics in self.optics.twins()]

    def residual(self, n: int) -> tuple[Vector, Vector]:
        """Observed minus expected intensity of the dark pixels of image n, r of Eq. (1), and the expected intensity,
        DN/s.
        """
        return self.residual_with_jacobian(n, ())[:2]

    def residual_with_jacobian(
        self, n: int, slopes: Sequence[Blur], scene: Lanes | None = None
    ) -> tuple[Vector, Vector, Matrix]:
        """As `residual`, and the derivatives of the expected intensity, from Eq. (4), (slopes, pixels).

        Parameters
        ----------
        slopes
            Derivatives of the total PSF.
        scene
            The scene of the image, whose dark pixels are set to 0; default: the stored scene.
        """
        if scene is None:
            scene = self.sky.scenes.stored(n).lanes(out=self.optics.fields[0])
        self._blanked(n, scene)
        expected, jacobian = self.optics.light_in(self.sky.dark[n], scene, slopes)
        return self.observed(n) - expected, expected, jacobian

    def observed(self, n: int) -> Vector:
        """The intensity of the dark pixels of image n, DN/s."""
        return self.transit.frames[n].pixels[self.sky.dark[n]].astype(np.float64)

    def weight(self, n: int, expected: Vector) -> Vector:
        """The inverse of the variance of Eq. (3) for the dark pixels of image n with the intensities `expected`
        (DN/s).
        """
        level = np.maximum(expected, LEAST_LEVEL * expected.mean())
        return np.asarray(1 / self.transit.noise.variance(level, self.transit.frames[n].exposure_s))


@dataclass(frozen=True)
class Round:
    """One Gauss-Newton step.

    Attributes
    ----------
    frames
        Number of images.
    moved_points
        Largest change of C(R), in percentage points.
    """

    frames: int
    values: dict[str, float]
    curve_pct: tuple[float, ...]
    moved_points: float
    chi2_per_pixel: float


@dataclass(frozen=True, eq=False)
class FrameFit:
    """The fit of one image: the position of its occulter, and the observed and expected light in the disc.

    Attributes
    ----------
    observed, expected
        Means over the fully dark pixels, DN/s.
    noise
        Standard error of the mean residual, DN/s.
    normal, score
        Matrix and right-hand side that this image adds to the normal equations of the coordinates.
    jacobian
        Derivatives of the expected intensity of each dark pixel with respect to the coordinates, DN/s, (coordinates,
        pixels).
    """

    file: str
    pointing: int
    found: FoundPlace
    dark: Pixels
    observed: float
    expected: float
    noise: float
    chi2: float
    normal: Matrix
    score: Vector
    jacobian: Matrix

    @property
    def mean_jacobian(self) -> Vector:
        """The derivatives of `expected` with respect to the coordinates, DN/s."""
        return np.asarray(self.jacobian.mean(axis=1))

    @property
    def residual_pct(self) -> float:
        """Expected mean minus observed mean, in percent of the observed mean."""
        return 100 * (self.expected - self.observed) / self.observed


@dataclass(frozen=True, eq=False)
class Inversion:
    """The scatter that was fitted to a transit: coordinates with their covariance, and the curve C(R) with its errors.

    Attributes
    ----------
    curve_pct, curve_sigma
        The curve C(R) = 100 (1 - encircled energy) of the total PSF at radii_px, and its standard error. The radii lie
        within the array of TotalPsf.
    covariance
        Covariance matrix of the coordinates; it follows from the photon and read noise of all pixels, propagated
        through the whole fit.
    left_out
        Files that the fit did not use, with the reasons.
    """

    shape: Shape
    coordinates: Vector
    covariance: Matrix
    radii_px: Vector
    curve_pct: Vector
    curve_sigma: Vector
    rounds: tuple[Round, ...]
    converged: bool
    frames: tuple[FrameFit, ...]
    left_out: dict[str, str]

    @property
    def values(self) -> dict[str, float]:
        """The values of the parameters, by name."""
        return self.shape.values(self.coordinates)

    @property
    def value_sigma(self) -> dict[str, float]:
        """The standard errors of the parameters, by name."""
        return self.shape.value_sigma(self.coordinates, self.covariance)

    @property
    def chi2_per_pixel(self) -> float:
        """The chi2 of all dark pixels, divided by the degrees of freedom.

        The result is about 1 if photon and read noise explain the residuals.
        """
        pixels = sum(frame.dark[0].size for frame in self.frames)
        return sum(frame.chi2 for frame in self.frames) / (pixels - self.coordinates.size)


@dataclass(frozen=True, eq=False)
class Solution(Reconstruction):
    """An inversion together with its scenes and optics, for later analyses. part: ordered like inversion.frames."""

    inversion: Inversion
