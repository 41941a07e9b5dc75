"""The effects that are tried. To add one, add it here: nothing else is touched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter, rotate

from psfcore.fourier import Convolver
from psfcore.gap.effect import Effect, EffectParameter, Field, Template, View, image_template
from psfcore.scatter.optics import Blur
from psfcore.scatter.published import crop_or_pad
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.occulter import coverage, neighbours_of
from psfcore.transit.transit import Place

Kernel = NDArray[np.float64]
FAINT_DN = 60.0
GHOST_BLUR_PX = 8.0
GHOST_STEP_PX = 8
GHOST_NEAREST_PX = 40.0
GHOST_TRIALS = 1000  # a field of 512 px holds about that many copies that differ
ROTATION_DEG = 0.5
PITCH_SHARE = 0.005
MOTION_PX = 1.0


def _unit(view: View) -> Field:
    return np.ones(view.solution.transit.shape, np.float32)


def _dark_offset(view: View) -> Sequence[Template]:
    one = _unit(view)
    return [image_template(view, lambda n, _: one / np.float32(view.exposure_s(n)))]


def _gradient(view: View) -> Sequence[Template]:
    x, y = view.places
    return [_fixed(view, plane) for plane in (_unit(view), x, y)]


def _fixed(view: View, plane: Field) -> Template:
    """The same plane in every image."""
    return image_template(view, lambda n, _: plane, static=True)


def _times_expected(view: View, pattern: Field) -> Template:
    """Every image times one pattern."""
    return image_template(view, lambda n, seen: np.asarray(seen[n] * pattern), static=True)


def _is_combined(view: View, n: int) -> bool:
    return (view.solution.transit.frames[n].gain_mode or "").lower() == "combined"


def _gain_mismatch(view: View) -> Sequence[Template]:
    return [image_template(view, lambda n, seen: seen[n] * np.float32(_is_combined(view, n)))]


def _one_gain_mode(view: View) -> str | None:
    modes = {frame.gain_mode for frame in view.solution.transit.frames}
    return None if len(modes) > 1 else f"all images have one gain mode ({', '.join(map(str, modes))})"


def _nonlinearity(view: View) -> Sequence[Template]:
    def error(n: int, seen: list[Field]) -> Field:
        counts = np.maximum(seen[n] * np.float32(view.exposure_s(n)), 0)
        return np.asarray(-seen[n] * np.exp(-counts / np.float32(FAINT_DN)))

    return [image_template(view, error)]


def _flat_field(view: View) -> Sequence[Template]:
    x, y = view.places
    twelfth = np.float32(1 / 12)
    patterns = (x, y, x * x - twelfth, x * y, y * y - twelfth)
    return [_times_expected(view, np.asarray(pattern)) for pattern in patterns]


def _column_smear(view: View) -> Sequence[Template]:
    def error(n: int, seen: list[Field]) -> Field:
        return np.broadcast_to(seen[n].mean(axis=0, dtype=np.float32), seen[n].shape)

    return [image_template(view, error, static=True)]


def _persistence(view: View) -> Sequence[Template]:
    def error(n: int, seen: list[Field]) -> Field:
        if n == 0:
            return np.zeros(view.solution.transit.shape, np.float32)
        return seen[n - 1] * np.float32(view.exposure_s(n - 1) / view.exposure_s(n))

    return [image_template(view, error)]


def _ghost(view: View) -> Sequence[Template]:
    """A blurred copy, displaced to where the discs' means ask for it most, by a search over the field."""
    blurred = [np.asarray(gaussian_filter(seen, GHOST_BLUR_PX)) for seen in view.lit]
    dx, dy = _best_displacement(view, blurred)

    def error(n: int, seen: list[Field]) -> Field:
        return _displaced(np.asarray(gaussian_filter(seen[n], GHOST_BLUR_PX)), dx, dy)

    return [image_template(view, error, static=True)]


def _displaced(plane: Field, dx: int, dy: int) -> Field:
    """The plane moved by whole pixels, dark where nothing moved in."""
    out = np.zeros_like(plane)
    ny, nx = plane.shape
    to_y, to_x = slice(max(dy, 0), min(ny + dy, ny)), slice(max(dx, 0), min(nx + dx, nx))
    from_y, from_x = slice(max(-dy, 0), min(ny - dy, ny)), slice(max(-dx, 0), min(nx - dx, nx))
    out[to_y, to_x] = plane[from_y, from_x]
    return out


