"""Effects of the scene: what lies beyond the field, the occulter's motion, a Sun that changes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from psfcore.fourier import Convolver
from psfcore.gap.effect import Change, Effect, EffectParameter, Field, View
from psfcore.transit.occulter import coverage
from psfcore.transit.transit import Place

MOTION_PX = 1.0
STRUCTURE_PX = 16.0
COARSE_PX = 4


def _beyond_field(view: View) -> Sequence[Change]:
    """The field's mirror image beyond each of its edges, seen through the PSF.

    What gets in from there is smooth but for the outermost pixels: worked out on coarse pixels.
    """
    solution = view.solution
    ny, nx = (-(-n // COARSE_PX) for n in solution.transit.shape)
    pad_y, pad_x = ny // 2, nx // 2
    kernel = _coarse_kernel(solution.total.kernel(solution.inversion.coordinates))
    through = Convolver(kernel, (ny + 2 * pad_y, nx + 2 * pad_x), dtype=np.float32, threads=solution.threads)
    y, x = np.indices((ny + 2 * pad_y, nx + 2 * pad_x))
    low_y, high_y, low_x, high_x = y < pad_y, y >= pad_y + ny, x < pad_x, x >= pad_x + nx
    # A corner belongs to the side: the sides share all that is beyond the field.
    sides = (low_x, high_x, low_y & ~low_x & ~high_x, high_y & ~low_x & ~high_x)

    def change(n: int, side: NDArray[np.bool_]) -> Field:
        scene = _coarse(view.scenes[n])
        wide = np.pad(scene, ((pad_y, pad_y), (pad_x, pad_x)), mode="symmetric") * side
        seen = through.apply(wide.astype(np.float32))[pad_y : pad_y + ny, pad_x : pad_x + nx]
        fine = np.repeat(np.repeat(seen, COARSE_PX, axis=0), COARSE_PX, axis=1)
        rows, columns = solution.transit.shape
        return np.asarray(fine[:rows, :columns], dtype=np.float32)

    return [Change(lambda n, _, side=side: change(n, side), lit=False) for side in sides]  # type: ignore[misc]


def _coarse(plane: Field) -> Field:
    """Means of squares of COARSE_PX; the last ones are made whole with their own edge."""
    ny, nx = plane.shape
    whole = np.pad(plane, ((0, -ny % COARSE_PX), (0, -nx % COARSE_PX)), mode="edge")
    rows, columns = (n // COARSE_PX for n in whole.shape)
    return np.asarray(whole.reshape(rows, COARSE_PX, columns, COARSE_PX).mean(axis=(1, 3)))


def _coarse_kernel(kernel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Light by displacement in coarse pixels, the middle of the kernel in the middle of one: sums of squares."""
    middle = kernel.shape[0] // 2
    reach = (middle + COARSE_PX // 2) // COARSE_PX
    at = (np.arange(kernel.shape[0]) - middle + COARSE_PX // 2) // COARSE_PX + reach
    out = np.zeros((2 * reach + 1,) * 2)
    keep = at <= 2 * reach
    np.add.at(out, np.ix_(at[keep], at[keep]), kernel[np.ix_(keep, keep)])
    return out


def _motion(view: View) -> Sequence[Change]:
    """The disc drawn out along its track: light where it was dark for a part of the exposure, and the other way."""
    solution = view.solution
    frames = solution.transit.frames
    places = [found.place for found in solution.sky.found]
    longest = max(frame.exposure_s for frame in frames)
    shape = solution.transit.shape

    def change(n: int, _: Sequence[Field]) -> Field:
        near = [k for k, f in enumerate(frames) if f.fov == frames[n].fov and k != n]
        hidden = view.behind(n)
        if not near or hidden is None:
            return np.zeros(shape, np.float32)
        other = min(near, key=lambda k: abs(frames[k].time_s - frames[n].time_s))
        dx, dy = places[other].x_px - places[n].x_px, places[other].y_px - places[n].y_px
        reach = MOTION_PX * frames[n].exposure_s / longest / max(float(np.hypot(dx, dy)), 1e-9)
        here = places[n]
        ahead, behind = (
            coverage(shape, Place(here.x_px + s * reach * dx, here.y_px + s * reach * dy, here.radius_px))
            for s in (0.5, -0.5)
        )
        lost = ((ahead + behind) / 2 - coverage(shape, here)) * hidden
        optics = solution.optics
        return optics.field(optics.see(optics.lanes((-lost).astype(np.float32))))

    return [Change(change, lit=False)]


def _evolution(view: View) -> Sequence[Change]:
    """The scene of a pointing brightening or fading evenly in its structure: the image's own contrast drifts."""
    frames = view.solution.transit.frames
    middle = {
        fov: float(np.mean([f.time_s for f in frames if f.fov == fov])) for fov in {f.fov for f in frames}
    }

    def change(n: int, images: Sequence[Field]) -> Field:
        hours = np.float32((frames[n].time_s - middle[frames[n].fov]) / 3600)
        return np.asarray((images[n] - gaussian_filter(images[n], STRUCTURE_PX)) * hours)

    return [Change(change)]


def _p(name: str, unit: str, likely: float, positive: bool = False) -> EffectParameter:
    return EffectParameter(name, unit, likely, positive)


EFFECTS: tuple[Effect, ...] = (
    Effect("occulter_motion", "scene", (_p("amount", "", 2.0, True),), "The occulter moves during an exposure.",
           "shorter exposures", ("radius_in_disc", "azimuth_in_disc"), _motion),
    Effect("out_of_field_light", "scene", tuple(_p(side, "", 0.5, True) for side in ("left", "right", "bottom", "top")),
           "The Sun goes on beyond the field and scatters in.",
           "full-Sun images of the same time", ("scattering_distance", "pointing", "intensity"), _beyond_field),
    Effect("scene_evolution", "scene", (_p("drift", "/h", 0.2),), "The Sun changes while the occulter crosses a pointing.",
           "images closer in time", ("time", "pointing"), _evolution),
)  # fmt: skip
