"""The occulter's place on transits whose truth is known, and the geometry of its disc."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.noise import Noise
from psfcore.simulate.plan import Shot, default_plan
from psfcore.simulate.sky import TrueSky, covered_share, true_sky
from psfcore.transit import occulter
from psfcore.transit.occulter import (
    LEAST_NEIGHBOURS,
    PATCH_MARGIN_PX,
    FoundPlace,
    coverage,
    find_occulter,
    fully_dark,
    neighbours_of,
)
from psfcore.transit.transit import Frame, Place, Transit
from tests.psfcore.small_transits import (
    BRIGHT,
    DIFFRACTION,
    IMAGES,
    SCATTER,
    SIZE_PX,
    noise_free,
    observed,
    sky,
    true_scene,
    with_pixels,
)

RADIUS_PX = 10.75
PLACES = [Place(20.0, 20.0, RADIUS_PX), Place(20.3, 18.77, RADIUS_PX), Place(19.5, 20.5, 6.2)]


# --- the disc ---------------------------------------------------------------------------------------------


def test_covered_area_and_dark_pixels_are_those_of_the_disc() -> None:
    for place in PLACES:
        share = coverage((41, 40), place)
        assert share.sum() == pytest.approx(np.pi * place.radius_px**2, rel=1e-3)
        np.testing.assert_allclose(share, covered_share(place, (0, 0), (41, 40), 1), atol=0.02)
        assert share.min() == 0 and share.max() == pytest.approx(1, abs=1e-12)
    # It changes smoothly: every step covers and uncovers the width of the disc times the step.
    step, start = 0.05, Place(20.0, 20.0, RADIUS_PX)
    for axis in ("x_px", "y_px"):
        moved = [coverage((41, 40), dataclasses.replace(start, **{axis: 20.0 + step * k})) for k in range(41)]
        change = np.array([np.abs(b - a).sum() for a, b in itertools.pairwise(moved)])
        np.testing.assert_allclose(change, 4 * RADIUS_PX * step, rtol=0.03)
    y, x = np.indices((41, 40))
    on_the_circle = Place(20.5, 20.5, 5.0)  # eight corners, 3 px and 4 px from the centre, lie on the edge
    for place in (*PLACES, Place(3.0, 38.2, RADIUS_PX), Place(-30.0, 10.0, RADIUS_PX), on_the_circle):
        farthest = np.hypot(abs(y - place.y_px) + 0.5, abs(x - place.x_px) + 0.5)
        for margin_px in (0.0, 1.3):
            dark = fully_dark((41, 40), place, margin_px)
            np.testing.assert_array_equal(dark, farthest <= place.radius_px - margin_px)


# --- finding it -------------------------------------------------------------------------------------------


def found_in(
    of: TrueSky, transit: Transit, indices: Sequence[int], *, ephemeris_sigma_px: float = 1.0
) -> list[FoundPlace]:
    """The places found in some frames, with the true scenes and PSF."""
    scenes = [true_scene(of, n).astype(np.float32) for n in range(len(transit.frames))]
    known = (transit.frames, scenes.__getitem__, places_of(transit), of.kernel, transit.noise)
    with patch.object(occulter, "EPHEMERIS_SIGMA_PX", ephemeris_sigma_px):
        return [find_occulter(n, *known) for n in indices]


def errors(of: TrueSky, found: Sequence[FoundPlace], indices: Sequence[int]) -> NDArray[np.float64]:
    exact = [of.plan.place(n) for n in indices]
    return apart([f.place for f in found], exact)


def apart(places: Sequence[Place], exact: Sequence[Place]) -> NDArray[np.float64]:
    """Errors of places, (n, 2), px."""
    pairs = zip(places, exact, strict=True)
    return np.array([(place.x_px - true.x_px, place.y_px - true.y_px) for place, true in pairs])


EVERY = range(IMAGES)


def test_without_noise_places_are_exact() -> None:
    """The ephemeris has errors of 0.6 px. The remaining errors come from the occulters of the neighbours."""
    of = sky(brightness=BRIGHT)
    for sigma_px, tolerance_px in ((100.0, 0.02), (1.0, 0.02)):
        found = found_in(of, noise_free(of), EVERY, ephemeris_sigma_px=sigma_px)
        assert np.abs(errors(of, found, EVERY)).max() < tolerance_px
        assert all(f.settled and f.seen and f.neighbours > 0 for f in found)
        assert all(f.place.radius_px == RADIUS_PX for f in found)
        assert [f.depth for f in found] == pytest.approx([1.0] * IMAGES, abs=0.05)
    reported = apart(places_of(noise_free(of)), [of.plan.place(n) for n in EVERY])
    assert np.hypot(*reported.T).max() > 1


def test_frames_without_light_and_without_read_noise_have_finite_places() -> None:
    """A full refit can subtract more light than a frame has."""
    of = sky()
    bright = noise_free(of)
    frames = tuple(dataclasses.replace(f, pixels=f.pixels - f.pixels.max()) for f in bright.frames)
    dark = dataclasses.replace(bright, frames=frames, noise=Noise(6.0, 0.0))
    (found,) = found_in(of, dark, [4])
    assert np.isfinite([found.place.x_px, found.place.y_px, found.depth]).all()


def test_errors_on_the_disc_agree_with_the_stated_ones() -> None:
    of, on_disc = sky(), range(4, 8)
    pulls = []
    for seed in range(5):
        found = found_in(of, observed(of, seed).transit, on_disc)
        stated = np.array([(f.sigma_x_px, f.sigma_y_px) for f in found])
        assert np.all((stated > 0.001) & (stated < 0.05))
        assert 0.8 < np.mean([f.chi2_per_pixel for f in found]) < 1.2
        pulls.append(errors(of, found, on_disc) / stated)
    assert 0.7 < np.std(pulls) < 1.5  # 40 of them
    assert np.abs(pulls).max() < 4.5


def test_far_off_the_limb_faint_places_are_found_to_two_pixels() -> None:
    of = sky(brightness=1.0)
    found = found_in(of, observed(of, 0).transit, EVERY)
    assert np.hypot(*errors(of, found, EVERY).T).max() < 2
    assert all(f.seen for f in found)


def test_the_ephemeris_has_more_weight_if_the_sun_changed() -> None:
    """The structure of one image differs: its neighbours do not show the scene behind its disc."""
    of = sky(brightness=4.0)
    transit = noise_free(of)
    y, x = np.indices((SIZE_PX, SIZE_PX))
    for n in EVERY[::3]:
        exact = of.plan.place(n)
        patches = np.sin((x - exact.x_px) / 7.0 + 1.0) * np.cos((y - exact.y_px) / 9.0 + 2.0)
        pixels = [f.pixels * np.exp(1.5 * patches * (k == n)) for k, f in enumerate(transit.frames)]
        changed = displaced(with_pixels(transit, pixels), n, exact)
        found = found_in(of, changed, [n], ephemeris_sigma_px=0.2)[0]
        assert found.chi2_per_pixel > 3.0 and found.seen
        # By the images alone it would be 1 to 6 px in most of them.
        assert np.hypot(*apart([found.place], [exact])[0]) < 0.7


def test_image_and_ephemeris_are_weighted_by_their_errors() -> None:
    """The fit moves from the ephemeris towards the truth by a share 1 - sigma^2, if the error of the ephemeris is 1."""
    of, exact = sky(), sky().plan.place(5)
    reported = Place(exact.x_px + 1.0, exact.y_px - 1.0, RADIUS_PX)
    for read_noise_dn in (1e4, 3e4, 6e4, 1e7):
        transit = displaced(noise_free(of), 5, reported)
        transit = dataclasses.replace(transit, noise=Noise(6.0, read_noise_dn))
        found = found_in(of, transit, [5])[0]
        gone = (reported.x_px - found.place.x_px, found.place.y_px - reported.y_px)
        assert gone == pytest.approx((1 - found.sigma_x_px**2, 1 - found.sigma_y_px**2), abs=0.1)
    assert max(gone) < 0.05, "an image without information"


def displaced(transit: Transit, index: int, place: Place) -> Transit:
    frames = list(transit.frames)
    frames[index] = dataclasses.replace(frames[index], place=place)
    return dataclasses.replace(transit, frames=tuple(frames))


def test_a_wrong_ephemeris_is_corrected_reported_or_refused() -> None:
    of = sky(brightness=BRIGHT)
    exact = of.plan.place(5)
    near = Place(exact.x_px + 2.5, exact.y_px - 3.0, RADIUS_PX)
    found = found_in(of, displaced(noise_free(of), 5, near), [5])
    assert np.abs(errors(of, found, [5])).max() < 0.03
    far = Place(exact.x_px + 30.0, exact.y_px + 40.0, RADIUS_PX)
    lost = found_in(of, displaced(noise_free(of), 5, far), [5])[0]
    assert not lost.seen
    pixels = [frame.pixels for frame in noise_free(of).frames]
    pixels[6] = of.seen_scenes[2].astype(np.float32)  # an image without an occulter
    assert not found_in(of, with_pixels(noise_free(of), pixels), [6])[0].seen
    for x_px, y_px in ((-12.0, 60.0), (60.0, SIZE_PX + 11.0), (np.nan, 60.0)):
        with pytest.raises(DataError, match=r"005\.fits: .*; got x = ") as caught:
            displaced(noise_free(sky()), 5, Place(x_px, y_px, RADIUS_PX))
        assert caught.value.code == "occulter-outside"


# --- neighbours -------------------------------------------------------------------------------------------


def overlap(one: Place, other: Place) -> bool:
    """Whether the second disc overlaps the square around the first."""
    reach = one.radius_px + PATCH_MARGIN_PX + other.radius_px
    return abs(one.x_px - other.x_px) <= reach and abs(one.y_px - other.y_px) <= reach


def places_of(transit: Transit) -> list[Place]:
    return [frame.place for frame in transit.frames]


def test_neighbours_show_the_patch_and_are_the_nearest_in_time() -> None:
    """A bright sky needs four neighbours, a faint one more."""
    for brightness, most in ((0.02, 8), (500.0, LEAST_NEIGHBOURS)):
        transit = observed(sky(images=30, size_px=192, brightness=brightness)).transit
        assert most == max(len(neighbours) for neighbours in checked_neighbours(transit))


def checked_neighbours(transit: Transit) -> list[list[int]]:
    """Check the neighbours of all frames: no overlap, same pointing, nearest in time, four if available."""
    places, found = places_of(transit), []
    for n, frame in enumerate(transit.frames):
        chosen = neighbours_of(n, transit.frames, places, transit.noise)
        free = [
            k
            for k, other in enumerate(transit.frames)
            if k != n and other.pointing == frame.pointing and not overlap(places[n], places[k])
        ]
        assert set(chosen) <= set(free)
        waits = [abs(transit.frames[k].time_s - frame.time_s) for k in chosen]
        assert waits == sorted(waits)
        left = [abs(transit.frames[k].time_s - frame.time_s) for k in set(free) - set(chosen)]
        assert min(left, default=np.inf) >= max(waits)
        assert len(chosen) >= min(LEAST_NEIGHBOURS, len(free))
        found.append(chosen)
    return found


def even_sky(shots: tuple[Shot, ...]) -> TrueSky:
    """A Sun of uniform brightness with a texture of 5 %."""
    plan = dataclasses.replace(default_plan(3, SIZE_PX, oversampling=1), shots=shots)
    rng = np.random.default_rng(1)
    scenes = {pointing: 2000 * rng.normal(1, 0.05, (SIZE_PX, SIZE_PX)) for pointing in plan.pointings}
    return true_sky(plan, SCATTER, DIFFRACTION, 1, scenes=scenes)


def shot(pointing: int, x_px: float, y_px: float) -> Shot:
    return Shot(pointing, x_px, y_px, 1.8, "high-only", 60.0 * pointing)


def test_without_neighbours_a_homogeneous_sun_gives_the_place_to_a_tenth_of_a_pixel() -> None:
    of = even_sky((shot(1, 60.3, 70.8), shot(2, 40.5, 30.1), shot(3, 90.0, 90.0)))
    for transit in (noise_free(of), observed(of).transit):
        found = found_in(of, transit, range(3))
        assert [f.neighbours for f in found] == [0, 0, 0]
        assert np.abs(errors(of, found, range(3))).max() < 0.1
        assert all(f.seen for f in found)


def test_without_neighbours_a_structured_sun_gives_a_large_error() -> None:
    """The mean of a ring does not describe the scene; the misfit increases the errors, up to that of the ephemeris."""
    of = sky()
    shown = observed(of).transit
    alone = dataclasses.replace(
        shown, frames=tuple(dataclasses.replace(f, pointing=n) for n, f in enumerate(shown.frames, start=1))
    )
    on_disc = range(4, 8)
    with_neighbours = found_in(of, shown, on_disc)
    for sigma_px in (1.0, 0.1):
        found = found_in(of, alone, on_disc, ephemeris_sigma_px=sigma_px)
        assert all(f.neighbours == 0 and f.chi2_per_pixel > 50 for f in found)
        for one, other in zip(found, with_neighbours, strict=True):
            assert 5 * other.sigma_x_px < one.sigma_x_px < sigma_px
            assert 5 * other.sigma_y_px < one.sigma_y_px < sigma_px


def test_a_disc_that_touches_the_edge_is_found() -> None:
    """Also a disc that the edge of the field cuts: the first columns of the field are removed."""
    of = even_sky((shot(1, RADIUS_PX, 60.2), shot(1, 60.0, 60.0), shot(1, 100.4, SIZE_PX - 1 - RADIUS_PX)))
    found = found_in(of, noise_free(of), range(3), ephemeris_sigma_px=10.0)
    assert np.abs(errors(of, found, range(3))).max() < 0.03
    cut = [crop(frame, 8) for frame in noise_free(of).frames]
    scenes = [true_scene(of, n)[:, 8:].astype(np.float32) for n in range(3)]
    one = find_occulter(0, cut, scenes.__getitem__, [f.place for f in cut], of.kernel, of.plan.noise)
    assert (one.place.x_px, one.place.y_px) == pytest.approx((RADIUS_PX - 8, 60.2), abs=0.1)


def crop(frame: Frame, columns: int) -> Frame:
    place = dataclasses.replace(frame.place, x_px=frame.place.x_px - columns)
    return dataclasses.replace(frame, pixels=frame.pixels[:, columns:], place=place)