def _best_displacement(view: View, blurred: Sequence[Field]) -> tuple[int, int]:
    """Whole pixels (x, y) by which a copy explains most of the discs' mean residuals, the PSF's part taken out.

    Not nearer than GHOST_NEAREST_PX, where a copy would be the disc's own surroundings.
    """
    solution = view.solution
    frames = solution.inversion.frames
    sigma = np.array([np.hypot(f.noise, 0.003 * f.expected) for f in frames])
    absorbed = np.linalg.qr(np.array([f.answer for f in frames]) / sigma[:, None])[0]
    residual = np.array([f.observed - f.expected for f in frames]) / sigma
    residual = residual - absorbed @ (absorbed.T @ residual)
    ny, nx = solution.transit.shape
    steps_y, steps_x = (np.arange(-n + GHOST_STEP_PX, n, GHOST_STEP_PX) for n in (ny, nx))
    copies = np.zeros((len(frames), steps_y.size, steps_x.size))
    for k, (n, frame) in enumerate(zip(solution.part, frames, strict=True)):
        y = round(frame.found.place.y_px) - steps_y
        x = round(frame.found.place.x_px) - steps_x
        inside = ((y >= 0) & (y < ny))[:, None] & ((x >= 0) & (x < nx))[None, :]
        there = blurred[n][np.ix_(np.clip(y, 0, ny - 1), np.clip(x, 0, nx - 1))]
        copies[k] = np.where(inside, there, 0.0) / sigma[k]
    flat = copies.reshape(len(frames), -1)
    flat = flat - absorbed @ (absorbed.T @ flat)
    size = (flat**2).sum(axis=0)
    gain = np.where(size > 1.0, np.maximum(residual @ flat, 0.0) ** 2 / np.maximum(size, 1e-30), 0.0)
    near = np.hypot(steps_y[:, None], steps_x[None, :]).ravel() < GHOST_NEAREST_PX
    best = int(np.argmax(np.where(near, -1.0, gain)))
    return int(steps_x[best % steps_x.size]), int(steps_y[best // steps_x.size])


def _shape_slopes(view: View, shape: str, parameters: tuple[int, ...]) -> list[Blur]:
    transit, solution = view.solution.transit, view.solution
    total = TotalPsf(transit.diffraction, SHAPES[shape], transit.shape, threads=solution.threads)
    at = SHAPES[shape].coordinates(solution.inversion.values)
    return [Blur(total.slope(at, k), transit.shape, threads=solution.threads) for k in parameters]


def _by_psf(view: View, blurs: Sequence[Blur], weights: Sequence[Field | None]) -> list[Template]:
    def one(slope: Blur, weight: Field | None) -> Template:
        return Template(disc=lambda n: view.by_psf(n, slope, weight))

    return [one(slope, weight) for slope, weight in zip(blurs, weights, strict=True)]


def _anisotropic(view: View) -> Sequence[Template]:
    return _by_psf(view, _shape_slopes(view, "stretched", (3, 4)), (None, None))


def _halo(view: View) -> Sequence[Template]:
    return _by_psf(view, _shape_slopes(view, "two-power-laws", (3,)), (None,))


def _not_a_power_law(view: View) -> str | None:
    name = view.solution.inversion.shape.name
    return None if name == SOFTENED_POWER_LAW.name else f"the fitted shape is {name}, of which it is a part"


def _field_dependent(view: View) -> Sequence[Template]:
    (slope,) = _shape_slopes(view, SOFTENED_POWER_LAW.name, (2,))
    # The coordinate is a logit: a share of the amount of scatter is what people ask for.
    share = np.float32(1 - view.solution.inversion.values["total"])
    x, y = view.places
    return _by_psf(view, (slope, slope), (x / share, y / share))


def _blur(view: View, kernel: Kernel) -> Blur:
    return Blur(kernel, view.solution.transit.shape, threads=view.solution.threads)


def _core_blur(view: View) -> Sequence[Template]:
    kernel = view.solution.total.kernel(view.solution.inversion.coordinates)
    # A Gaussian blur of variance 1 px^2 along each axis: half the Laplacian.
    neighbours = sum(np.roll(kernel, step, axis) for axis in (0, 1) for step in (-1, 1))
    return _by_psf(view, [_blur(view, (neighbours - 4 * kernel) / 2)], (None,))


def _mesh(view: View, changed: Kernel) -> list[Template]:
    """A change of the diffraction pattern, seen through the scatter."""
    solution = view.solution
    size = solution.total.size
    scatter = solution.inversion.shape.kernel(solution.inversion.coordinates, size)
    through = Convolver(changed, (size, size), dtype=np.float64, threads=solution.threads)
    return _by_psf(view, [_blur(view, np.asarray(through.apply(scatter), dtype=np.float64))], (None,))


def _rotation(view: View) -> Sequence[Template]:
    pattern = view.solution.transit.diffraction
    odd = pattern[1 - pattern.shape[0] % 2 :, 1 - pattern.shape[1] % 2 :]  # its centre in the middle
    there, back = (rotate(odd, a, reshape=False, order=1) for a in (ROTATION_DEG, -ROTATION_DEG))
    return _mesh(view, crop_or_pad(np.asarray(there - back) / (2 * ROTATION_DEG), pattern.shape[0]))


def _pitch(view: View) -> Sequence[Template]:
    pattern = view.solution.transit.diffraction
    centre = np.array(pattern.shape) // 2

    def scaled(by: float) -> Kernel:
        offset = centre - centre / by
        return np.asarray(affine_transform(pattern, np.eye(2) / by, offset=offset, order=1)) / by**2

    return _mesh(view, (scaled(1 + PITCH_SHARE) - scaled(1 - PITCH_SHARE)) / (2 * PITCH_SHARE * 100))


def _beyond_field(view: View) -> Sequence[Template]:
    solution = view.solution
    ny, nx = solution.transit.shape
    kernel = solution.total.kernel(solution.inversion.coordinates)
    pad_y, pad_x = ny // 2, nx // 2
    through = Convolver(kernel, (ny + 2 * pad_y, nx + 2 * pad_x), dtype=np.float32, threads=solution.threads)

    def error(n: int, _: list[Field]) -> Field:
        scene = solution.optics.field(solution.sky.scenes[n])
        wide = np.pad(scene, ((pad_y, pad_y), (pad_x, pad_x)), mode="symmetric")
        wide[pad_y:-pad_y, pad_x:-pad_x] = 0
        return np.asarray(through.apply(wide)[pad_y:-pad_y, pad_x:-pad_x], dtype=np.float32)

    return [image_template(view, error, static=True)]


def _motion(view: View) -> Sequence[Template]:
    """The disc drawn out along its track: light where it was dark for a part of the exposure, and the other way."""
    solution = view.solution
    frames = solution.transit.frames
    places = [found.place for found in solution.sky.found]
    longest = max(frame.exposure_s for frame in frames)

    def disc(n: int) -> NDArray[np.float64]:
        near = [k for k, f in enumerate(frames) if f.fov == frames[n].fov and k != n]
        chosen = neighbours_of(n, frames, places, solution.transit.noise)
        if not near or not chosen:
            return np.zeros(solution.sky.dark[n][0].size)
        other = min(near, key=lambda k: abs(frames[k].time_s - frames[n].time_s))
        dx, dy = places[other].x_px - places[n].x_px, places[other].y_px - places[n].y_px
        reach = MOTION_PX * frames[n].exposure_s / longest / max(float(np.hypot(dx, dy)), 1e-9)
        here = places[n]
        ahead, behind = (
            coverage(
                solution.transit.shape,
                Place(here.x_px + s * reach * dx, here.y_px + s * reach * dy, here.radius_px),
            )
            for s in (0.5, -0.5)
        )
        lost = (ahead + behind) / 2 - coverage(solution.transit.shape, here)
        scene = np.mean([solution.optics.field(solution.sky.scenes[k]) for k in chosen], axis=0)
        return view.in_disc(
            n,
            solution.optics.field(
                solution.optics.see(solution.optics.lanes((-lost * scene).astype(np.float32)))
            ),
        )

    return [Template(disc=disc)]


def _filled(view: View) -> Sequence[Template]:
    frames = view.solution.transit.frames

    def error(n: int, seen: list[Field]) -> Field:
        filled = frames[n].filled
        if filled is None:
            return np.zeros(view.solution.transit.shape, np.float32)
        return np.asarray(seen[n] * filled)

    return [image_template(view, error)]


def _nothing_filled(view: View) -> str | None:
    filled = any(f.filled is not None and f.filled.any() for f in view.solution.transit.frames)
    return None if filled else "no pixel was filled in"


def _evolution(view: View) -> Sequence[Template]:
    """The scene of a pointing brightening or fading evenly in its structure: the image's own contrast drifts."""
    frames = view.solution.transit.frames
    middle = {
        fov: float(np.mean([f.time_s for f in frames if f.fov == fov])) for fov in {f.fov for f in frames}
    }

    def error(n: int, seen: list[Field]) -> Field:
        hours = np.float32((frames[n].time_s - middle[frames[n].fov]) / 3600)
        return np.asarray((seen[n] - gaussian_filter(seen[n], 16.0)) * hours)

    return [image_template(view, error)]


def _p(*pairs: tuple[str, str]) -> tuple[EffectParameter, ...]:
    return tuple(EffectParameter(name, unit) for name, unit in pairs)


LIBRARY: tuple[Effect, ...] = (
    Effect("dark_offset", "detector", _p(("offset", "DN")), "The dark level taken off every readout is wrong.",
           "a dark exposure, or a ladder of exposures at one pointing", ("exposure", "intensity"), _dark_offset),
    Effect("intensity_gradient", "detector",
           _p(("level", "DN/s"), ("slope_x", "DN/s/field"), ("slope_y", "DN/s/field")),
           "A light leak lays a faint plane over every image.", "an exposure with the door shut",
           ("detector_x", "detector_y"), _gradient),
    Effect("gain_mismatch", "detector", _p(("excess", "")), "Combined and high-only images differ in gain.",
           "the same scene in both gain modes", ("gain_mode", "exposure"), _gain_mismatch, _one_gain_mode),
    Effect("nonlinearity", "detector", _p(("loss", "")), "Faint signals are read out too low.",
           "a ladder of exposures at one pointing", ("intensity",), _nonlinearity),
    Effect("flat_field_residual", "detector",
           _p(("x", "/field"), ("y", "/field"), ("xx", "/field2"), ("xy", "/field2"), ("yy", "/field2")),
           "The detector's sensitivity is not quite flattened.", "the same scene displaced on the detector",
           ("detector_x", "detector_y"), _flat_field),
    Effect("column_smear", "detector", _p(("share", "")), "Charge is smeared along columns while they are read.",
           "an exposure with half of the field dark", ("detector_x", "detector_y", "intensity"), _column_smear),
    Effect("persistence", "detector", _p(("share", "")), "A share of the image before is left in the next.",
           "a dark exposure after a bright one", ("time", "pointing"), _persistence),
    Effect("ghost", "optics", _p(("share", "")), "A reflection lays a displaced, defocused copy over the image.",
           "a bright source moved across the field", ("detector_x", "detector_y", "intensity"), _ghost, trials=GHOST_TRIALS),
    Effect("anisotropic_scatter", "optics", _p(("p", ""), ("q", "")),
           "Scatter reaches farther along one direction: ln(1 + stretch) times cos and sin of twice its angle.",
           "a transit of a second track across the first", ("azimuth_in_disc", "detector_x", "detector_y"),
           _anisotropic, _not_a_power_law),
    Effect("field_dependent_scatter", "optics", _p(("x", "/field"), ("y", "/field")),
           "The amount of scatter changes across the detector.", "a transit of another part of the detector",
           ("detector_x", "detector_y"), _field_dependent, _not_a_power_law),
    Effect("wide_halo", "optics", _p(("share", "")), "A second, wide component of scatter.",
           "an eclipse or a larger occulter", ("scattering_distance", "pointing", "intensity"), _halo,
           _not_a_power_law),
    Effect("core_blur", "optics", _p(("variance", "px2")), "Jitter or defocus widens the core.",
           "a sharp limb, or a point source", ("radius_in_disc", "azimuth_in_disc"), _core_blur),
    Effect("mesh_rotation", "optics", _p(("angle", "deg")), "The meshes are turned against the detector.",
           "the arms of a flare", ("azimuth_in_disc", "detector_x", "detector_y"), _rotation),
    Effect("mesh_pitch", "optics", _p(("stretch", "%")), "The meshes' pitch is not the drawing's.",
           "the arms of a flare", ("radius_in_disc", "azimuth_in_disc"), _pitch),
    Effect("occulter_motion", "scene", _p(("amount", "")), "The occulter moves during an exposure.",
           "shorter exposures", ("radius_in_disc", "azimuth_in_disc"), _motion),
    Effect("out_of_field_light", "scene", _p(("share", "")), "The Sun goes on beyond the field and scatters in.",
           "full-Sun images of the same time", ("scattering_distance", "pointing", "intensity"), _beyond_field),
    Effect("saturation_fill", "detector", _p(("excess", "")), "What was filled in for saturated pixels is wrong.",
           "a shorter exposure of the same time", ("pointing", "intensity"), _filled, _nothing_filled),
    Effect("scene_evolution", "scene", _p(("drift", "/h")), "The Sun changes while the occulter crosses a pointing.",
           "images closer in time", ("time", "pointing"), _evolution),
)  # fmt: skip
