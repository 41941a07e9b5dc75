"""Effects of the scene: light from outside the field, motion of the occulter, and changes of the Sun."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from psfcore.convolution.convolver import Convolver
from psfcore.gap.effect import Change, Effect
from psfcore.gap.effect import EffectParameter as Parameter
from psfcore.gap.evidence.search import coarse_kernel
from psfcore.gap.evidence.unocculted_blocks import block_means, blocks, not_compared
from psfcore.gap.view import Field, View
from psfcore.transit.occulter import coverage
from psfcore.transit.transit import Place

Planes = NDArray[np.float64]

# Lengths of the track in the longest exposure. There are two, because the change is not proportional to the length.
MOTIONS_PX = (1.0, 5.0)
MOTION_PARTS = 5  # number of parts into which an exposure is divided
STRUCTURE_PX = 6.0
LEAST_TO_EVOLVE = 5
MOST_TERMS = 4
RIDGE = 1e-3  # in units of the weight of one image: damps pixels that few images show
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


def _evolution(view: View) -> Sequence[Change]:
    """The changes of the Sun within each pointing, measured in the unocculted field. Each is scaled to a relative rms of 1.

    Two changes: the part that is linear in time, and the other part that is smooth in time. The discs do not show these
    changes, because the scene of each image is reconstructed from the image itself.
    """
    evolving = [
        _Evolving.measured(view, images)
        for images in _images_of_pointings(view).values()
        if len(images) >= LEAST_TO_EVOLVE
    ]
    shape = view.solution.transit.shape
    nothing = np.zeros(shape, np.float32)

    def one(terms: slice) -> Change:
        planes = {n: plane for part in evolving for n, plane in part.planes(terms).items()}
        relative = [np.mean(planes[n] ** 2) / part.level**2 for part in evolving for n in part.images]
        rms = max(float(np.sqrt(np.mean(relative))), 1e-9)
        return Change(
            lambda n, _: _on_pixels(planes[n] / rms, shape) if n in planes else nothing,
            disc=False,
            numbers=sum(part.numbers(terms) for part in evolving),
        )

    return [one(slice(1, 2)), one(slice(2, None))]


def _images_of_pointings(view: View) -> dict[int, list[int]]:
    """The numbers of the images of each pointing."""
    frames = view.solution.transit.frames
    return {
        pointing: [n for n, frame in enumerate(frames) if frame.pointing == pointing]
        for pointing in sorted({frame.pointing for frame in frames})
    }


@dataclass(frozen=True, eq=False)
class _Evolving:
    """The change of the Sun in one pointing, on coarse pixels: a sum of maps times polynomials in time.

    basis: the polynomials (images, terms). terms: the maps (terms, y, x), DN/s. level: the mean of the mean image of the
    pointing, DN/s. free: for each block, the number of images that show it (blocks,).
    """

    images: Sequence[int]
    basis: NDArray[np.float64]
    terms: Planes
    level: float
    free: NDArray[np.int64]

    @staticmethod
    def measured(view: View, images: Sequence[int]) -> _Evolving:
        """The change that is fitted to these images, in the pixels that can be compared."""
        time_s = np.array([view.solution.transit.frames[n].time_s for n in images])
        at = 2 * (time_s - time_s[0]) / max(float(time_s[-1] - time_s[0]), 1e-9) - 1
        basis = np.polynomial.legendre.legvander(at, min(MOST_TERMS, len(images) // 2))
        hidden = [not_compared(view.solution, n).astype(np.float64) for n in images]
        weight = np.array([_coarse(one) == 0 for one in hidden], dtype=np.float64)
        seen = np.array([_coarse(view.unocculted[n]) for n in images])

        def mean() -> NDArray[np.float64]:
            return np.asarray((seen * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1))

        # The brightness of a whole image is not a change of the Sun's structure.
        level = mean()
        for one, use in zip(seen, weight > 0, strict=True):
            if use.any():
                one /= one[use].sum() / max(float(level[use].sum()), 1e-9)
        level = mean()
        normal = np.einsum("nk,nyx,nl->yxkl", basis, weight, basis) + RIDGE * np.eye(basis.shape[1])
        score = np.einsum("nk,nyx->yxk", basis, weight * (seen - level))
        terms = np.moveaxis(np.linalg.solve(normal, score[..., None])[..., 0], -1, 0)
        return _Evolving(
            images=images,
            basis=basis,
            terms=np.array([gaussian_filter(plane, STRUCTURE_PX / COARSE_PX) for plane in terms]),
            level=max(float(level.mean()), 1e-9),
            free=np.sum([blocks(one) == 0 for one in hidden], axis=0),
        )

    def planes(self, terms: slice) -> dict[int, Planes]:
        """For each image, by its number: the change of the scene that these terms describe [y, x], DN/s."""
        # The mean over time belongs to the scene, not to its change.
        basis = self.basis[:, terms] - self.basis[:, terms].mean(axis=0)
        return dict(zip(self.images, np.tensordot(basis, self.terms[terms], axes=1), strict=True))

    def numbers(self, terms: slice) -> int:
        """How many values were measured in all blocks for these terms.

        In each block, at most as many values count as images show this block.
        """
        last = np.minimum(self.basis.shape[1] if terms.stop is None else terms.stop, self.free)
        return int(np.maximum(last - terms.start, 0).sum())


def _too_few_to_evolve(view: View) -> str | None:
    most = max(len(images) for images in _images_of_pointings(view).values())
    if most >= LEAST_TO_EVOLVE:
        return None
    return f"this effect needs a pointing with {LEAST_TO_EVOLVE} images; the largest pointing has {most}"


EFFECTS: tuple[Effect, ...] = (
    Effect("occulter_motion", "scene",
           (Parameter("short_tracks", "", 4.0, True), Parameter("long_tracks", "", 1.0, True)), "The occulter moves during an exposure.",
           "shorter exposures", ("radius_in_disc", "azimuth_in_disc"), _motion),
    Effect("out_of_field_light", "scene", tuple(Parameter(f"{side}_{k}", "", 0.5, True) for k in range(1, MOST_POINTINGS + 1) for side in SIDES),
           "Light from the Sun outside the field scatters into the field.",
           "full-Sun images taken at the same time", ("scattering_distance", "pointing", "intensity"), _beyond_field),
    Effect("scene_evolution", "scene", (Parameter("rms", "", 0.3, True), Parameter("rms_uneven", "", 0.3, True)), "The Sun changes while the occulter crosses the field of a pointing.",
           "images that are closer together in time", ("time", "pointing"), _evolution, _too_few_to_evolve),
)  # fmt: skip
