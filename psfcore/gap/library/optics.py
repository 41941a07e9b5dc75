"""Effects of the optics: changes of the PSF, and copies of the image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter, rotate

from psfcore.convolution.convolver import Convolver
from psfcore.gap.effect import Change, Effect, EffectParameter
from psfcore.gap.evidence.search import KERNEL_REACH_PX, displaced, distinguished, place_search
from psfcore.gap.view import Field, View
from psfcore.psf import crop_or_pad
from psfcore.scatter.optics import Blur
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import TotalPsf

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


@dataclass(frozen=True)
class _Sought:
    """The result of a search among templates: the best one, and how many the data distinguish (`search.distinguished`)."""

    best: Any
    distinguished: float


Search = Callable[[View], _Sought]


def _once(name: str, search: Search) -> Search:
    """The same search, which runs once for each view."""

    def kept(view: View) -> _Sought:
        results = view.kept.setdefault(_Sought, {})
        if name not in results:
            results[name] = search(view)
        found = results[name]
        assert isinstance(found, _Sought)
        return found

    return kept


def by_psf(view: View, blur: Blur, weight: Field | None = None) -> Change:
    """The change of the images by a change of the PSF (`blur`). weight: a factor for the light of each scene pixel [y, x]."""
    return Change(lambda n, images: view.blurred(n, blur, weight), unocculted=False)


def shape_slopes(view: View, shape: str, parameters: tuple[int, ...]) -> list[Blur]:
    """Derivatives of the total PSF with respect to coordinates of another shape, evaluated at the fit.

    parameters: the indices of these coordinates. The other parameters have the fitted values.
    """
    transit, solution = view.solution.transit, view.solution
    total = TotalPsf(transit.diffraction, SHAPES[shape], transit.shape, threads=solution.threads)
    at = SHAPES[shape].coordinates(solution.inversion.values)
    return [Blur(total.slope(at, k), transit.shape, threads=solution.threads) for k in parameters]


def not_a_power_law(view: View) -> str | None:
    """The reason why changes of the softened power law cannot be tested for this fit; None if they can be tested."""
    name = view.solution.inversion.shape.name
    return (
        None
        if name == SOFTENED_POWER_LAW.name
        else f"this effect needs the softened power law; the fitted shape is {name}"
    )


def _blur(view: View, kernel: Kernel) -> Blur:
    return Blur(kernel, view.solution.transit.shape, threads=view.solution.threads)


def _ghost(view: View) -> _Sought:
    """A blurred, displaced copy of the image. A search over the field finds the displacement that explains the discs best."""
    # The coarse grid of the search uses the means of the discs only. How many displacements the cells distinguish is not known, so all count.
    return _Sought(place_search(view).copy, GHOST_TRIALS)


def _copy(blur_px: float, dx: int, dy: int) -> Sequence[Change]:
    def change(n: int, images: Sequence[Field]) -> Field:
        return np.asarray(displaced(gaussian_filter(images[n], blur_px), dx, dy), dtype=np.float32)

    return [Change(change, unocculted=False)]


def _searching(
    effect: Effect,
    search: Search,
    changes: Callable[[View, Any], Sequence[Change]],
    cause: Callable[[Any], str] = lambda best: "",
) -> Effect:
    """The effect with a search among templates. changes(view, best): the changes by a template. cause(best): its description, which
    follows the cause of the effect if the template is held."""
    search = _once(effect.name, search)

    def held(view: View) -> Effect:
        found = search(view)
        return replace(
            effect,
            cause=effect.cause[:-1] + cause(found.best) + ".",
            changes=lambda view: changes(view, found.best),
            distinguished=lambda view: found.distinguished,
        )

    return replace(
        effect,
        changes=lambda view: changes(view, search(view).best),
        distinguished=lambda view: search(view).distinguished,
        held=held,
    )


def _sought_later(view: View) -> Sequence[Change]:
    """No changes; `_searching` replaces them."""
    return ()


def _where_copied(copy: tuple[float, int, int]) -> str:
    blur_px, dx, dy = copy
    return f": displaced by ({dx}, {dy}) px, blurred by {blur_px:g} px"


def _anisotropic(view: View) -> Sequence[Change]:
    return [by_psf(view, blur) for blur in shape_slopes(view, "stretched", (3, 4))]


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
    total, inversion = view.solution.total, view.solution.inversion
    scatter = inversion.shape.kernel(inversion.coordinates, total.size)
    return [by_psf(view, _blur(view, total.diffracted(halo(total.size) - scatter)))]


def _halo(view: View) -> _Sought:
    """The halo that explains most of the residuals."""
    size = view.solution.total.size
    gains = place_search(view).wide_kernels([halo(size) for halo in HALOS])
    return _Sought(HALOS[int(np.argmax(gains))], distinguished(gains))


def _field_dependent(view: View) -> Sequence[Change]:
    slope = view.slopes[AMOUNT]
    # The coordinate is a logit; the parameter is a relative change of the total scatter.
    share = np.float32(1 - view.solution.inversion.values["total"])
    x, y = view.places
    return [by_psf(view, slope, (where / share).astype(np.float32)) for where in (x, y, x * x + y * y)]


def blur_as(view: View, width_px: float, steps: Steps) -> Sequence[Change]:
    """The change of the images by a blur of width `width_px`, divided by the variance of the blur, width_px^2."""
    change = (_blurred(view.kernel, width_px, steps) - view.kernel) / width_px**2
    return [by_psf(view, _blur(view, change))]


def _core_blur(view: View) -> _Sought:
    """The width (px) and the directions of the blur that explains most of the residuals."""
    near = crop_or_pad(view.kernel, 2 * KERNEL_REACH_PX + 1)
    gains = place_search(view).kernels([_blurred(near, *blur) - near for blur in BLURS])
    return _Sought(BLURS[int(np.argmax(gains))], distinguished(gains))


def _blurred(kernel: Kernel, width_px: float, steps: Steps) -> Kernel:
    """The kernel [y, x], blurred by a random walk with steps (y, x); width_px: rms length of the walk along each direction.

    A sampled Gaussian that is narrower than a pixel would ring. A random walk is never negative and has the exact variance.
    """
    fy, fx = np.fft.fftfreq(kernel.shape[0])[:, None], np.fft.rfftfreq(kernel.shape[1])[None, :]
    walk = sum((np.cos(2 * np.pi * (y * fy + x * fx)) - 1) / (y * y + x * x) for y, x in steps)
    transfer = np.exp(width_px**2 * walk)
    return np.asarray(np.fft.irfft2(np.fft.rfft2(kernel) * transfer, s=kernel.shape))


def _mesh(view: View, changed: Kernel) -> list[Change]:
    """The change of the images by a change of the diffraction PSF (`changed`), convolved with the scatter kernel."""
    solution = view.solution
    size = solution.total.size
    scatter = solution.inversion.shape.kernel(solution.inversion.coordinates, size)
    through = Convolver(changed, (size, size), dtype=np.float64, threads=solution.threads)
    return [by_psf(view, _blur(view, np.asarray(through.apply(scatter), dtype=np.float64)))]


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


def _amount(view: View, form: Callable[[Kernel, float], Kernel], steps: Sequence[float]) -> _Sought:
    """The amount of change of the diffraction PSF that explains most of the residuals.

    A search is needed because the mesh orders move by more than their width. form(pattern, amount): the changed pattern.
    steps: absolute amounts; each is tried with both signs. Then amounts between the neighbours of the best one are tried.
    """
    search, pattern = place_search(view), _near(_odd(view))
    tried = sorted(sign * step for step in steps for sign in (-1, 1))
    gains = search.kernels([form(pattern, amount) - pattern for amount in tried])
    best = int(np.argmax(gains))
    low, high = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
    between = [low + (high - low) * k / BETWEEN for k in range(1, BETWEEN)]
    between = [amount for amount in between if abs(amount) >= min(steps)]
    nearer = search.kernels([form(pattern, amount) - pattern for amount in between])
    return _Sought(between[int(np.argmax(nearer))], distinguished(gains))


def _near(pattern: Kernel) -> Kernel:
    """The central part of a pattern. The search uses only this part."""
    return crop_or_pad(pattern, min(2 * KERNEL_REACH_PX + 1, pattern.shape[0]))


def _changed_mesh(view: View, form: Callable[[Kernel, float], Kernel], amount: float) -> list[Change]:
    """The change of the images if form(pattern, amount) replaces the diffraction PSF, divided by the amount."""
    pattern = _odd(view)
    change = (form(pattern, amount) - pattern) / amount
    return _mesh(view, crop_or_pad(change, view.solution.transit.diffraction.shape[0]))


def _mesh_effect(name: str, form: Callable[[Kernel, float], Kernel], steps: Sequence[float],
                 parameter: EffectParameter, cause: str, axes: tuple[str, ...]) -> Effect:  # fmt: skip
    return _searching(
        Effect(name, "optics", (parameter,), cause, "the diffraction arms of a flare", axes, _sought_later, trials=2 * len(steps)),
        lambda view: _amount(view, form, steps),
        lambda view, amount: _changed_mesh(view, form, amount),
    )  # fmt: skip


def _p(name: str, unit: str, likely: float, positive: bool = False) -> EffectParameter:
    return EffectParameter(name, unit, likely, positive)


EFFECTS: tuple[Effect, ...] = (
    _searching(
        Effect("ghost", "optics", (_p("share", "", 0.02, True),), "A reflection adds a displaced, defocused copy of the image.",
               "images of a bright source at several positions in the field", ("detector_x", "detector_y", "intensity"), _sought_later,
               trials=GHOST_TRIALS),
        _ghost, lambda view, copy: _copy(*copy), _where_copied),
    Effect("anisotropic_scatter", "optics", (_p("p", "", 0.1), _p("q", "", 0.1)),
           "Scatter reaches farther along one direction. p and q are ln(1 + stretch) times the cosine and the sine of twice the angle of this direction.",
           "a transit along a second track that crosses the first", ("azimuth_in_disc", "detector_x", "detector_y"),
           _anisotropic, not_a_power_law),
    Effect("field_dependent_scatter", "optics",
           (_p("x", "/field", 0.1), _p("y", "/field", 0.1), _p("outwards", "/field2", 0.2)),
           "The total scatter varies across the detector, linearly or from its centre outwards.", "a transit across another part of the detector",
           ("detector_x", "detector_y"), _field_dependent, not_a_power_law),
    _searching(
        Effect("wide_halo", "optics", (_p("share", "", 0.1, True),), "The scatter has a second, wide component.",
               "an eclipse, or a transit of a larger occulter", ("scattering_distance", "pointing", "intensity"), _sought_later,
               trials=len(HALOS)),
        _halo, _as_halo),
    _searching(
        Effect("core_blur", "optics", (_p("variance", "px2", 1.0, True),), "Jitter or defocus widens the core.",
               "an image of a sharp limb or of a point source", ("radius_in_disc", "azimuth_in_disc"), _sought_later, trials=len(BLURS)),
        _core_blur, lambda view, blur: blur_as(view, *blur)),
    _mesh_effect("mesh_rotation", _turned, ANGLES_DEG, _p("angle", "deg", 3.0),
                 "The meshes are rotated relative to the detector.", ("azimuth_in_disc", "detector_x", "detector_y")),
    _mesh_effect("mesh_pitch", _stretched, PITCHES_PCT, _p("stretch", "%", 3.0),
                 "The pitch of the meshes differs from its nominal value.", ("radius_in_disc", "azimuth_in_disc")),
)  # fmt: skip
