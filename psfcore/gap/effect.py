"""An effect that the model leaves out: declared once, used to explain a gap.

An effect changes the images, or it changes the PSF; either way only to first order and by a few numbers. An image
error e is seen in the discs through the whole estimate, for the scene is reconstructed from the image that it is in:

    r_D = D [e - H (1 - D) H^-1 e]                          Eq. (1)
    r_D = D [dH (1 - D) x - H (1 - D) G dH (1 - D) x]        Eq. (2)

Eq. (1) for a change of the image, Eq. (2) for a change dH of the PSF. A global gain error is invisible in Eq. (1).
In the lit part only what differs between images of one pointing is seen: an image error as it stands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from psfcore.scatter.inversion import Solution
from psfcore.scatter.optics import Blur, Lanes, pick, put
from psfcore.transit.occulter import coverage, disc_distance, neighbours_of

Field = NDArray[np.float32]
Vector = NDArray[np.float64]
Stage = Literal["scene", "optics", "detector"]
DISC_MARGIN_PX = 2.0
UNDO_STEPS = 1  # beyond the first: a template needs a percent


@dataclass(frozen=True)
class EffectParameter:
    """A number of an effect: its name and unit."""

    name: str
    unit: str


@dataclass(frozen=True, eq=False)
class View:
    """What effects are worked out from: the solution, and the images as the model expects them.

    Expected images, not observed ones: a template made of a pixel's own noise would fit that noise.
    """

    solution: Solution

    @cached_property
    def expected(self) -> list[Field]:
        """Every image as the model sees it [y, x], DN/s."""
        optics = self.solution.optics
        return [optics.field(optics.see(self.lit_scene(n))) for n in range(len(self.solution.transit.frames))]

    @cached_property
    def unocculted(self) -> list[Field]:
        """Every image as observed, with the light put back that its occulter hides [y, x], DN/s."""
        solution = self.solution
        transit, optics = solution.transit, solution.optics
        places = [found.place for found in solution.sky.found]
        out = []
        for n, frame in enumerate(transit.frames):
            seen = frame.pixels
            chosen = neighbours_of(n, transit.frames, places, transit.noise)
            if chosen:
                behind = np.mean([optics.field(solution.sky.scenes[k]) for k in chosen], axis=0)
                hidden = (behind * coverage(transit.shape, places[n])).astype(np.float32)
                seen = seen + optics.field(optics.see(optics.lanes(hidden)))
            out.append(seen)
        return out

    @cached_property
    def lit(self) -> list[Field]:
        """For every image the mean unocculted image of its pointing [y, x], DN/s: what all of them show but for gain.

        The same array for all of a pointing, so that a template made of it differs between them by what is meant.
        """
        fov = [frame.fov for frame in self.solution.transit.frames]
        mean = {
            one: np.mean([u for u, f in zip(self.unocculted, fov, strict=True) if f == one], axis=0)
            for one in set(fov)
        }
        return [mean[f] for f in fov]

    @cached_property
    def _scene_sums(self) -> dict[int, tuple[Vector, Vector]]:
        """Of every pointing the sum of its scenes, each without the pixels round its own disc, and how many count."""
        solution = self.solution
        sums: dict[int, tuple[Vector, Vector]] = {}
        for n, frame in enumerate(solution.transit.frames):
            scene, away = self._own(n)
            total, count = sums.get(frame.fov, (np.zeros(scene.shape), np.zeros(scene.shape)))
            sums[frame.fov] = (total + scene * away, count + away)
        return sums

    def _own(self, n: int) -> tuple[Field, NDArray[np.bool_]]:
        """The scene of frame n, and which pixels are away from its disc."""
        solution = self.solution
        place = solution.sky.found[n].place
        away = disc_distance(solution.transit.shape, place) > place.radius_px + DISC_MARGIN_PX
        return solution.optics.field(solution.sky.scenes[n]), away

    def lit_scene(self, n: int) -> Lanes:
        """The scene of frame n as the other images of its pointing show it, its occulter dark; engine's order.

        A template made of the frame's own scene would hold the noise that its residual holds, and fit it.
        """
        solution = self.solution
        own, away = self._own(n)
        total, count = self._scene_sums[solution.transit.frames[n].fov]
        others = count - away
        mean = np.where(others > 0, (total - own * away) / np.maximum(others, 1), own)
        lit = solution.optics.lanes(mean.astype(np.float32))
        put(lit, solution.sky.dark[n], 0.0)
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

    def in_disc(self, n: int, error: Field) -> Vector:
        """Eq. (1): what an image error leaves in the dark pixels of frame n."""
        optics, dark = self.solution.optics, self.solution.sky.dark[n]
        lanes = optics.lanes(np.ascontiguousarray(error, dtype=np.float32))
        scene = optics.undo(lanes, optics.undo_once(lanes), steps=UNDO_STEPS)
        put(scene, dark, 0.0)
        return pick(lanes, dark) - pick(optics.see(scene), dark)

    def by_psf(self, n: int, slope: Blur, weight: Field | None = None) -> Vector:
        """Eq. (2): what a change of the PSF, times a weight of where the light is from, does to the dark pixels."""
        optics, dark = self.solution.optics, self.solution.sky.dark[n]
        lit = self.lit_scene(n)
        if weight is not None:
            lit *= optics.lanes(weight)
        changed = slope.see(lit)
        scene = optics.undo_once(changed)
        put(scene, dark, 0.0)
        return pick(changed, dark) - pick(optics.see(scene), dark)


@dataclass(frozen=True, eq=False)
class Template:
    """What one unit of one parameter does to a frame.

    disc(n): the change of the dark pixels of frame n. image(n): the change of the image [y, x] in DN/s, for the lit
    part; none where nothing there differs between images of a pointing.
    """

    disc: Callable[[int], Vector]
    image: Callable[[int], Field] | None = None


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect: its physical cause, what would settle it, and the axes along which it shows.

    trials: how many places were looked at for the best, about, which its p-value pays for. templates(view): one a parameter; none where these data cannot show it, for the reason that `why_not` gives.
    """

    name: str
    stage: Stage
    parameters: tuple[EffectParameter, ...]
    cause: str
    settled_by: str
    axes: tuple[str, ...]
    templates: Callable[[View], Sequence[Template]]
    why_not: Callable[[View], str | None] = lambda view: None
    trials: int = 1


def image_template(
    view: View, error: Callable[[int, list[Field]], Field], *, static: bool = False
) -> Template:
    """A template from an image error, a function of a frame's index and of all images as they should be.

    static: the same in all images of a pointing, so that only discs show it.
    """
    return Template(
        disc=lambda n: view.in_disc(n, error(n, view.expected)),
        image=None if static else lambda n: error(n, view.lit),
    )
