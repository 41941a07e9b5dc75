"""A transit reconstructed with one PSF: its scenes, and the light in its discs that the PSF does not explain.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm", steps (d) to (f).
H is the convolution with the total PSF on the field. D selects the fully dark pixels. x = H^-1 y is the scene of an
image y:

    r = D [y - H (1 - D) x]                                           Eq. (1)
    v = variance of photon and read noise at the model's intensity    Eq. (3)
    dr/dq = -D [(dH/dq) (1 - D) x - H (1 - D) G (dH/dq) x]            Eq. (4)

The equations have the same numbers as in `psfcore.scatter.inversion.inversion`.

| symbol | name | unit |
|---|---|---|
| y | frame.pixels | DN/s |
| q | coordinates of the shape's parameters | - |
| D | dark: rows and columns of the fully dark pixels | - |
| G | optics.invert_once: inverse of H | - |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.scatter.optics import Blur, Lanes, Optics, Pixels, pick, put
from psfcore.scatter.shapes import Vector
from psfcore.scatter.total_psf import Kernel, TotalPsf
from psfcore.transit.occulter import LARGEST_SHIFT_PX, FoundPlace, find_occulter, fully_dark
from psfcore.transit.transit import Frame, Transit

Progress = Callable[[str, int, int], None]

DARK_MARGIN_PX = 0.05
DARK_MARGIN_SIGMAS = 1.5
LARGEST_DARK_MARGIN_PX = 2.5
LEAST_DARK_PIXELS = 30
# The variance of a pixel is computed from its expected intensity, but at least from this fraction of the disc's mean.
LEAST_LEVEL = 0.2


class TransitScenes:
    """All images of a transit, with their latest scenes and occulter positions.

    Images and scenes are stored in the memory order of the convolution engine (see `psfcore.scatter.optics`).
    """

    def __init__(self, transit: Transit, optics: Optics, progress: Progress) -> None:
        self.transit = transit
        self.observed: list[Lanes] = []
        self.scenes: list[Lanes] = []
        for n, frame in enumerate(transit.frames):
            progress("reconstructing", n, len(transit.frames))
            self.observed.append(optics.lanes(frame.pixels))
            self.scenes.append(optics.invert(self.observed[-1]))
        self.found: list[FoundPlace] = []
        self.dark: list[Pixels] = []

    @classmethod
    def restored(
        cls,
        transit: Transit,
        optics: Optics,
        *,
        scenes: list[Lanes],
        found: list[FoundPlace],
        dark: list[Pixels],
    ) -> TransitScenes:
        """The scenes of an earlier reconstruction of a transit. optics: used only for the memory order of the engine."""
        sky = cls.__new__(cls)
        sky.transit, sky.scenes, sky.found, sky.dark = transit, scenes, found, dark
        sky.observed = [optics.lanes(frame.pixels) for frame in transit.frames]
        return sky

    def copy(self) -> TransitScenes:
        """A second object with the same contents. Arrays are shared, because no code writes to them."""
        other = copy(self)
        other.scenes, other.found, other.dark = list(self.scenes), list(self.found), list(self.dark)
        return other

    def find(
        self,
        optics: Optics,
        psf_kernel: Kernel,
        progress: Progress = lambda stage, step, steps: None,
    ) -> None:
        """Step (e): locate every occulter and select the fully dark pixels."""
        frames = self.transit.frames
        scenes = _SceneFields(self.scenes, optics)
        places = [f.place for f in self.found] or [frame.place for frame in frames]
        self.found = []
        for n in range(len(frames)):
            progress("finding occulters", n, len(frames))
            self.found.append(find_occulter(n, frames, scenes, places, psf_kernel, self.transit.noise))
        self.dark = [dark_pixels(frame, found) for frame, found in zip(frames, self.found, strict=True)]

    def left_out(self) -> dict[str, str]:
        """The files that the fit cannot use, with the reason for each."""
        reasons = {}
        for frame, dark, found in zip(self.transit.frames, self.dark, self.found, strict=True):
            if not found.within_reach:
                reasons[frame.file] = (
                    f"expected an occulter at ({frame.place.x_px:g}, {frame.place.y_px:g}) px; "
                    f"found no occulter within {LARGEST_SHIFT_PX:g} px"
                )
            elif not found.seen:
                reasons[frame.file] = (
                    f"expected an occulter at ({frame.place.x_px:g}, {frame.place.y_px:g}) px; "
                    f"got a depth of {100 * found.depth:.0f} ± {100 * found.depth_sigma:.0f} % of the light that "
                    "an occulter would block"
                )
            elif dark[0].size < LEAST_DARK_PIXELS:
                reasons[frame.file] = (
                    f"expected at least {LEAST_DARK_PIXELS} fully dark pixels; got {dark[0].size}"
                )
        return reasons


class _SceneFields(Sequence[NDArray[np.float32]]):
    """Scenes as fields [y, x]. A scene is rearranged from the engine's order only when it is read."""

    def __init__(self, lanes: Sequence[Lanes], optics: Optics) -> None:
        self._lanes, self._optics = lanes, optics
        self._last: dict[int, NDArray[np.float32]] = {}

    def __len__(self) -> int:
        return len(self._lanes)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        if index not in self._last:
            if len(self._last) > 12:
                self._last.pop(next(iter(self._last)))
            self._last[index] = self._optics.field(self._lanes[index])
        return self._last[index]


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

    total: computes total PSFs. optics: convolution with the fitted total PSF. sky: scenes and dark pixels of all images.
    part: indices of the images to which the PSF was fitted.
    """

    transit: Transit
    total: TotalPsf
    optics: Optics
    sky: TransitScenes
    part: tuple[int, ...]
    threads: int

    def blanked_scene(self, n: int) -> Lanes:
        """The scene of frame n with the dark pixels of the occulter set to zero, in the engine's order."""
        scene = self.sky.scenes[n].copy()
        put(scene, self.sky.dark[n], 0.0)
        return scene

    def residual(self, n: int) -> tuple[Vector, Vector]:
        """r of Eq. (1) for the dark pixels of image n, and the expected intensity of these pixels, DN/s."""
        expected = pick(self.optics.convolve(self.blanked_scene(n)), self.sky.dark[n])
        return pick(self.sky.observed[n], self.sky.dark[n]) - expected, expected

    def weight(self, n: int, expected: Vector) -> Vector:
        """The inverse of the variance of Eq. (3) for pixels of image n with the intensities `expected` (DN/s)."""
        return pixel_weight(self.transit, n, expected)

    def jacobian(self, n: int, slope: Blur) -> Vector:
        """The derivative of the expected light in the dark pixels of image n, from Eq. (4). slope: derivative of the total PSF."""
        return jacobian_row(self.optics, slope, self.blanked_scene(n), self.sky.dark[n])


def pixel_weight(transit: Transit, n: int, expected: Vector) -> Vector:
    """1 / variance (Eq. (3)) of each dark pixel of image n. expected: the expected intensities of these pixels,
    DN/s."""
    level = np.maximum(expected, LEAST_LEVEL * expected.mean())
    return np.asarray(1 / transit.noise.variance(level, transit.frames[n].exposure_s))


def jacobian_row(optics: Optics, slope: Blur, blanked: Lanes, dark: Pixels) -> Vector:
    """The derivative of the expected light in the dark pixels with respect to one coordinate: minus Eq. (4)."""
    changed = slope.convolve(blanked)
    scene = optics.invert_once(changed)
    put(scene, dark, 0.0)
    return pick(changed, dark) - pick(optics.convolve(scene), dark)
