"""An effect that the model leaves out: declared once, used to explain a gap and to correct for it.

An effect is a change of the images, to first order and by a few numbers: e(n) for one unit of a parameter, in image n,
DN/s. What changes the optics changes the images by dH x, H the PSF and x the scene as it is lit. The discs show a
change through the whole estimate (`cells`), for the scene is reconstructed from the image that it is in. In the lit
part only what differs between images of one pointing is seen, as it stands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from psfcore.scatter.inversion import Solution
from psfcore.scatter.optics import Blur, Lanes, put
from psfcore.transit.occulter import coverage, disc_distance, neighbours_of, patch_window

Field = NDArray[np.float32]
Vector = NDArray[np.float64]
Stage = Literal["scene", "optics", "detector"]
DISC_MARGIN_PX = 2.0
KEPT_BYTES = 2**25  # of one kind of field; a few fields are kept however large they are
LEAST_KEPT = 4


@dataclass(frozen=True)
class EffectParameter:
    """A number of an effect: its name, its unit, and how large it may well be; ten times that is hardly believed.

    positive: whether it can be nothing else, as a share of light.
    """

    name: str
    unit: str
    likely: float
    positive: bool = False


class _Fields(Sequence[Field]):
    """Fields of all images, worked out where asked for; those of thirty images of 512 px are kept, of larger ones the last.

    Nobody writes to them.
    """

    def __init__(self, count: int, field: Callable[[int], Field]) -> None:
        self._count, self._field = count, field
        self._kept: dict[int, Field] = {}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        if index not in self._kept:
            field = self._field(index)
            if (len(self._kept) + 1) * field.nbytes > KEPT_BYTES and len(self._kept) >= LEAST_KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[index] = field
        return self._kept[index]


@dataclass(frozen=True, eq=False)
class View:
    """What effects are worked out from: the solution, and the images as the model expects them.

    Expected images, not observed ones: a template made of a pixel's own noise would fit that noise.
    """

    solution: Solution

    @cached_property
    def kept(self) -> dict[type, Any]:
        """What is worked out about it once, by its kind: searches."""
        return {}

    @cached_property
    def kernel(self) -> Vector:
        """The solution's total PSF [y, x]."""
        return self.solution.total.kernel(self.solution.inversion.coordinates)

    @cached_property
    def slope_kernels(self) -> tuple[Vector, ...]:
        """How it changes with each coordinate of its shape [y, x]."""
        return tuple(self.solution.total.slopes(self.solution.inversion.coordinates))

    @cached_property
    def slopes(self) -> tuple[Blur, ...]:
        """The same, to be applied to fields."""
        solution = self.solution
        return tuple(
            Blur(slope, solution.transit.shape, threads=solution.threads) for slope in self.slope_kernels
        )

    @cached_property
    def expected(self) -> Sequence[Field]:
        """Every image as the model sees it [y, x], DN/s."""
        optics = self.solution.optics
        return _Fields(
            len(self.solution.transit.frames), lambda n: optics.field(optics.see(self.lit_scene(n)))
        )

    def behind(self, n: int) -> Field | None:
        """The scene that the occulter of image n hides, as neighbours in time show it; none where none does."""
        solution = self.solution
        places = [found.place for found in solution.sky.found]
        chosen = neighbours_of(n, solution.transit.frames, places, solution.transit.noise)
        if not chosen:
            return None
        return np.asarray(
            np.mean([solution.optics.field(solution.sky.scenes[k]) for k in chosen], axis=0), dtype=np.float32
        )

    @cached_property
    def unocculted(self) -> Sequence[Field]:
        """Every image as observed, with the light put back that its occulter hides [y, x], DN/s."""
        return _Fields(len(self.solution.transit.frames), self._put_back)

    def _put_back(self, n: int) -> Field:
        solution = self.solution
        optics, seen = solution.optics, solution.transit.frames[n].pixels
        behind = self.behind(n)
        if behind is None:
            return seen
        hidden = behind * coverage(solution.transit.shape, solution.sky.found[n].place)
        return seen + optics.field(optics.see(optics.lanes(hidden.astype(np.float32))))

    @cached_property
    def lit(self) -> list[Field]:
        """For every image the mean unocculted image of its pointing [y, x], DN/s: what all of them show but for gain.

        The same array for all of a pointing, so that a template made of it differs between them by what is meant.
        """
        pointing = [frame.pointing for frame in self.solution.transit.frames]
        mean: dict[int, Field] = {}
        for one in sorted(set(pointing)):
            images = [n for n, f in enumerate(pointing) if f == one]
            total = np.zeros(self.solution.transit.shape)
            for n in images:
                total += self.unocculted[n]
            mean[one] = (total / len(images)).astype(np.float32)
        return [mean[f] for f in pointing]

    @cached_property
    def _scene_sums(self) -> dict[int, tuple[Vector, Vector]]:
        """Of every pointing the sum of its scenes, each without the pixels round its own disc, and how many count."""
        solution = self.solution
        sums: dict[int, tuple[Vector, Vector]] = {}
        for n, frame in enumerate(solution.transit.frames):
            scene, away = self._own(n)
            total, count = sums.get(frame.pointing, (np.zeros(scene.shape), np.zeros(scene.shape)))
            sums[frame.pointing] = (total + scene * away, count + away)
        return sums

    def _own(self, n: int) -> tuple[Field, NDArray[np.bool_]]:
        """The scene of frame n, and which pixels are away from its disc."""
        solution = self.solution
        place = solution.sky.found[n].place
        away = disc_distance(solution.transit.shape, place) > place.radius_px + DISC_MARGIN_PX
        return solution.optics.field(solution.sky.scenes[n]), away

    def pointing_scene(self, n: int) -> Field:
        """The scene of frame n's pointing as all its images show it, each without its own disc [y, x], DN/s."""
        total, count = self._scene_sums[self.solution.transit.frames[n].pointing]
        own, _ = self._own(n)
        return np.asarray(np.where(count > 0, total / np.maximum(count, 1), own), dtype=np.float32)

    @cached_property
    def scenes(self) -> Sequence[Field]:
        """The scene of every image as the others of its pointing show it, as bright as its own, nothing hidden [y, x],
        DN/s.

        A template made of the image's own scene would hold the noise that its residual holds, and fit it.
        """
        return _Fields(len(self.solution.transit.frames), self._scene)

    def _scene(self, n: int) -> Field:
        own, away = self._own(n)
        total, count = self._scene_sums[self.solution.transit.frames[n].pointing]
        others = count - away
        mean = (total - own * away) / np.maximum(others, 1)
        both = (others > 0) & away
        # Shutter and Sun are not steady to a percent: a copy of another image's light would leave that of what it adds.
        brightness = _ratio(float(own[both].sum(dtype=np.float64)), float(mean[both].sum()))
        return np.asarray(np.where(others > 0, mean * brightness, own), dtype=np.float32)

    def uncovered(self, n: int) -> Field:
        """Share of each pixel [y, x] that frame n's occulter leaves open.

        One where no other image shows the scene: there it is the image's own, and hidden already.
        """
        solution = self.solution
        shape, place = solution.transit.shape, solution.sky.found[n].place
        window = patch_window(shape, place, 1.0)
        shown = self._scene_sums[solution.transit.frames[n].pointing][1][window] > 0
        out = np.ones(shape, np.float32)
        out[window] -= (coverage(shape, place)[window] * shown).astype(np.float32)
        return out

    def lit_scene(self, n: int) -> Lanes:
        """One of `scenes` less what the occulter hides of it, in the engine's order; to be read alone."""
        return self._lit_scenes[n]

    @cached_property
    def _lit_scenes(self) -> Sequence[Lanes]:
        return _Fields(len(self.solution.transit.frames), self._lit_scene)

    def _lit_scene(self, n: int) -> Lanes:
        lit = self.solution.optics.lanes(self.scenes[n] * self.uncovered(n))
        put(lit, self.solution.sky.dark[n], 0.0)
        return lit

    @cached_property
    def places(self) -> tuple[Field, Field]:
        """Detector x and y of each pixel, -0.5 to 0.5 across the field."""
        ny, nx = self.solution.transit.shape
        x = ((np.arange(nx) + 0.5) / nx - 0.5).astype(np.float32)
        y = ((np.arange(ny) + 0.5) / ny - 0.5).astype(np.float32)
        return np.broadcast_to(x, (ny, nx)), np.broadcast_to(y[:, None], (ny, nx))

    def exposure_s(self, n: int) -> float:
        """Of frame n."""
        return self.solution.transit.frames[n].exposure_s

    def blurred(self, n: int, slope: Blur, weight: Field | None = None) -> Field:
        """dH x of frame n, the scene times a weight of where its light is from [y, x], DN/s."""
        lit = self.lit_scene(n)
        if weight is not None:
            lit = lit * slope.lanes(weight)
        return slope.field(slope.see(lit))


