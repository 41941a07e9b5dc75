"""A scatter that changes over the field is fitted to a simulated transit, and its PSF shrinks the gap of held-out
images."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from psfcore.convolution.convolver import Convolver
from psfcore.evaluation.evaluation import evaluate
from psfcore.gap.corrected_psf import corrected_psf, psf_of_refit
from psfcore.gap.diagnose import diagnose
from psfcore.gap.field_fit import FieldFit, fit_field
from psfcore.gap.field_terms import directions, held_out_gaps
from psfcore.gap.library.registry import LIBRARY
from psfcore.psf import central_part
from psfcore.scatter.inversion import invert
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from psfcore.transit.transit import Transit
from tests.psfcore.gap.small_gaps import few_sign_flips, small_reach
from tests.psfcore.small_transits import (
    DIFFRACTION,
    SCATTER,
    Plane,
    observed,
    sky,
    true_scene,
    with_pixels,
)

NAMES = ("dark_offset", "core_blur", "field_dependent_scatter", "intensity_gradient")
FEW = tuple(one for one in LIBRARY if one.name in NAMES)
IMAGES, SIZE_PX, BRIGHTNESS = 18, 128, 40.0
X, Y = 0.16, -0.12  # 20 % across the field


def linear(at: Plane) -> Plane:
    """The relative change of the scatter, from the positions -0.5 to 0.5 of the pixels."""
    return np.asarray(X * at + Y * at[:, None])


@cache
def changing(seed: int = 0, change: Callable[[Plane], Plane] = linear) -> Transit:
    """Images of a telescope whose scatter changes over the field, with noise."""
    of = sky(images=IMAGES, size_px=SIZE_PX, brightness=BRIGHTNESS)
    transit, size = observed(of).transit, 2 * SIZE_PX
    kernel = total_kernel(SCATTER, DIFFRACTION, size)
    more = total_kernel(ScatterTruth(SCATTER.b_px, SCATTER.c, 1.1 * SCATTER.total), DIFFRACTION, size)
    through, slope = (
        Convolver(one, transit.shape, dtype=np.float64) for one in (kernel, 10 * (more - kernel))
    )
    at = (np.arange(SIZE_PX) + 0.5) / SIZE_PX - 0.5
    pixels = []
    for n, frame in enumerate(transit.frames):
        scene = true_scene(of, n)
        expected = through.apply(scene) + slope.apply(change(at) * scene)
        pixels.append(transit.noise.observe(expected, frame.exposure_s, np.random.default_rng([seed, n])))
    return with_pixels(transit, pixels)


@cache
def fitted(seed: int = 0) -> FieldFit:
    return fit_field(invert(changing(seed)))


def test_terms_and_total_are_found_and_the_constant_psf_is_rejected() -> None:
    pulls = []
    for seed in range(3):
        values = fitted(seed).corrected.values
        pulls += [(values[name][0] - truth) / values[name][1] for name, truth in (("x", X), ("y", Y))]
        assert abs(fitted(seed).corrected.solution.inversion.values["total"] - SCATTER.total) < 0.005
    # In 16 transits of two brightnesses, the pulls of x and y had an rms of 1.2 and no bias.
    assert np.abs(pulls).max() < 3 and np.sqrt(np.mean(np.square(pulls))) < 1.8, pulls
    found = fitted()
    assert found.p_value < 1e-4 and found.gain > 20
    assert found.gaps is not None and found.gaps.images == IMAGES
    assert found.gaps.with_terms.value < found.gaps.without_terms.value
    json.dumps(found.to_json(), allow_nan=False)


def test_the_psf_has_the_terms_and_explains_the_discs() -> None:
    with small_reach():
        psf = psf_of_refit(fitted().corrected, "changing", "1", {})
        small = central_part(psf, 2 * SIZE_PX - 1)
        for u, v in ((1.0, 0.0), (-1.0, 1.0)):
            at = (X * u + Y * v) * (SIZE_PX - 1) / (2 * SIZE_PX)
            total = SCATTER.total * (1 + at)
            kernel = total_kernel(ScatterTruth(SCATTER.b_px, SCATTER.c, total), DIFFRACTION, 513)
            middle = kernel.shape[0] // 2
            beyond = [
                1 - one[middle - 4 : middle + 5, middle - 4 : middle + 5].sum()
                for one in (psf.at(u, v), kernel)
            ]
            assert beyond[0] == pytest.approx(beyond[1], abs=0.015), "the errors of the fit"
    assert psf.place is not None and psf.place.detector == (SIZE_PX, SIZE_PX)
    rms = []
    for one in (small, small.kernel):
        found = evaluate(changing(), lambda n, one=one: one, noise_realisations=0)  # type: ignore[misc]
        rms.append(np.sqrt(np.mean([frame.residual_pct**2 for frame in found.frames])))
    assert rms[0] < rms[1], "a report uses the terms"


def test_another_form_of_the_change_gets_terms_too() -> None:
    """A saddle is no effect of the library; its corrected PSF has the terms that come nearest."""
    with few_sign_flips():
        found = diagnose(changing(1, lambda at: 0.8 * at * at[:, None]), library=FEW)
    assert found.answer.named == () and found.told is not None
    assert found.told.names == ("another_psf_place",) and found.corrected is not None
    with small_reach():
        psf = corrected_psf(found, "corrected", "1", {})
    assert {(term.x_power, term.y_power) for term in psf.field_terms} == {(1, 0), (0, 1), (2, 0), (0, 2)}
    gaps = held_out_gaps(found.solution, found.model, found.corrected)
    assert gaps is not None and gaps.with_terms.value < 0.6 * gaps.without_terms.value


def test_one_track_cannot_tell_x_from_y_and_says_so() -> None:
    along = np.array([0.8, 0.6])
    across = np.array([-0.6, 0.8])
    covariance = 0.02**2 * np.outer(along, along) + 0.3**2 * np.outer(across, across)
    told = directions([0.16, 0.12], covariance)
    assert "cannot tell x from y" in told and "37 degrees" in told and "127 degrees" in told
    assert "+20.0 ± 2.0 %" in told and "-20.0 ± 2.0 %" in directions([-0.16, -0.12], covariance)
    assert "cannot" not in directions([0.16, 0.12], 0.03**2 * np.eye(2))
