"""Images whose content once cost more than an image of the Sun: plateaus, patterns, noise, ramps, lost pixels."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from psfcore.simulate.scene import solar_scene

Plane = NDArray[np.float64]
SATURATED = 30_000.0


@cache
def sun(size: int, seed: int = 1) -> Plane:
    """The image of the Sun with photon noise to which the others are compared [y, x]."""
    rng = np.random.default_rng(seed)
    return np.asarray(rng.poisson(solar_scene((size, size), seed)) + rng.normal(0.0, 0.3, (size, size)))


def _off_limb(size: int, sky: float) -> Plane:
    y, x = np.indices((size, size)) - size / 2
    return np.where(np.hypot(x, y) < 0.35 * size, sun(size), sky)


def _border(size: int) -> Plane:
    pixels, width = np.full((size, size), 5.0), size // 8
    pixels[width:-width, width:-width] = sun(size)[width:-width, width:-width]
    return pixels


def _one(size: int, level: float, place: float) -> Plane:
    """A constant with one square of 4 px of another level; with NaN, all other pixels are lost."""
    pixels = np.full((size, size), level)
    pixels[size // 2 : size // 2 + 4, size // 2 : size // 2 + 4] = place
    pixels[size // 2, size // 2] = 2 * place
    return pixels


def _blocks(size: int, block_px: int) -> Plane:
    levels = np.random.default_rng(2).uniform(1.0, 100.0, (-(-size // block_px),) * 2)
    return np.kron(levels, np.ones((block_px, block_px)))[:size, :size]


def _pattern(size: int, width_px: int, *, both: bool) -> Plane:
    y, x = np.indices((size, size)) // width_px
    return np.where((x + y * both) % 2 == 0, 1.0, 3.0)


def _saturated(size: int, share: float) -> Plane:
    pixels = sun(size)
    pixels[: round(share * size)] = SATURATED
    return pixels


def _lost(size: int) -> Plane:
    return np.where(np.random.default_rng(3).random((size, size)) < 0.9, np.nan, sun(size))


def _points(size: int) -> Plane:
    pixels = np.random.default_rng(4).normal(20.0, 0.5, (size, size))
    pixels[2::5, 2::5] += np.arange(pixels[2::5, 2::5].size).reshape(pixels[2::5, 2::5].shape) + 1000.0
    return pixels


def _drawn(draw: Callable[[np.random.Generator, tuple[int, int]], NDArray[np.generic]], size: int) -> Plane:
    return np.asarray(draw(np.random.default_rng(5), (size, size)), np.float64)


CONTENTS: dict[str, Callable[[int], Plane]] = {
    "dark off-limb": lambda size: _off_limb(size, 0.0),
    "constant off-limb": lambda size: _off_limb(size, 3.0),
    "flat border": _border,
    "constant": lambda size: np.full((size, size), 3.0),
    "one bright square": lambda size: _one(size, 3.0, 1000.0),
    "all lost but a few": lambda size: _one(size, np.nan, 7.0),
    "nine in ten lost": _lost,
    "blocks of 32 px": lambda size: _blocks(size, 32),
    "blocks of 2 px": lambda size: _blocks(size, 2),
    "stripes": lambda size: _pattern(size, 1, both=False),
    "wide stripes": lambda size: _pattern(size, 16, both=False),
    "checkerboard": lambda size: _pattern(size, 1, both=True),
    "one value in two": lambda size: _drawn(lambda rng, shape: rng.choice([1.0, 3.0], shape), size),
    "half saturated": lambda size: _saturated(size, 0.5),
    "nearly all saturated": lambda size: _saturated(size, 0.9),
    "noise": lambda size: _drawn(lambda rng, shape: rng.normal(0.0, 1.0, shape), size),
    "faint counts": lambda size: _drawn(lambda rng, shape: rng.poisson(0.5, shape), size),
    "nine decades": lambda size: _drawn(lambda rng, shape: 10 ** rng.uniform(-3, 6, shape), size),
    "ramp": lambda size: _drawn(lambda rng, shape: 1.0 + np.indices(shape)[1], size),
    "rising pixels": lambda size: 1.0 + np.arange(size * size, dtype=np.float64).reshape(size, size),
    "points": _points,
}
