"""Effects of the optics: changes of the PSF, and copies of the image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter, rotate

from psfcore.convolution.convolver import Convolver
from psfcore.gap.effect import Change, Effect
from psfcore.gap.effect import EffectParameter as Parameter
from psfcore.gap.evidence.search import KERNEL_REACH_PX, displaced, distinguished, place_search
from psfcore.gap.view import Field, View
from psfcore.psf import crop_or_pad
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import Blur, TotalPsf

Kernel = NDArray[np.float64]
Steps = tuple[tuple[int, int], ...]
Halo = Callable[
    [int], Kernel
]  # maps the size of an array to weights [y, x] with the centre at size // 2; their sum on an infinite plane is 1
HALO_SCALES_PX = (20.0, 40.0, 80.0, 160.0, 320.0)
MOFFAT = 1.5  # exponent of the Moffat profile: the halo falls off as r^-3
GHOST_TRIALS = 300  # about the number of distinguishable copies in a field of 512 px
ANGLES_DEG = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 15.0, 20.0)
PITCHES_PCT = (0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 38.0)
DIRECTIONS: tuple[Steps, ...] = (((1, 0), (0, 1)), ((1, 0),), ((0, 1),), ((1, 1),), ((1, -1),))
# Directions between those of DIRECTIONS need longer steps, so they serve only for wider blurs.
BETWEEN_THEM: tuple[Steps, ...] = (((1, 2),), ((2, 1),), ((1, -2),), ((2, -1),))
BLURS = (
    *((width, steps) for width in (0.4, 0.8, 1.5, 2.5) for steps in DIRECTIONS),
    *((width, steps) for width in (1.5, 2.5) for steps in BETWEEN_THEM),
)
BETWEEN = 6  # number of parts into which the interval between the neighbours of the best step is divided
SPLINE = 3  # order of the interpolation; a linear interpolation (order 1) would blur a rotated pattern
AMOUNT = SOFTENED_POWER_LAW.names.index("total")  # the coordinate of the total scatter
FIELD_DEPENDENT = "field_dependent_scatter"


@dataclass(frozen=True)
class _Best:
    """The result of a search among templates: the best one, and how many the data distinguish (`search.distinguished`)."""

    template: Any
    distinguished: float


def _unsearched(view: View) -> Sequence[Change]:
    """The changes of an effect before `_searching` gives it those of its best template."""
    return []


def _searching(
    plain: Effect,
    search: Callable[[View], _Best],
    changes: Callable[[View, Any], Sequence[Change]],
    described: Callable[[Any], str] = lambda template: "",
) -> Effect:
    """An effect that uses the best of several templates. search: runs once for each view. changes(view, template): the changes
    by a template. described(template): the text that follows the cause if the template is held.
    """

    def best(view: View) -> _Best:
        return view.once(plain.name, lambda: search(view))

    def held(view: View) -> Effect:
        found = best(view)
        return replace(
            plain,
            cause=plain.cause[:-1] + described(found.template) + ".",
            changes=lambda view: changes(view, found.template),
            distinguished=lambda view: found.distinguished,
        )

    return replace(
        plain,
        changes=lambda view: changes(view, best(view).template),
        distinguished=lambda view: best(view).distinguished,
        held=held,
    )


def _by_psf(view: View, blur: Blur, weight: Field | None = None) -> Change:
    """The change of the images by a change of the PSF (`blur`). weight: a factor for the light of each scene pixel [y, x]."""
    return Change(lambda n, images: view.blurred(n, blur, weight), unocculted=False)


def _by_kernel(view: View, kernel: Kernel) -> Sequence[Change]:
    """The change of the images by a change of the PSF [y, x]."""
    return [_by_psf(view, Blur(kernel, view.solution.transit.shape, threads=view.solution.threads))]


def _scatter(view: View) -> Kernel:
    """The scatter kernel of the fit, on the grid of the total PSF."""
    inversion = view.solution.inversion
    return inversion.shape.kernel(inversion.coordinates, view.solution.total.size)


def _ghost(view: View) -> _Best:
    """A blurred, displaced copy of the image. A search over the field finds the displacement that explains the discs best."""
    return _Best(*place_search(view).copy)


def _copy(view: View, blur_px: float, dx: int, dy: int) -> Sequence[Change]:
    """The copy, and how it changes if it is displaced further along x or y, magnified, or turned."""
    x, y = view.places
    ones = np.ones_like(x)
    # The displacement along x and along y of each form.
    forms = ((ones, 0 * ones), (0 * ones, ones), (x, y), (-y, x))

    def copied(n: int, images: Sequence[Field]) -> Field:
        return np.asarray(displaced(gaussian_filter(images[n], blur_px), dx, dy), dtype=np.float32)

    def moved(n: int, images: Sequence[Field], form: tuple[Field, Field]) -> Field:
        along_y, along_x = np.gradient(copied(n, images))
        return np.asarray(-(form[0] * along_x + form[1] * along_y), dtype=np.float32)

    moves = [Change(partial(moved, form=form), unocculted=False) for form in forms]
    return [Change(copied, unocculted=False), *moves]


def _where_copied(copy: tuple[float, int, int]) -> str:
    blur_px, dx, dy = copy
    return f": displaced by ({dx}, {dy}) px, blurred by {blur_px:g} px"


def _not_a_power_law(view: View) -> str | None:
    """The reason why changes of the softened power law cannot be tested for this fit; None if they can be tested."""
    name = view.solution.inversion.shape.name
    if name == SOFTENED_POWER_LAW.name:
        return None
    return f"this effect needs the softened power law; the fitted shape is {name}"


def _anisotropic(view: View) -> Sequence[Change]:
    """Derivatives of the total PSF with respect to p and q of the stretched power law, evaluated at the fit."""
    transit, solution, shape = view.solution.transit, view.solution, SHAPES["stretched"]
    total = TotalPsf(transit.diffraction, shape, transit.shape, threads=solution.threads)
    at = shape.coordinates(solution.inversion.values)
    return [change for k in (3, 4) for change in _by_kernel(view, total.slope(at, k))]


def _exponential(scale_px: float) -> Halo:
    return lambda size: np.exp(-_radius(size) / scale_px) / (2 * np.pi * scale_px**2)


def _moffat(scale_px: float) -> Halo:
    area = np.pi * scale_px**2 / (MOFFAT - 1)
    return lambda size: (1 + (_radius(size) / scale_px) ** 2) ** -MOFFAT / area


def _radius(size: int) -> Kernel:
    d = np.arange(size) - size // 2
    return np.asarray(np.hypot(d[:, None], d[None, :]))


HALOS: tuple[Halo, ...] = tuple(form(scale) for scale in HALO_SCALES_PX for form in (_exponential, _moffat))


def _as_halo(view: View, halo: Halo) -> Sequence[Change]:
    """The change of the images if a fraction of the scatter kernel is replaced by a halo."""
    total = view.solution.total
    return _by_kernel(view, total.diffracted(halo(total.size) - _scatter(view)))


def _halo(view: View) -> _Best:
    """The halo that explains most of the residuals."""
    size = view.solution.total.size
    gains = place_search(view).wide_kernels([halo(size) for halo in HALOS])
    return _Best(HALOS[int(np.argmax(gains))], distinguished(gains))


def _field_dependent(view: View) -> Sequence[Change]:
    slope = view.slopes[AMOUNT]
    # The coordinate is a logit; the parameter is a relative change of the total scatter.
    share = np.float32(1 - view.solution.inversion.values["total"])
    x, y = view.places
    return [_by_psf(view, slope, (where / share).astype(np.float32)) for where in (x, y, x * x + y * y)]


def blur_as(view: View, width_px: float, steps: Steps) -> Sequence[Change]:
    """The change of the images by a blur of width `width_px`, divided by the variance of the blur, width_px^2."""
    return _by_kernel(view, (_blurred(view.kernel, width_px, steps) - view.kernel) / width_px**2)


def _core_blur(view: View) -> _Best:
    """The width (px) and the directions of the blur that explains most of the residuals."""
    near = crop_or_pad(view.kernel, 2 * KERNEL_REACH_PX + 1)
    gains = place_search(view).kernels([_blurred(near, *blur) - near for blur in BLURS])
    return _Best(BLURS[int(np.argmax(gains))], distinguished(gains))


def _blurred(kernel: Kernel, width_px: float, steps: Steps) -> Kernel:
    """The kernel [y, x], blurred by a random walk with steps (y, x); width_px: rms length of the walk along each direction.

    A sampled Gaussian that is narrower than a pixel would ring. A random walk is never negative and has the exact variance.
    """
    fy, fx = np.fft.fftfreq(kernel.shape[0])[:, None], np.fft.rfftfreq(kernel.shape[1])[None, :]
    walk = sum((np.cos(2 * np.pi * (y * fy + x * fx)) - 1) / (y * y + x * x) for y, x in steps)
    transfer = np.exp(width_px**2 * walk)
    return np.asarray(np.fft.irfft2(np.fft.rfft2(kernel) * transfer, s=kernel.shape))


def _odd(view: View) -> Kernel:
    """The diffraction PSF, cut to an odd size, so that its centre is the middle pixel."""
    pattern = view.solution.transit.diffraction
    return np.asarray(pattern[1 - pattern.shape[0] % 2 :, 1 - pattern.shape[1] % 2 :])


def _turned(pattern: Kernel, angle_deg: float) -> Kernel:
    return np.asarray(rotate(pattern, angle_deg, reshape=False, order=SPLINE))


def _stretched(pattern: Kernel, percent: float) -> Kernel:
    by = 1 + percent / 100
    centre = np.array(pattern.shape) // 2
    return np.asarray(
        affine_transform(pattern, np.eye(2) / by, offset=centre - centre / by, order=SPLINE) / by**2
    )


def _amount(view: View, form: Callable[[Kernel, float], Kernel], steps: Sequence[float]) -> _Best:
    """The amount of change of the diffraction PSF that explains most of the residuals.

    A search is needed because the mesh orders move by more than their width. form(pattern, amount): the changed pattern.
    steps: absolute amounts; each is tried with both signs. Then amounts between the neighbours of the best one are tried.
    """
    pattern = _odd(view)
    pattern = crop_or_pad(pattern, min(2 * KERNEL_REACH_PX + 1, pattern.shape[0]))

    def gains_of(amounts: Sequence[float]) -> NDArray[np.float64]:
        return place_search(view).kernels([form(pattern, amount) - pattern for amount in amounts])

    tried = sorted(sign * step for step in steps for sign in (-1, 1))
    gains = gains_of(tried)
    best = int(np.argmax(gains))
    low, high = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
    between = [low + (high - low) * k / BETWEEN for k in range(1, BETWEEN)]
    between = [amount for amount in between if abs(amount) >= min(steps)]
    return _Best(between[int(np.argmax(gains_of(between)))], distinguished(gains))


def _mesh(view: View, form: Callable[[Kernel, float], Kernel], amount: float) -> Sequence[Change]:
    """The change of the images if form(pattern, amount) replaces the diffraction PSF, divided by the amount."""
    solution, pattern = view.solution, _odd(view)
    size = solution.total.size
    change = crop_or_pad((form(pattern, amount) - pattern) / amount, solution.transit.diffraction.shape[0])
    through = Convolver(change, (size, size), dtype=np.float64, threads=solution.threads)
    return _by_kernel(view, np.asarray(through.apply(_scatter(view)), dtype=np.float64))


EFFECTS: tuple[Effect, ...] = (
    _searching(Effect("ghost", "optics", (Parameter("share", "", 0.02, True), Parameter("shift_x", "px", 0.02), Parameter("shift_y", "px", 0.02),
                                   Parameter("magnified", "px/field", 0.04), Parameter("turned", "px/field", 0.04)), "A reflection adds a displaced, defocused copy of the image.",
               "images of a bright source at several positions in the field", ("detector_x", "detector_y", "intensity"),
               _unsearched, trials=GHOST_TRIALS, family="ghost"),
               _ghost, lambda view, copy: _copy(view, *copy), _where_copied),
    Effect("anisotropic_scatter", "optics", (Parameter("p", "", 0.1), Parameter("q", "", 0.1)),
           "Scatter reaches farther along one direction. p and q are ln(1 + stretch) times the cosine and the sine of twice the angle of this direction.",
           "a transit along a second track that crosses the first", ("azimuth_in_disc", "detector_x", "detector_y"),
           _anisotropic, _not_a_power_law, family="psf"),
    Effect(FIELD_DEPENDENT, "optics",
           (Parameter("x", "/field", 0.1), Parameter("y", "/field", 0.1), Parameter("outwards", "/field2", 0.2)),
           "The total scatter varies across the detector, linearly or from its centre outwards.", "a transit across another part of the detector",
           ("detector_x", "detector_y"), _field_dependent, _not_a_power_law, family="psf_place"),
    _searching(Effect("wide_halo", "optics", (Parameter("share", "", 0.1, True),), "The scatter has a second, wide component.",
               "an eclipse, or a transit of a larger occulter", ("scattering_distance", "pointing", "intensity"),
               _unsearched, trials=len(HALOS), family="psf"), _halo, _as_halo),
    _searching(Effect("core_blur", "optics", (Parameter("variance", "px2", 1.0, True),), "Jitter or defocus widens the core.",
               "an image of a sharp limb or of a point source", ("radius_in_disc", "azimuth_in_disc"),
               _unsearched, trials=len(BLURS), family="core"),
               _core_blur, lambda view, blur: blur_as(view, *blur)),
    _searching(Effect("mesh_rotation", "optics", (Parameter("angle", "deg", 3.0),), "The meshes are rotated relative to the detector.",
               "the diffraction arms of a flare", ("azimuth_in_disc", "detector_x", "detector_y"),
               _unsearched, trials=2 * len(ANGLES_DEG), family="psf"),
               lambda view: _amount(view, _turned, ANGLES_DEG), lambda view, angle_deg: _mesh(view, _turned, angle_deg)),
    _searching(Effect("mesh_pitch", "optics", (Parameter("stretch", "%", 3.0),), "The pitch of the meshes differs from its nominal value.",
               "the diffraction arms of a flare", ("radius_in_disc", "azimuth_in_disc"),
               _unsearched, trials=2 * len(PITCHES_PCT), family="psf"),
               lambda view: _amount(view, _stretched, PITCHES_PCT), lambda view, percent: _mesh(view, _stretched, percent)),
)  # fmt: skip
