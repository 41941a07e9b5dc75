"""Transits so small that a fit takes a second, their truth, and fits of them that many tests use."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache, partial
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from psfcore.psf import crop_or_pad, cumulative_curve
from psfcore.scatter import fit
from psfcore.scatter.as_published import Choices, Published, free_fit, invert_as_published
from psfcore.scatter.fit import TransitFit, fit_transit
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Solution
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from psfcore.simulate.sky import TrueSky, true_sky
from psfcore.simulate.transit import SimulatedTransit, observed_transit
from psfcore.transit.transit import Transit
from tests.psfcore.conftest import gaussian

Plane = NDArray[np.float64]

IMAGES, SIZE_PX, BRIGHTNESS = 12, 128, 5.0
BRIGHT = 200.0  # enough light that the images determine the places, not the ephemeris
SCATTER = ScatterTruth(6.15, 2.53, 0.411)
STRETCHED = ScatterTruth(6.15, 2.53, 0.411, stretch=0.15, angle_deg=-15.0)
TRUE_VALUES = {"b_px": 6.15, "c": 2.53, "total": 0.411}
# One percent of the light is scattered farther than 50 px.
COMPACT = ScatterTruth(6.0, 4.0, 0.4)
FAINT = 0.3  # factor on the brightness of a sky: discs of a few DN/s


def diffraction() -> Plane:
    """A core as sharp as that of HRI_EUV, with a tenth of the light in wings, 31 px, sum 1."""
    y, x = np.indices((31, 31)) - 15
    wings = (1 + (x**2 + y**2) / 9) ** -1.6
    return np.asarray(0.9 * gaussian(31, 0.4) + 0.1 * wings / wings.sum())


DIFFRACTION = diffraction()


@cache
def sky(
    scatter: ScatterTruth = SCATTER,
    images: int = IMAGES,
    size_px: int = SIZE_PX,
    brightness: float = BRIGHTNESS,
    ephemeris_error_px: float = 0.6,
) -> TrueSky:
    """A sky on whole pixels, dark beyond the field."""
    plan = default_plan(
        images, size_px, oversampling=1, brightness=brightness, ephemeris_error_px=ephemeris_error_px
    )
    return true_sky(plan, scatter, DIFFRACTION, 3)


@cache
def observed(of: TrueSky, seed: int = 3) -> SimulatedTransit:
    """A transit of a sky, with noise."""
    return observed_transit(of, seed)


@cache
def noise_free(of: TrueSky, seed: int = 3) -> Transit:
    """The same transit without noise; the errors of the ephemeris are those of the noisy one."""
    transit = observed(of, seed).transit
    return with_pixels(transit, [of.expected(n) for n in range(len(of.plan.shots))])


def with_pixels(transit: Transit, pixels: Sequence[NDArray[np.floating]]) -> Transit:
    """A transit with other pixels."""
    frames = zip(transit.frames, pixels, strict=True)
    changed = tuple(dataclasses.replace(f, pixels=p.astype(np.float32)) for f, p in frames)
    return dataclasses.replace(transit, frames=changed)


def true_scene(of: TrueSky, index: int) -> Plane:
    """The scene of an image with its margins, without the light that the occulter hides."""
    scene, around = of.scenes[of.plan.shots[index].pointing].copy(), of.behind[index]
    scene[around.window(of.plan.margin_px)] -= around.hidden(of.plan.place(index))
    return np.asarray(np.maximum(scene, 0.0))  # rounding gives -1e-14 for a hidden pixel


@cache
def solved() -> Solution:
    """The inversion of the noisy transit."""
    return invert(observed(sky()).transit)


@cache
def solved_noise_free() -> Solution:
    """The inversion of a transit without noise, of a brighter sky."""
    return invert(noise_free(sky(brightness=BRIGHT)))


@cache
def faint() -> Transit:
    """Nine faint images with compact scatter; the known part of the PSF has an array about as large as the images."""
    made = observed(sky(COMPACT, images=9, size_px=96, brightness=FAINT)).transit
    return dataclasses.replace(made, diffraction=crop_or_pad(DIFFRACTION, 95))


@cache
def recipe(choices: Choices) -> tuple[Published, list[str]]:
    """The result of the published recipe for the faint images, and the stages that it reported."""
    seen: list[str] = []
    found = invert_as_published(faint(), choices, subsets=3, progress=lambda stage, *_: seen.append(stage))
    return found, seen


@cache
def fitted_with_progress() -> tuple[TransitFit, list[tuple[str, int, int]]]:
    """The whole fit of the noisy transit, and its progress; free shells from 20 draws, which are quicker than 100."""
    seen: list[tuple[str, int, int]] = []
    with patch.object(fit, "free_fit", partial(free_fit, subsets=20)):
        return fit_transit(observed(sky()).transit, progress=lambda *at: seen.append(at)), seen


def fitted() -> TransitFit:
    """The whole fit of the noisy transit."""
    return fitted_with_progress()[0]


@cache
def true_curve(radii_px: tuple[float, ...], scatter: ScatterTruth = SCATTER) -> Plane:
    """C(R) of the true total PSF, percent, on the full reach."""
    return cumulative_curve(total_kernel(scatter, DIFFRACTION), radii_px)
