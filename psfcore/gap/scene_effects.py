"""Effects of the scene: what lies beyond the field, the occulter's motion, a Sun that changes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter

from psfcore.fourier import Convolver
from psfcore.gap.effect import Change, Effect, EffectParameter, Field, View
from psfcore.transit.occulter import coverage
from psfcore.transit.transit import Place

MOTION_PX = 1.0
STRUCTURE_PX = 16.0


def _beyond_field(view: View) -> Sequence[Change]:
    """The field's mirror image beyond its edges, seen through the PSF."""
    solution = view.solution
    ny, nx = solution.transit.shape
    kernel = solution.total.kernel(solution.inversion.coordinates)
    pad_y, pad_x = ny // 2, nx // 2
    through = Convolver(kernel, (ny + 2 * pad_y, nx + 2 * pad_x), dtype=np.float32, threads=solution.threads)

    def change(n: int, _: Sequence[Field]) -> Field:
        wide = np.pad(view.scenes[n], ((pad_y, pad_y), (pad_x, pad_x)), mode="symmetric")
        wide[pad_y:-pad_y, pad_x:-pad_x] = 0
        return np.asarray(through.apply(wide)[pad_y:-pad_y, pad_x:-pad_x], dtype=np.float32)

    return [Change(change, lit=False)]


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


def _p(name: str, unit: str, likely: float) -> EffectParameter:
    return EffectParameter(name, unit, likely)


EFFECTS: tuple[Effect, ...] = (
    Effect("occulter_motion", "scene", (_p("amount", "", 2.0),), "The occulter moves during an exposure.",
           "shorter exposures", ("radius_in_disc", "azimuth_in_disc"), _motion),
    Effect("out_of_field_light", "scene", (_p("share", "", 0.5),), "The Sun goes on beyond the field and scatters in.",
           "full-Sun images of the same time", ("scattering_distance", "pointing", "intensity"), _beyond_field),
    Effect("scene_evolution", "scene", (_p("drift", "/h", 0.2),), "The Sun changes while the occulter crosses a pointing.",
           "images closer in time", ("time", "pointing"), _evolution),
)  # fmt: skip
