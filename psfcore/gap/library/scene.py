"""Effects of the scene: light from outside the field, motion of the occulter, and changes of the Sun."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.gap.effect import Change, Effect
from psfcore.gap.effect import EffectParameter as Parameter
from psfcore.gap.evidence.search import coarse_kernel
from psfcore.gap.evidence.tree import SUN
from psfcore.gap.evidence.unocculted_blocks import block_means
from psfcore.gap.view import Field, View
from psfcore.transit.occulter import coverage
from psfcore.transit.transit import Place

# Lengths of the track in the longest exposure. There are two, because the change is not proportional to the length.
MOTIONS_PX = (1.0, 5.0)
MOTION_PARTS = 5  # number of parts into which an exposure is divided
LEAST_TO_EVOLVE = 5
COARSE_PX = 4
SIDES = ("left", "right", "bottom", "top")
MOST_POINTINGS = 8  # light from outside the field is tested for this number of pointings


def _beyond_field(view: View) -> Sequence[Change]:
    """Light from beyond each edge of the field: the mirror image of the scene there, convolved with the PSF.

    The light that scatters into the field from there is smooth, except in the outermost pixels. It is therefore computed on
    coarse pixels.
    """
    solution = view.solution
    ny, nx = (-(-n // COARSE_PX) for n in solution.transit.shape)
    pad_y, pad_x = ny // 2, nx // 2
    kernel = coarse_kernel(view.kernel, COARSE_PX)
    through = Convolver(kernel, (ny + 2 * pad_y, nx + 2 * pad_x), dtype=np.float32, threads=solution.threads)
    y, x = np.indices((ny + 2 * pad_y, nx + 2 * pad_x))
    low_y, high_y, low_x, high_x = y < pad_y, y >= pad_y + ny, x < pad_x, x >= pad_x + nx
    # The left and the right side include the corners, so that the four sides cover the whole surroundings of the field.
    sides = (low_x, high_x, low_y & ~low_x & ~high_x, high_y & ~low_x & ~high_x)

    def light(n: int, images: Sequence[Field], here: Sequence[int], side: NDArray[np.bool_]) -> Field:
        if n not in here:
            return np.zeros(solution.transit.shape, np.float32)
        scene = np.pad(_coarse(view.scenes[n]), ((pad_y, pad_y), (pad_x, pad_x)), mode="symmetric") * side
        seen = through.apply(scene.astype(np.float32))[pad_y : pad_y + ny, pad_x : pad_x + nx]
        return _on_pixels(seen, solution.transit.shape)

    # The surroundings differ between pointings, so each pointing has separate parameters.
    pointings = list(_images_of_pointings(view).values())[:MOST_POINTINGS]
    return [
        Change(partial(light, here=here, side=side), unocculted=False) for here in pointings for side in sides
    ]


def _coarse(plane: NDArray[np.floating]) -> NDArray[np.float64]:
    """The means of a plane over squares of COARSE_PX px. Squares that reach beyond the edge are filled with the pixels of the edge."""
    ny, nx = plane.shape
    return block_means(np.pad(plane, ((0, -ny % COARSE_PX), (0, -nx % COARSE_PX)), mode="edge"), COARSE_PX)


def _on_pixels(plane: NDArray[np.floating], shape: tuple[int, int]) -> Field:
    """A plane on coarse pixels, expanded to the pixels of the images. shape: of the images."""
    fine = np.repeat(np.repeat(plane, COARSE_PX, axis=0), COARSE_PX, axis=1)
    return np.asarray(fine[: shape[0], : shape[1]], dtype=np.float32)


def _motion(view: View) -> Sequence[Change]:
    """The change of the images if the disc moves along its track during an exposure, so that its edge is blurred."""
    solution = view.solution
    frames, optics, shape = solution.transit.frames, solution.optics, solution.transit.shape
    places = [found.place for found in solution.sky.found]
    longest = max(frame.exposure_s for frame in frames)

    def blur(n: int, images: Sequence[Field], longest_px: float) -> Field:
        near = [k for k, f in enumerate(frames) if f.pointing == frames[n].pointing and k != n]
        hidden = view.behind(n)
        if not near or hidden is None:
            return np.zeros(shape, np.float32)
        here, other = places[n], places[min(near, key=lambda k: abs(frames[k].time_s - frames[n].time_s))]
        dx, dy = other.x_px - here.x_px, other.y_px - here.y_px
        reach = longest_px * frames[n].exposure_s / longest / max(float(np.hypot(dx, dy)), 1e-9)
        parts = reach * ((np.arange(MOTION_PARTS) + 0.5) / MOTION_PARTS - 0.5)
        along = (
            coverage(shape, Place(here.x_px + s * dx, here.y_px + s * dy, here.radius_px)) for s in parts
        )
        lost = (sum(along) / MOTION_PARTS - coverage(shape, here)) * hidden
        return optics.field(optics.convolve(optics.lanes((-lost).astype(np.float32))))

    return [Change(partial(blur, longest_px=px), unocculted=False) for px in MOTIONS_PX]


def _images_of_pointings(view: View) -> dict[int, list[int]]:
    """The numbers of the images of each pointing."""
    frames = view.solution.transit.frames
    return {
        pointing: [n for n, frame in enumerate(frames) if frame.pointing == pointing]
        for pointing in sorted({frame.pointing for frame in frames})
    }


def _too_few_to_evolve(view: View) -> str | None:
    most = max(len(images) for images in _images_of_pointings(view).values())
    if most >= LEAST_TO_EVOLVE:
        return None
    return f"this effect needs a pointing with {LEAST_TO_EVOLVE} images; the largest pointing has {most}"


EFFECTS: tuple[Effect, ...] = (
    Effect("occulter_motion", "scene",
           (Parameter("short_tracks", "", 4.0, True), Parameter("long_tracks", "", 1.0, True)), "The occulter moves during an exposure.",
           "shorter exposures", ("radius_in_disc", "azimuth_in_disc"), _motion, family="edge"),
    Effect("out_of_field_light", "scene", tuple(Parameter(f"{side}_{k}", "", 0.5, True) for k in range(1, MOST_POINTINGS + 1) for side in SIDES),
           "Light from the Sun outside the field scatters into the field.",
           "full-Sun images taken at the same time", ("scattering_distance", "pointing", "intensity"), _beyond_field, family="outside"),
    # The Sun changes by a random field, which has no template: `evidence.closed_form` eliminates it block by block.
    Effect(SUN, "scene", (), "The Sun changes while the occulter crosses the field of a pointing.",
           "images that are closer together in time, or the first pointing again at the end", ("time", "pointing"), lambda view: (), _too_few_to_evolve, family="sun"),
)  # fmt: skip
