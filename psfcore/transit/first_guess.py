"""A first guess of the light that is diffracted and scattered to large distances, directly from the occulted pixels.

Paper (Hofmeister et al.), section "A first guess on the amount of scattered and diffracted light": if the Sun is
homogeneous, all light in the centre of a small dark disc comes from farther than its radius:

    I_o,dc = I_t sum over dr > r_disk of psf(dr),  mean I_o = I_t
    sum over dr > r_disk of psf(dr) = I_o,dc / mean I_o                     Eq. (1)

There are three estimators of the characteristic intensity, mean I_o: the mean of the image, the median of the image,
and the mean in a ring ("shell") of 50 px around the disc.

| symbol | name | unit |
|---|---|---|
| I_o,dc | centre_dn_s: mean within CENTRE_PX of the disc's centre | DN/s |
| mean I_o | image_mean, image_median, shell | DN/s |
| I_o,dc / mean I_o | ratio | 1 |
| r_disk | radius_px | px |

The paper judges by eye how homogeneous the Sun is. Here the inhomogeneity is a number. For the three
estimators, their range (largest minus smallest) is divided by their mean. The same is done for the means in the four
quadrants of the shell. The larger ratio is the inhomogeneity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import json_attributes
from psfcore.errors import DataError
from psfcore.transit.transit import Frame, Place, Transit

CENTRE_PX = 2.0
SHELL_PX = 50.0
# Departure from the paper: the shell begins 2 px outside the disc, beyond its blurred edge and ephemeris errors of 1
# px.
EDGE_PX = 2.0
ESTIMATORS = ("image_mean", "image_median", "shell")

Flat = NDArray[np.float64]


@dataclass(frozen=True)
class FrameGuess:
    """The first guess from one image. Intensities are in DN/s; a value that cannot be computed is NaN.

    Attributes
    ----------
    characteristic_dn_s
        The characteristic intensity by each estimator; `ratio` also has one value for each estimator.
    inhomogeneity
        Inhomogeneity of the image; infinite if the centre of the disc is not in the image, or if one of the estimators
        is not above 0.
    """

    file: str
    pointing: int
    time_s: float
    centre_dn_s: float
    characteristic_dn_s: Mapping[str, float]
    inhomogeneity: float

    @property
    def ratio(self) -> dict[str, float]:
        """The fraction of light that comes from farther than the radius of the disc, by estimator."""
        return {
            name: self.centre_dn_s / level if level > 0 else math.nan  # Eq. (1)
            for name, level in self.characteristic_dn_s.items()
        }


@dataclass(frozen=True)
class PointingGuess:
    """The first guess from one pointing: mean and standard deviation (scatter) of the ratio over its images, by
    estimator.

    Attributes
    ----------
    inhomogeneity
        The median inhomogeneity of the images of the pointing.
    """

    pointing: int
    images: int
    mean: Mapping[str, float]
    scatter: Mapping[str, float]
    inhomogeneity: float


@dataclass(frozen=True)
class FirstGuess:
    """The first guess from all images, in the order of time, and from all pointings. The ratio is 1 - encircled energy
    at radius_px, as a fraction.

    Attributes
    ----------
    best_pointing
        The most homogeneous pointing.
    share, share_spread
        Mean and standard deviation of the ratios of all images of this pointing and all three estimators.
    radius_px
        The mean radius of the disc in these images.
    """

    frames: tuple[FrameGuess, ...]
    pointings: tuple[PointingGuess, ...]
    best_pointing: int
    share: float
    share_spread: float
    radius_px: float

    def to_json(self) -> dict[str, object]:
        """The first guess as JSON values; NaN and infinity become null. The keys "best_fov" and "fov" contain
        the number of a pointing.
        """
        return {
            "best_fov": self.best_pointing,
            **json_attributes(self, "share", "share_spread", "radius_px"),
            "pointings": [
                {
                    "fov": guess.pointing,
                    **json_attributes(guess, "images", "mean", "scatter", "inhomogeneity"),
                }
                for guess in self.pointings
            ],
            "frames": [
                {
                    "file": frame.file,
                    "fov": frame.pointing,
                    **json_attributes(frame, "time_s", "centre_dn_s", "ratio", "inhomogeneity"),
                }
                for frame in self.frames
            ],
        }


def first_guess(transit: Transit, *, threads: int = 1) -> FirstGuess:
    """The first guess of a transit, with the positions of the occulter from the ephemeris.

    Raises DataError "no-first-guess" if no image shows the centre of the occulter in front of the Sun.
    """
    with ThreadPoolExecutor(threads) as pool:
        guesses = list(pool.map(_frame_guess, transit.frames))
    pointings = tuple(
        _pointing_guess(pointing, guesses) for pointing in sorted({guess.pointing for guess in guesses})
    )
    telling = [p for p in pointings if math.isfinite(p.inhomogeneity)]
    if not telling:
        message = (
            "expected at least one image that shows the centre of the occulter in front of the Sun; got none: check "
            "the positions in transit.json"
        )
        raise DataError("no-first-guess", message)
    best = min(telling, key=lambda guess: guess.inhomogeneity)
    ratios = _finite([r for g in guesses if g.pointing == best.pointing for r in g.ratio.values()])
    radii = [frame.place.radius_px for frame in transit.frames if frame.pointing == best.pointing]
    return FirstGuess(
        frames=tuple(guesses),
        pointings=pointings,
        best_pointing=best.pointing,
        share=float(ratios.mean()),
        share_spread=float(ratios.std()),
        radius_px=float(np.mean(radii)),
    )


def _frame_guess(frame: Frame) -> FrameGuess:
    place = frame.place
    pixels, dx, dy = _surroundings(frame, place)
    r = np.hypot(dx, dy)
    centre = pixels[r <= CENTRE_PX]
    inner = place.radius_px + EDGE_PX
    in_shell = (r > inner) & (r <= inner + SHELL_PX)
    shell = pixels[in_shell]
    levels = {
        "image_mean": float(frame.pixels.mean(dtype=np.float64)),
        "image_median": float(np.median(frame.pixels)),
        "shell": _mean(shell),
    }
    quadrant = (dx[in_shell] > 0).astype(np.int8) + 2 * (dy[in_shell] > 0)
    quadrants = [_mean(shell[quadrant == q]) for q in range(4)]
    apart = [_range_over_mean(list(levels.values())), _range_over_mean(quadrants)]
    visible = centre.size > 0 and all(level > 0 for level in levels.values())
    return FrameGuess(
        file=frame.file,
        pointing=frame.pointing,
        time_s=frame.time_s,
        centre_dn_s=_mean(centre),
        characteristic_dn_s=levels,
        inhomogeneity=max(apart) if visible else math.inf,
    )


def _surroundings(frame: Frame, place: Place) -> tuple[Flat, Flat, Flat]:
    """The pixels of a square around the disc, without filled pixels, and their x and y relative to the disc's centre.

    All three arrays have one axis.
    """
    reach = place.radius_px + EDGE_PX + SHELL_PX + 2
    ny, nx = frame.pixels.shape
    top, bottom = (min(max(int(place.y_px + side * reach), 0), ny) for side in (-1, 1))
    left, right = (min(max(int(place.x_px + side * reach), 0), nx) for side in (-1, 1))
    here = (slice(top, bottom), slice(left, right))
    y, x = np.mgrid[here]
    valid = np.ones(x.shape, dtype=bool) if frame.filled is None else ~frame.filled[here]
    pixels = frame.pixels[here][valid].astype(np.float64)
    return pixels, x[valid] - place.x_px, y[valid] - place.y_px


def _pointing_guess(pointing: int, guesses: Sequence[FrameGuess]) -> PointingGuess:
    mine = [guess for guess in guesses if guess.pointing == pointing]
    values = {name: _finite([guess.ratio[name] for guess in mine]) for name in ESTIMATORS}
    return PointingGuess(
        pointing=pointing,
        images=len(mine),
        mean={name: _mean(ratios) for name, ratios in values.items()},
        scatter={name: float(ratios.std()) if ratios.size else math.nan for name, ratios in values.items()},
        inhomogeneity=float(np.median([guess.inhomogeneity for guess in mine])),
    )


def _range_over_mean(values: list[float]) -> float:
    """The range (largest minus smallest) of the finite values divided by their mean; infinite if the mean is not above
    0.
    """
    finite = _finite(values)
    if finite.size == 0 or finite.mean() <= 0:
        return math.inf
    return float((finite.max() - finite.min()) / finite.mean())


def _mean(values: Flat) -> float:
    return float(values.mean()) if values.size else math.nan


def _finite(values: Sequence[float]) -> Flat:
    array = np.asarray(values, dtype=np.float64)
    return np.asarray(array[np.isfinite(array)])
