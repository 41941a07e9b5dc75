"""Gaps are filled from another frame of the same pointing, scaled to the brightness of the frame, and marked."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.image import Image, MaskBit
from psfcore.transit.prepare import Exposure, exposure_of, prepare
from psfcore.transit.transit import Place
from tests.transit_files import SHAPE, SPOT, true_rate

Flat = NDArray[np.float64]
AWAY = Place(10.0, 10.0, 4.0)


def exposure(
    rate: Flat,
    *,
    saturated: object = None,
    nonfinite: object = None,
    pointing: int = 1,
    time_s: float = 0.0,
    place: Place = AWAY,
    unit: str = "DN/s",
) -> Exposure:
    """An exposure of 2 s with the pixels ``rate``, and gaps at the given index expressions or masks."""
    pixels, mask = rate.copy(), np.zeros(rate.shape, np.uint8)
    if saturated is not None:
        mask[saturated] |= int(MaskBit.SATURATED)
        pixels[saturated] = 500.0
    if nonfinite is not None:
        mask[nonfinite] |= int(MaskBit.NONFINITE)
        pixels[nonfinite] = np.nan
    return exposure_of(
        Image(pixels=pixels, mask=mask, header=Header(), unit=unit, exposure_s=2.0),
        file=f"{time_s:g}.fits",
        pointing=pointing,
        place=place,
        time_s=time_s,
        gain_mode=None,
    )


def test_dn_become_dn_per_second_and_pixels_without_gaps_stay_unchanged() -> None:
    rate = true_rate(1)
    read = exposure(2 * rate, unit="dn")
    assert read.exposure_s == 2.0 and read.pixels.dtype == np.float32 and np.allclose(read.pixels, rate)
    with pytest.raises(DataError, match=r"unknown-unit: 0\.fits: "):
        exposure(rate, unit="erg")
    frames, prepared = prepare([exposure(rate, time_s=t) for t in (0, 1)])
    assert all(np.array_equal(frame.pixels, rate.astype(np.float32)) for frame in frames)
    assert all(frame.filled is None for frame in frames)
    assert prepared.to_json() == {"images": 2, "unfilled": 0, "frames": []}


def test_filled_pixels_are_scaled_to_the_brightness_of_the_frame() -> None:
    """The other frame is 1.3 times as bright and noisy; the scale corrects this to the noise of a median."""
    rate = true_rate(1)
    rng = np.random.default_rng(2)
    donor = 1.3 * rate * rng.normal(1, 0.01, SHAPE)
    frames, prepared = prepare([exposure(rate, saturated=SPOT), exposure(donor, time_s=60)])
    filled = frames[0].filled
    assert filled is not None and filled[SPOT].all() and np.count_nonzero(filled) == 48
    assert frames[0].pixels[SPOT].mean() == pytest.approx(1000, rel=0.005)
    outside = ~filled
    assert np.array_equal(frames[0].pixels[outside], rate.astype(np.float32)[outside])
    assert np.array_equal(frames[1].pixels, donor.astype(np.float32)), "the donor stays"
    counts = prepared.frames[0]
    assert (counts.saturated, counts.from_frames, counts.from_neighbours, counts.unfilled) == (48, 48, 0, 0)


def test_gaps_are_filled_from_the_nearest_frames_of_the_pointing() -> None:
    rate, marked = true_rate(1), [true_rate(1) for _ in range(4)]
    for number, frame in enumerate(marked):
        frame[SPOT] = 2000.0 + number
    frames, _ = prepare(
        [
            exposure(marked[0], time_s=0),
            exposure(marked[1], time_s=90),
            exposure(rate, time_s=100, saturated=SPOT),
            exposure(marked[2], time_s=105, pointing=2),  # nearer, but of another pointing
            exposure(rate, time_s=107, saturated=SPOT),  # nearer, but saturated there too
            exposure(marked[3], time_s=111),
        ]
    )
    assert np.allclose(frames[2].pixels[SPOT], 2001)
    assert np.allclose(frames[4].pixels[SPOT], 2003)
    rate = true_rate(1)
    half = (slice(40, 43), SPOT[1])
    frames, prepared = prepare(
        [
            exposure(rate, saturated=SPOT),
            exposure(rate, time_s=10, saturated=half),
            exposure(rate, time_s=20),
        ]
    )
    assert np.allclose(frames[0].pixels, rate, rtol=1e-6)
    assert prepared.frames[0].from_frames == 48 and prepared.frames[1].from_frames == 24


def test_pixels_that_no_frame_shows_keep_their_value() -> None:
    rate = true_rate(1)
    over_the_spot = exposure(rate, time_s=10, place=Place(63.5, 42.5, 4.0))
    over_the_spot.pixels[SPOT] = 1.0
    frames, _ = prepare([exposure(rate, saturated=SPOT), over_the_spot, exposure(rate, time_s=99)])
    assert np.allclose(frames[0].pixels[SPOT], 1000)
    frames, prepared = prepare([exposure(rate, time_s=t, saturated=SPOT) for t in (0, 60)])
    for frame, counts in zip(frames, prepared.frames, strict=True):
        assert (frame.pixels[SPOT] == 500).all()
        assert frame.filled is not None and frame.filled[SPOT].all()
        assert (counts.saturated, counts.from_frames, counts.unfilled) == (48, 0, 48)
    assert prepared.unfilled == 96 and prepared.to_json()["frames"][0]["unfilled"] == 48


def test_nan_is_filled_from_frames_and_else_from_neighbours() -> None:
    rate = np.full(SHAPE, 80.0)
    rate[:, 40:] = 120.0
    gap = (slice(30, 32), slice(20, 22))
    frames, prepared = prepare([exposure(rate, nonfinite=gap), exposure(rate, time_s=5)])
    assert np.allclose(frames[0].pixels, rate) and prepared.frames[0].from_frames == 4
    frames, prepared = prepare([exposure(rate, nonfinite=gap)])
    assert np.allclose(frames[0].pixels, rate) and prepared.frames[0].from_neighbours == 4
    assert prepared.frames[0].nonfinite == 4 and np.count_nonzero(frames[0].filled) == 4
    frames, _ = prepare([exposure(rate, nonfinite=(slice(None), slice(0, 25)))])
    assert np.allclose(frames[0].pixels, rate), "a wide gap is filled from the nearest pixels"
    huge = rate.copy()
    huge[3, 3] = 1e60
    frames, prepared = prepare([exposure(huge)])
    assert np.allclose(frames[0].pixels, rate) and prepared.frames[0].nonfinite == 1, "beyond float32"
    # Another frame shows the Sun at this place.
    rate = true_rate(1)
    dark = rate.copy()
    y, x = np.indices(SHAPE)
    dark[np.hypot(x - 30, y - 30) <= 4] = 10.0
    one = exposure(dark, nonfinite=(30, 30), place=Place(30.0, 30.0, 4.0))
    frames, _ = prepare([one, exposure(rate, time_s=1)])
    assert frames[0].pixels[30, 30] == pytest.approx(10.0)
    assert frames[0].filled is not None and frames[0].filled[30, 30]


def test_a_mostly_saturated_image_that_cannot_be_filled_is_refused() -> None:
    rate = true_rate(1)
    most = (slice(None), slice(0, 41))
    with pytest.raises(DataError, match=r"0\.fits.* 51 %") as caught:
        prepare([exposure(rate, saturated=most), exposure(rate, time_s=60, pointing=2)])
    assert caught.value.code == "all-saturated"
    frames, _ = prepare([exposure(rate, saturated=most), exposure(rate, time_s=60)])
    y, x = np.indices(SHAPE)
    far = np.hypot(x - AWAY.x_px, y - AWAY.y_px) > 10
    assert np.allclose(frames[0].pixels[far], rate[far], rtol=1e-3)
    less = (slice(None), slice(0, 39))
    prepare([exposure(rate, saturated=less)])