def _ratio(one: float, other: float) -> float:
    """Of sums of light; one where there is none to compare with."""
    return max(one, 0.0) / other if other > 0 else 1.0


@dataclass(frozen=True, eq=False)
class Change:
    """What one unit of one parameter does: change(n, images) to image n [y, x] in DN/s.

    images: all images as they should be, each as bright as it is, or, for the lit part, their pointings' means. lit:
    whether it differs between images of one pointing where these are compared, so that the lit part shows it. disc:
    whether the discs do. numbers: how many numbers of its own were taken from the lit parts to make it, which its gain
    pays for.
    """

    change: Callable[[int, Sequence[Field]], Field]
    lit: bool = True
    disc: bool = True
    numbers: int = 0


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect: its physical cause, what would settle it, and the axes along which it shows.

    changes(view): one a parameter; where there are fewer or more, as of what is fitted by pointing, the first ones'.
    why_not(view): why these data cannot show it, or None. trials: how many places were looked at for the best, about,
    which its gain pays for. named: whether it may be an answer; if not, it is a probe: a form that gaps of unknown cause
    have, which says that the cause is not in the library. held(view): of an effect that searches for a place, the same
    with that place held. field: whether its parameters are those of a random field, each about as large as is likely:
    its gain pays for what was learned of them, not for how many they are.
    """

    name: str
    stage: Stage
    parameters: tuple[EffectParameter, ...]
    cause: str
    settled_by: str
    axes: tuple[str, ...]
    changes: Callable[[View], Sequence[Change]]
    why_not: Callable[[View], str | None] = lambda view: None
    trials: int = 1
    named: bool = True
    held: Callable[[View], Effect] | None = None
    field: bool = False
