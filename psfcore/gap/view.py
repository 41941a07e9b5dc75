"""The view of a fit from which effects are computed: its scenes, its images and its PSF.

Effects are computed from the model images, not from the observed images. A template that contains the noise of a pixel
would fit this noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Flags, Vector
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.total_psf import Blur, Lanes, put
from psfcore.transit.occulter import coverage, disc_distance, neighbours_of, patch_window
from psfcore.transit.transit import Frame

Field = NDArray[np.float32]
Result = TypeVar("Result")
DISC_MARGIN_PX = 2.0
# Most memory for one kind of field; at least LEAST_KEPT fields are kept, whatever their size.
KEPT_BYTES = 2**25
LEAST_KEPT = 4


class _LazyFields(Sequence[Field]):
    """One field per image, of `images` images. A field is computed when it is first used. Read-only.

    The last computed fields are kept, up to KEPT_BYTES (about thirty images of 512 px), but at least LEAST_KEPT.
    """

    def __init__(self, images: Sequence[Frame], field: Callable[[int], Field]) -> None:
        kept = max(KEPT_BYTES // images[0].pixels.nbytes, LEAST_KEPT)
        self._count, self._field = len(images), lru_cache(kept)(field)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index):  # type: ignore[no-untyped-def]  # the overloads of Sequence
        return self._field(index)


def _of_each_image(field: Callable[[View, int], Field]) -> cached_property[Sequence[Field]]:
    """The fields of all images: the decorated method computes the field of one image."""
    return cached_property(lambda view: _LazyFields(view.solution.transit.frames, partial(field, view)))


@dataclass(frozen=True, eq=False)
class View:
    """The data from which effects are computed: the fit (`solution`), and fields that are derived from the fit."""

    solution: Solution

    @cached_property
    def _results(self) -> dict[str, object]:
        return {}

    def once(self, name: str, compute: Callable[[], Result]) -> Result:
        """The result of `compute` under this name. It is computed once for each view, for example by a search."""
        if name not in self._results:
            self._results[name] = compute()
        return cast(Result, self._results[name])

    @cached_property
    def kernel(self) -> Vector:
        """The total PSF of the solution [y, x]."""
        return self.solution.total.kernel(self.solution.inversion.coordinates)

    @cached_property
    def slope_kernels(self) -> tuple[Vector, ...]:
        """The derivatives [y, x] of the total PSF with respect to each coordinate of the shape."""
        return tuple(self.solution.total.slopes(self.solution.inversion.coordinates))

    @cached_property
    def slopes(self) -> tuple[Blur, ...]:
        """The same derivatives, each prepared for the convolution with fields."""
        solution = self.solution
        return tuple(
            Blur(slope, solution.transit.shape, threads=solution.threads) for slope in self.slope_kernels
        )

    @_of_each_image
    def expected(self, n: int) -> Field:
        """The model image of every image [y, x], DN/s."""
        optics = self.solution.optics
        return optics.field(optics.convolve(self.occulted_scenes[n]))

    def behind(self, n: int) -> Field | None:
        """The scene behind the occulter of image n [y, x], DN/s: the mean scene of the neighbouring images in time.

        None if no neighbouring image shows this part of the scene.
        """
        solution = self.solution
        places = [found.place for found in solution.sky.found]
        chosen = neighbours_of(n, solution.transit.frames, places, solution.transit.noise)
        scenes = [solution.optics.field(solution.sky.scenes[k]) for k in chosen]
        return np.asarray(np.mean(scenes, axis=0), dtype=np.float32) if scenes else None

    @_of_each_image
    def unocculted(self, n: int) -> Field:
        """Every observed image [y, x], DN/s, plus the light that its occulter hides."""
        solution = self.solution
        optics, seen = solution.optics, solution.transit.frames[n].pixels
        behind = self.behind(n)
        if behind is None:
            return seen
        hidden = behind * coverage(solution.transit.shape, solution.sky.found[n].place)
        return seen + optics.field(optics.convolve(optics.lanes(hidden.astype(np.float32))))

    @cached_property
    def pointing_means(self) -> list[Field]:
        """For every image, the mean of `unocculted` over the images of its pointing [y, x], DN/s.

        All images of a pointing share one array. A template made from this array differs between images only if the
        effect itself differs between them.
        """
        pointing = [frame.pointing for frame in self.solution.transit.frames]
        sums = {one: np.zeros(self.solution.transit.shape) for one in pointing}
        for n, one in enumerate(pointing):
            sums[one] += self.unocculted[n]
        means = {one: (total / pointing.count(one)).astype(np.float32) for one, total in sums.items()}
        return [means[one] for one in pointing]

    @cached_property
    def _scene_sums(self) -> dict[int, tuple[Vector, Vector]]:
        """For each pointing: the sum of its scenes, and for each pixel the number of scenes in this sum.

        The pixels around the disc of an image do not count.
        """
        solution = self.solution
        sums: dict[int, tuple[Vector, Vector]] = {}
        for n, frame in enumerate(solution.transit.frames):
            scene, away = self._own(n)
            total, count = sums.get(frame.pointing, (np.zeros(scene.shape), np.zeros(scene.shape)))
            sums[frame.pointing] = (total + scene * away, count + away)
        return sums

    def _own(self, n: int) -> tuple[Field, Flags]:
        """The scene of frame n, and a mask of the pixels away from its disc."""
        solution = self.solution
        place = solution.sky.found[n].place
        away = disc_distance(solution.transit.shape, place) > place.radius_px + DISC_MARGIN_PX
        return solution.optics.field(solution.sky.scenes[n]), away

    def pointing_scene(self, n: int) -> Field:
        """The mean scene of the pointing of frame n [y, x], DN/s. Each image contributes only the pixels away from its
        disc.
        """
        total, count = self._scene_sums[self.solution.transit.frames[n].pointing]
        own, _ = self._own(n)
        return np.asarray(np.where(count > 0, total / np.maximum(count, 1), own), dtype=np.float32)

    @_of_each_image
    def scenes(self, n: int) -> Field:
        """The scene [y, x] of every image, DN/s, without the occulter: the mean scene of the other images of the same
        pointing.

        This mean is scaled to the brightness of the image. A template that is made from the scene of the same image
        would contain the noise of its residual, and would fit this noise.
        """
        own, away = self._own(n)
        total, count = self._scene_sums[self.solution.transit.frames[n].pointing]
        others = count - away
        mean = (total - own * away) / np.maximum(others, 1)
        both = (others > 0) & away
        # Shutter and Sun vary by about one percent. Without this scaling, the template of an effect would have this
        # error.
        light, usual = float(own[both].sum(dtype=np.float64)), float(mean[both].sum())
        brightness = max(light, 0.0) / usual if usual > 0 else 1.0
        return np.asarray(np.where(others > 0, mean * brightness, own), dtype=np.float32)

    def uncovered(self, n: int) -> Field:
        """The fraction of each pixel [y, x] that the occulter of frame n does not cover.

        The fraction is set to 1 where no image of the pointing shows the scene behind the disc. There, `scenes`
        contains the scene of frame n itself, in which the occulter is already dark.
        """
        solution = self.solution
        shape, place = solution.transit.shape, solution.sky.found[n].place
        window = patch_window(shape, place, 1.0)
        shown = self._scene_sums[solution.transit.frames[n].pointing][1][window] > 0
        out = np.ones(shape, np.float32)
        out[window] -= (coverage(shape, place)[window] * shown).astype(np.float32)
        return out

    @_of_each_image
    def occulted_scenes(self, n: int) -> Lanes:
        """The scene of every image with its occulter in front, in the memory order of the convolution engine.
        Read-only.
        """
        scene = self.solution.optics.lanes(self.scenes[n] * self.uncovered(n))
        put(scene, self.solution.sky.dark[n], 0.0)
        return scene

    @cached_property
    def places(self) -> tuple[Field, Field]:
        """The position of each pixel on the detector: x and y [y, x], each from -0.5 to 0.5 across the image."""
        ny, nx = self.solution.transit.shape
        x = ((np.arange(nx) + 0.5) / nx - 0.5).astype(np.float32)
        y = ((np.arange(ny) + 0.5) / ny - 0.5).astype(np.float32)
        return np.broadcast_to(x, (ny, nx)), np.broadcast_to(y[:, None], (ny, nx))

    def exposure_s(self, n: int) -> float:
        """The exposure time of frame n, s."""
        return self.solution.transit.frames[n].exposure_s

    def blurred(self, n: int, slope: Blur, weight: Field | None = None) -> Field:
        """The change of image n by dH: its scene with the occulter in front, convolved with dH (`slope`) [y, x], DN/s.

        Parameters
        ----------
        weight
            A factor [y, x] for the light of each scene pixel before the convolution (None: 1).
        """
        scene = self.occulted_scenes[n]
        if weight is not None:
            scene = scene * slope.lanes(weight)
        return slope.field(slope.convolve(scene))
