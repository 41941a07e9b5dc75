"""For a homogeneous Sun the first guess is the light beyond the occulter's radius."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.noise import Noise
from psfcore.psf import cumulative_curve
from psfcore.transit.first_guess import ESTIMATORS, first_guess
from psfcore.transit.transit import Frame, Place, Transit, folds

SIZE = 160
RADIUS_PX = 6.0
Flat = NDArray[np.float64]


def wide_kernel() -> Flat:
    """A core and wings; sum 1 on 161 px."""
    y, x = np.indices((161, 161)) - 80
    wings = 1.0 / (3.0 + np.hypot(x, y)) ** 3
    wings[80, 80] = 0.0
    kernel = 0.4 * wings / wings.sum()
    kernel[80, 80] = 0.6
    return np.asarray(kernel)


def seen(scene: Flat, place: Place, kernel: Flat) -> Flat:
    """A scene with a dark disc, convolved with the PSF; beyond the frame it continues with the values of its edge."""
    y, x = np.indices(scene.shape)
    dark = np.hypot(x - place.x_px, y - place.y_px) <= place.radius_px
    pad = 81
    return Convolver(kernel, (SIZE + 2 * pad,) * 2).apply(
        np.pad(np.where(dark, 0.0, scene), pad, mode="edge")
    )[pad:-pad, pad:-pad]


def transit_of(*frames: tuple[Flat, int, Place]) -> Transit:
    made = tuple(
        Frame(
            file=f"{index}.fits",
            pixels=pixels.astype(np.float32),
            pointing=pointing,
            place=place,
            exposure_s=1.0,
            time_s=60.0 * index,
        )
        for index, (pixels, pointing, place) in enumerate(frames)
    )
    return Transit(frames=made, diffraction=wide_kernel(), noise=Noise(1.0, 1.0))


@pytest.fixture(scope="module")
def two_pointings() -> Transit:
    """A limb in pointing 1, a homogeneous Sun in pointing 2."""
    even, limb = np.full((SIZE, SIZE), 100.0), np.full((SIZE, SIZE), 100.0)
    limb[:, 90:] = 2.0
    places = [Place(70.0 + 5 * i, 80.0, RADIUS_PX) for i in range(3)]
    kernel = wide_kernel()
    return transit_of(
        *((seen(limb, place, kernel), 1, place) for place in places),
        *((seen(even, place, kernel), 2, place) for place in places),
    )


def test_for_a_homogeneous_sun_it_is_the_light_beyond_the_radius(
    two_pointings: Transit,
) -> None:
    guess = first_guess(two_pointings)
    truth = float(cumulative_curve(wide_kernel(), RADIUS_PX)) / 100
    assert 0.1 < truth < 0.3
    assert guess.best_pointing == 2 and guess.radius_px == RADIUS_PX
    assert guess.share == pytest.approx(truth, rel=0.05)
    assert guess.share_spread < 0.02 * guess.share
    limb, even = guess.pointings
    assert (limb.pointing, limb.images, even.pointing, even.images) == (1, 3, 2, 3)
    assert limb.inhomogeneity > 10 * even.inhomogeneity
    assert all(even.mean[name] == pytest.approx(truth, rel=0.05) for name in ESTIMATORS)
    assert limb.scatter["image_mean"] > 5 * even.scatter["image_mean"]
    content = json.loads(json.dumps(guess.to_json(), allow_nan=False))
    assert [frame["time_s"] for frame in content["frames"]] == [60.0 * i for i in range(6)]
    assert set(content["frames"][0]["ratio"]) == set(ESTIMATORS)
    frame = two_pointings.frames[4]
    pixels, filled = frame.pixels.copy(), np.zeros(frame.pixels.shape, dtype=bool)
    filled[80, round(frame.place.x_px)] = filled[80, round(frame.place.x_px) + 20] = True
    pixels[filled] = 1e4
    marked = Transit(
        frames=(Frame("a", pixels, 1, frame.place, 1.0, 0.0, filled=filled),),
        diffraction=wide_kernel(),
        noise=Noise(1.0, 1.0),
    )
    assert first_guess(marked).frames[0].centre_dn_s == pytest.approx(
        first_guess(two_pointings).frames[4].centre_dn_s, rel=0.01
    )


def test_the_estimators_agree_with_their_names() -> None:
    """Known numbers: 30 in the disc, 100 in the shell, 60 beyond it, and one pixel of 10^6."""
    y, x = np.indices((SIZE, SIZE))
    r = np.hypot(x - 80, y - 75)
    pixels = np.select([r <= RADIUS_PX + 2, r <= RADIUS_PX + 52], [30.0, 100.0], 60.0)
    pixels[0, 0] = 1e6
    frame = first_guess(transit_of((pixels, 1, Place(80.0, 75.0, RADIUS_PX)))).frames[0]
    assert frame.characteristic_dn_s == pytest.approx(
        {"image_mean": pixels.mean(), "image_median": 60.0, "shell": 100.0}
    )
    assert frame.ratio == pytest.approx({"image_mean": 30 / pixels.mean(), "image_median": 0.5, "shell": 0.3})


def test_missing_ratios_are_null(two_pointings: Transit) -> None:
    """An occulter whose centre is outside the frame, and a frame without light."""
    frame = two_pointings.frames[4]
    outside = (frame.pixels.astype(np.float64), 3, Place(-5.0, 80.0, RADIUS_PX))
    night = (np.full((SIZE, SIZE), -1.0), 4, frame.place)
    good = (frame.pixels.astype(np.float64), 2, frame.place)
    guess = first_guess(transit_of(outside, night, good))
    assert guess.best_pointing == 2 and math.isnan(guess.frames[0].centre_dn_s)
    content = guess.to_json()
    assert content["frames"][0]["ratio"] == dict.fromkeys(ESTIMATORS)
    assert content["frames"][1]["ratio"] == dict.fromkeys(ESTIMATORS)
    assert content["pointings"][2]["inhomogeneity"] is None
    json.dumps(content, allow_nan=False)
    with pytest.raises(DataError, match="no-first-guess"):
        first_guess(transit_of(outside, night))


# --- held-out blocks and their guard ---


def test_blocks_and_guard() -> None:
    for images, blocks, guard in (
        (126, 10, 3), (84, 10, 2), (30, 10, 1), (12, 4, 1), (11, 3, 0), (6, 2, 0), (250, 10, 6)
    ):  # fmt: skip
        found = folds(images)
        assert len(found) == blocks
        assert [k for fold in found for k in fold.held_out] == list(range(images))  # each once, in order
        sizes = [len(fold.held_out) for fold in found]
        assert max(sizes) - min(sizes) <= 1 and min(sizes) >= 3
        for fold in found:
            first, last = fold.held_out[0], fold.held_out[-1]
            around = range(max(0, first - guard), min(images, last + guard + 1))
            assert fold.held_out == tuple(range(first, last + 1))
            assert fold.fitted == tuple(k for k in range(images) if k not in around)
    assert [folds(images) for images in range(6)] == [()] * 6, "too few images for two blocks"
