"""Probes: patterns that are typical of gaps of unknown cause.

No verdict names a probe as the cause of a gap. If a probe explains a gap clearly better than every effect of the library,
the cause is probably not in the library. The report then says which probes the gap resembles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from psfcore.gap.effect import Change, Effect, EffectParameter
from psfcore.gap.evidence.search import place_search
from psfcore.gap.library.detector import cosine_parameters, cosines, fixed, flat, times_image
from psfcore.gap.library.optics import (
    AMOUNT,
    by_psf,
    by_psf_in_time,
    core_slope,
    not_a_power_law,
    shape_slopes,
)
from psfcore.gap.library.scene import COARSE_PX, RIDGE, STRUCTURE_PX, on_pixels, unocculted_on_coarse
from psfcore.gap.view import Field, View
from psfcore.transit.occulter import coverage

Plane = NDArray[np.float64]

# Standard deviation of a patch of light or shadow, as a fraction of the shorter side of the field.
PATCH_SHARE = 0.08
PATCH_TRIALS = 60
LEAST_EXPOSURES = 2


def _hours(view: View, n: int) -> float:
    frames = view.solution.transit.frames
    return (frames[n].time_s - float(np.mean([f.time_s for f in frames]))) / 3600


def _patch(view: View, *, of_image: bool, sign: float) -> Field:
    ny, nx = view.solution.transit.shape
    width = PATCH_SHARE * min(ny, nx)
    x, y = place_search(view).place(width, of_image=of_image, sign=sign)
    up = np.exp(-0.5 * ((np.arange(ny) - y) / width) ** 2)
    along = np.exp(-0.5 * ((np.arange(nx) - x) / width) ** 2)
    return np.asarray(up[:, None] * along[None, :], dtype=np.float32)


def _glow(view: View) -> Sequence[Change]:
    return [fixed(_patch(view, of_image=False, sign=1.0))]


def _shadow(view: View) -> Sequence[Change]:
    return [times_image(-_patch(view, of_image=True, sign=-1.0))]


def _structured(view: View) -> Sequence[Change]:
    return [fixed(cosine) for cosine in (flat(view), *cosines(view))]


def _planes_of_pointings(view: View) -> Sequence[Change]:
    frames = view.solution.transit.frames

    def one(pointing: int, plane: Field) -> Change:
        nothing = np.zeros_like(plane)
        return Change(
            lambda n, images: plane if frames[n].pointing == pointing else nothing, unocculted=False
        )

    x, y = view.places
    pointings = sorted({f.pointing for f in frames})
    return [one(pointing, plane) for pointing in pointings for plane in (flat(view), x, y)]


def _drift(view: View) -> Sequence[Change]:
    one = flat(view)

    def power(k: int) -> Change:
        return Change(lambda n, images: one * np.float32(_hours(view, n) ** k))

    return [power(1), power(2)]


def _dark_drift(view: View) -> Sequence[Change]:
    one = flat(view)

    def power(k: int) -> Change:
        return Change(lambda n, images: one * np.float32(_hours(view, n) ** k / view.exposure_s(n)))

    return [power(1), power(2)]


def _focus_drift(view: View) -> Sequence[Change]:
    return [by_psf_in_time(view, core_slope(view), lambda n: _hours(view, n))]


def _scatter_drift(view: View) -> Sequence[Change]:
    return [by_psf_in_time(view, view.slopes[AMOUNT], lambda n: _hours(view, n))]


def _one_sided(view: View) -> Sequence[Change]:
    return [by_psf(view, blur) for blur in shape_slopes(view, "one-sided", (3, 4))]


def _bent(view: View) -> Sequence[Change]:
    return [by_psf(view, blur) for blur in shape_slopes(view, "knee", (3,))]


def _rows(view: View) -> Sequence[Change]:
    def change(n: int, images: Sequence[Field]) -> Field:
        return np.broadcast_to(images[n].mean(axis=1, keepdims=True, dtype=np.float32), images[n].shape)

    return [Change(change, unocculted=False)]


def _bright(view: View) -> Sequence[Change]:
    scale = np.float32(max(float(np.mean(plane)) for plane in view.pointing_means))
    return [Change(lambda n, images: np.asarray(-images[n] * images[n] / scale))]


def _shutter(view: View) -> Sequence[Change]:
    def along(place: Field) -> Change:
        return Change(lambda n, images: np.asarray(images[n] * place / np.float32(view.exposure_s(n))))

    return [along(place) for place in view.places]


def _read_pattern(view: View) -> Sequence[Change]:
    """A pattern that is the same in every readout at all pointings, scaled to 1 DN rms.

    The pattern is measured in the unocculted field. In DN/s it is proportional to 1 / exposure time, so it can be measured
    where the images of a pointing differ in exposure time.
    """
    frames = view.solution.transit.frames
    readouts = np.array([1 / frame.exposure_s for frame in frames])
    over, under, shown = (sum(some) for some in zip(*_in_pointings(view, readouts), strict=True))
    least = max(RIDGE * float(np.max(under)), 1e-300)  # damps pixels that few images show
    pattern = gaussian_filter(over / (under + least), STRUCTURE_PX / COARSE_PX)
    pattern -= pattern.mean()  # the mean is left to the effect dark_offset
    plane = on_pixels(pattern / max(float(pattern.std()), 1e-9), view.solution.transit.shape)
    return [
        Change(lambda n, _: plane * np.float32(readouts[n]), disc=False, numbers=int(np.count_nonzero(shown)))
    ]


def _in_pointings(view: View, readouts: Plane) -> Iterator[tuple[Plane, Plane, Plane]]:
    """The terms of a fit of the readout pattern, with a free scene, for each pointing with several exposure times.

    Yields for each pointing: the numerator and the denominator of the pattern on coarse pixels [y, x], summed over the
    images; and whether each block contributes (blocks,). readouts: 1 / exposure time of each image, 1/s.
    """
    frames = view.solution.transit.frames
    for pointing in _pointings_of_exposures(view):
        here = [n for n, frame in enumerate(frames) if frame.pointing == pointing]
        seen, weight, free = unocculted_on_coarse(view, here)
        total = np.maximum(weight.sum(axis=0), 1)
        scene = (seen * weight).sum(axis=0) / total
        a_second = readouts[here][:, None, None]
        differing = a_second - (a_second * weight).sum(axis=0) / total
        yield (
            (weight * differing * (seen - scene)).sum(axis=0),
            (weight * differing**2).sum(axis=0),
            np.asarray(free > 1, dtype=np.float64),
        )


def _pointings_of_exposures(view: View) -> list[int]:
    """The pointings whose images differ in exposure time."""
    frames = view.solution.transit.frames
    kinds = {(frame.pointing, frame.exposure_s) for frame in frames}
    return [
        pointing
        for pointing in sorted({f.pointing for f in frames})
        if sum(k[0] == pointing for k in kinds) >= LEAST_EXPOSURES
    ]


def _no_pointing_of_exposures(view: View) -> str | None:
    return None if _pointings_of_exposures(view) else "no pointing has images with different exposure times"


def _one_exposure(view: View) -> str | None:
    exposures = {frame.exposure_s for frame in view.solution.transit.frames}
    return None if len(exposures) >= LEAST_EXPOSURES else "all images have the same exposure time"


def _lit_occulter(view: View) -> Sequence[Change]:
    """An occulter that is not dark. Two changes: uniform light on its disc, and light that increases towards its rim."""
    optics, shape = view.solution.optics, view.solution.transit.shape

    def disc(n: int, power: int) -> Field:
        place = view.solution.sky.found[n].place
        dy, dx = np.ogrid[: shape[0], : shape[1]]
        squared = ((dx - place.x_px) ** 2 + (dy - place.y_px) ** 2) / place.radius_px**2
        light = coverage(shape, place) * np.minimum(squared, 1.0) ** power
        return optics.field(optics.convolve(optics.lanes(light.astype(np.float32))))

    return [Change(lambda n, images, k=k: disc(n, k), unocculted=False) for k in (0, 1)]  # type: ignore[misc]


def _p(*names: str) -> tuple[EffectParameter, ...]:
    return tuple(EffectParameter(name, "", math.inf) for name in names)


def _probe(name, stage, parameters, form, axes, changes, why_not=lambda view: None, trials=1, field=False):  # type: ignore[no-untyped-def]
    return Effect(name, stage, parameters, form, "", axes, changes, why_not, trials, named=False, field=field)


PROBES: tuple[Effect, ...] = (
    _probe("patch_of_light", "detector", _p("height"), "a patch of added light, fixed on the detector",
           ("detector_x", "detector_y"), _glow, trials=PATCH_TRIALS),
    _probe("patch_of_shadow", "detector", _p("depth"), "a patch of lost light, fixed on the detector",
           ("detector_x", "detector_y"), _shadow, trials=PATCH_TRIALS),
    _probe("structured_light", "detector", (EffectParameter("level", "DN/s", 2.0), *cosine_parameters("DN/s", 0.4)),
           "added light with smooth structure, fixed on the detector", ("detector_x", "detector_y"), _structured, field=True),
    _probe("drifting_light", "scene", _p("linear", "quadratic"), "added light that drifts with time", ("time",), _drift),
    _probe("drifting_dark_level", "detector", _p("linear", "quadratic"), "a dark level that drifts with time",
           ("time", "exposure"), _dark_drift),
    _probe("drifting_focus", "optics", _p("rate"), "a core that widens with time", ("time",), _focus_drift),
    _probe("drifting_scatter", "optics", _p("rate"), "scatter that grows with time", ("time",), _scatter_drift,
           not_a_power_law),
    _probe("one_sided_scatter", "optics", _p("x_share", "y_share"), "scatter that is stronger on one side",
           ("azimuth_in_disc",), _one_sided, not_a_power_law),
    _probe("bent_scatter", "optics", _p("bend"), "scatter that falls off faster or more slowly at large distances",
           ("scattering_distance",), _bent, not_a_power_law),
    _probe("light_along_rows", "detector", _p("share"), "a fraction of the light of each row, spread along the row",
           ("detector_y", "intensity"), _rows),
    _probe("bright_loss", "detector", _p("loss"), "bright pixels that are read too low", ("intensity",), _bright),
    _probe("uneven_shutter", "detector", _p("x", "y"), "an exposure time that varies across the field",
           ("exposure", "detector_x", "detector_y"), _shutter, _one_exposure),
    _probe("readout_pattern", "detector", (EffectParameter("rms", "DN", 2.0, True),),
           "a pattern that is the same in every readout", ("detector_x", "detector_y", "exposure"), _read_pattern,
           _no_pointing_of_exposures),
    _probe("lit_occulter", "scene", _p("level", "rim"), "an occulter that is not dark",
           ("radius_in_disc",), _lit_occulter),
    _probe("light_by_pointing", "scene", _p(*(f"{k}" for k in range(9))), "added light that differs by pointing",
           ("pointing",), _planes_of_pointings),
)  # fmt: skip
