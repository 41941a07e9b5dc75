"""Effects of the optics: changes of the PSF, and copies of the image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter, rotate

from psfcore.fourier import Convolver
from psfcore.gap.effect import Change, Effect, EffectParameter, Field, View
from psfcore.gap.search import PlaceSearch, displaced
from psfcore.psf import crop_or_pad
from psfcore.scatter.optics import Blur
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import TotalPsf

Kernel = NDArray[np.float64]
GHOST_TRIALS = 300  # a field of 512 px holds about that many copies that differ
ROTATION_DEG = 0.5
PITCH_SHARE = 0.005


def by_psf(view: View, blur: Blur, weight: Field | None = None) -> Change:
    """A change of the PSF, times a weight of where the light is from."""
    return Change(lambda n, images: view.blurred(n, blur, weight), lit=False)


def by_psf_in_time(view: View, blur: Blur, factor: Callable[[int], float]) -> Change:
    """A change of the PSF that differs from image to image."""
    return Change(lambda n, images: view.blurred(n, blur) * np.float32(factor(n)), lit=False)


def shape_slopes(view: View, shape: str, parameters: tuple[int, ...]) -> list[Blur]:
    """Slopes of the total PSF along coordinates of a shape, about the solution."""
    transit, solution = view.solution.transit, view.solution
    total = TotalPsf(transit.diffraction, SHAPES[shape], transit.shape, threads=solution.threads)
    at = SHAPES[shape].coordinates(solution.inversion.values)
    return [Blur(total.slope(at, k), transit.shape, threads=solution.threads) for k in parameters]


def not_a_power_law(view: View) -> str | None:
    """Why a change of the power law cannot be tried."""
    name = view.solution.inversion.shape.name
    return None if name == SOFTENED_POWER_LAW.name else f"the fitted shape is {name}, of which it is a part"


def core_slope(view: View) -> Blur:
    """A Gaussian blur of variance 1 px^2 along each axis: half the Laplacian of the PSF."""
    kernel = view.solution.total.kernel(view.solution.inversion.coordinates)
    neighbours = sum(np.roll(kernel, step, axis) for axis in (0, 1) for step in (-1, 1))
    return _blur(view, (neighbours - 4 * kernel) / 2)


def _blur(view: View, kernel: Kernel) -> Blur:
    return Blur(kernel, view.solution.transit.shape, threads=view.solution.threads)


def _ghost(view: View) -> Sequence[Change]:
    """A blurred copy, displaced to where the discs ask for it most, by a search over the field."""
    return _copy(*PlaceSearch(view).copy())


def _copy(blur_px: float, dx: int, dy: int) -> Sequence[Change]:
    def change(n: int, images: Sequence[Field]) -> Field:
        return np.asarray(displaced(gaussian_filter(images[n], blur_px), dx, dy), dtype=np.float32)

    return [Change(change, lit=False)]


def _held_ghost(view: View) -> Effect:
    blur_px, dx, dy = PlaceSearch(view).copy()
    ghost = next(effect for effect in EFFECTS if effect.name == "ghost")
    return replace(
        ghost,
        changes=lambda view: _copy(blur_px, dx, dy),
        held=None,
        cause=f"{ghost.cause[:-1]}: displaced by ({dx}, {dy}) px, blurred by {blur_px:g} px.",
    )


def _anisotropic(view: View) -> Sequence[Change]:
    return [by_psf(view, blur) for blur in shape_slopes(view, "stretched", (3, 4))]


def _halo(view: View) -> Sequence[Change]:
    return [by_psf(view, blur) for blur in shape_slopes(view, "two-power-laws", (3,))]


def _field_dependent(view: View) -> Sequence[Change]:
    (slope,) = shape_slopes(view, SOFTENED_POWER_LAW.name, (2,))
    # The coordinate is a logit: a share of the amount of scatter is what people ask for.
    share = np.float32(1 - view.solution.inversion.values["total"])
    x, y = view.places
    return [by_psf(view, slope, x / share), by_psf(view, slope, y / share)]


def _core_blur(view: View) -> Sequence[Change]:
    return [by_psf(view, core_slope(view))]


def _mesh(view: View, changed: Kernel) -> list[Change]:
    """A change of the diffraction pattern, seen through the scatter."""
    solution = view.solution
    size = solution.total.size
    scatter = solution.inversion.shape.kernel(solution.inversion.coordinates, size)
    through = Convolver(changed, (size, size), dtype=np.float64, threads=solution.threads)
    return [by_psf(view, _blur(view, np.asarray(through.apply(scatter), dtype=np.float64)))]


def _rotation(view: View) -> Sequence[Change]:
    pattern = view.solution.transit.diffraction
    odd = pattern[1 - pattern.shape[0] % 2 :, 1 - pattern.shape[1] % 2 :]  # its centre in the middle
    there, back = (rotate(odd, a, reshape=False, order=1) for a in (ROTATION_DEG, -ROTATION_DEG))
    return _mesh(view, crop_or_pad(np.asarray(there - back) / (2 * ROTATION_DEG), pattern.shape[0]))


def _pitch(view: View) -> Sequence[Change]:
    pattern = view.solution.transit.diffraction
    centre = np.array(pattern.shape) // 2

    def scaled(by: float) -> Kernel:
        offset = centre - centre / by
        return np.asarray(affine_transform(pattern, np.eye(2) / by, offset=offset, order=1)) / by**2

    return _mesh(view, (scaled(1 + PITCH_SHARE) - scaled(1 - PITCH_SHARE)) / (2 * PITCH_SHARE * 100))


def _p(name: str, unit: str, likely: float, positive: bool = False) -> EffectParameter:
    return EffectParameter(name, unit, likely, positive)


EFFECTS: tuple[Effect, ...] = (
    Effect("ghost", "optics", (_p("share", "", 0.02, True),), "A reflection lays a displaced, defocused copy over the image.",
           "a bright source moved across the field", ("detector_x", "detector_y", "intensity"), _ghost,
           trials=GHOST_TRIALS, held=_held_ghost),
    Effect("anisotropic_scatter", "optics", (_p("p", "", 0.1), _p("q", "", 0.1)),
           "Scatter reaches farther along one direction: ln(1 + stretch) times cos and sin of twice its angle.",
           "a transit of a second track across the first", ("azimuth_in_disc", "detector_x", "detector_y"),
           _anisotropic, not_a_power_law),
    Effect("field_dependent_scatter", "optics", (_p("x", "/field", 0.1), _p("y", "/field", 0.1)),
           "The amount of scatter changes across the detector.", "a transit of another part of the detector",
           ("detector_x", "detector_y"), _field_dependent, not_a_power_law),
    Effect("wide_halo", "optics", (_p("share", "", 0.1, True),), "A second, wide component of scatter.",
           "an eclipse or a larger occulter", ("scattering_distance", "pointing", "intensity"), _halo,
           not_a_power_law),
    Effect("core_blur", "optics", (_p("variance", "px2", 0.5, True),), "Jitter or defocus widens the core.",
           "a sharp limb, or a point source", ("radius_in_disc", "azimuth_in_disc"), _core_blur),
    Effect("mesh_rotation", "optics", (_p("angle", "deg", 2.0),), "The meshes are turned against the detector.",
           "the arms of a flare", ("azimuth_in_disc", "detector_x", "detector_y"), _rotation),
    Effect("mesh_pitch", "optics", (_p("stretch", "%", 3.0),), "The meshes' pitch is not the drawing's.",
           "the arms of a flare", ("radius_in_disc", "azimuth_in_disc"), _pitch),
)  # fmt: skip
