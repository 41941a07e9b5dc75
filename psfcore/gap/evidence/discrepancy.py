"""The discrepancy: a change of the data that stands for a cause outside the library.

A discrepancy changes the means of the discs, their cells or the unocculted blocks smoothly along one or several
properties. These properties are called axes (in the names of the code: `orders`): position on the detector, time,
intensity, exposure time, counts (intensity times exposure time, DN), pointing, radius and azimuth. The discrepancy is a
sum of Legendre polynomials along each axis, times the expected light, with random coefficients. It does not depend on
the library or on the images. A cause that varies along one of the axes resembles it.

A cause may also follow no axis. The alternatives for this case are: every disc has its own change; every cell of every
disc has its own change; every block of the detector has its own change, which is the same in all readouts. These
alternatives have many coefficients, so they are probable only if the residuals after every other hypothesis are much
larger than the noise.

Each set of axes in ALTERNATIVES is one alternative: the data vary along all axes of the set. The hypothesis "unknown"
contains all alternatives with equal probability.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import Directions
from psfcore.gap.evidence.patterns import in_disc

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]

LIKELY = 0.02  # likely relative size of a coefficient; the likelihood also tries ten times this size
DEGREE = 3
DETECTOR = ("x", "y")
OF_DISCS = (*DETECTOR, "time", "intensity", "exposure", "pointing", "radius", "azimuth")
COUNTS = ("counts", "unocculted_counts")
OF_BLOCKS = ("unocculted_time", "unocculted_exposure", "unocculted_intensity")
# Changes without any axis: one for each disc, one for each cell of each disc, one for each block of the detector.
EACH_DISC, EACH_CELL, EACH_READOUT = "disc", "cell", "readout"
ALTERNATIVES: tuple[tuple[str, ...], ...] = (
    ("x",),
    ("y",),
    DETECTOR,
    (*DETECTOR, "pointing"),
    ("time",),
    ("unocculted_time",),
    ("time", "unocculted_time"),
    ("intensity",),
    ("intensity", "unocculted_intensity"),
    ("exposure", "unocculted_exposure"),
    COUNTS,
    ("pointing",),
    ("radius",),
    ("azimuth",),
    OF_DISCS,
    (*OF_DISCS, *OF_BLOCKS),
    (EACH_DISC,),
    (EACH_DISC, EACH_CELL),
    (EACH_READOUT,),
    (EACH_DISC, EACH_READOUT),
)
# The words for each axis in a report.
WORDS = {
    "x": "the position along detector x",
    "y": "the position along detector y",
    "time": "the time",
    "intensity": "the intensity",
    "exposure": "the exposure time",
    "counts": "the counts in the disc",
    "pointing": "the pointing",
    "radius": "the radius in the disc",
    "azimuth": "the azimuth in the disc",
    "unocculted_time": "the time, in the unocculted field",
    "unocculted_exposure": "the exposure time, in the unocculted field",
    "unocculted_intensity": "the intensity, in the unocculted field",
    "unocculted_counts": "the counts, in the unocculted field",
    EACH_DISC: "the disc, without any order",
    EACH_CELL: "the place in each disc",
    EACH_READOUT: "the place on the detector, the same in every readout",
}


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """The columns of the discrepancy. orders: for each axis the numbers of its columns, counted from 0."""

    directions: Directions
    orders: dict[str, tuple[int, ...]]

    def columns(self, orders: Sequence[str], first: int) -> list[int]:
        """The numbers of the columns of these axes. first: the number of the first column of the discrepancy."""
        return [first + column for order in orders for column in self.orders.get(order, ())]


def discrepancy(evidence: Evidence) -> Discrepancy:
    """The discrepancy for the discs and blocks of a transit."""
    discs = _of_discs(evidence)
    blocks = _of_blocks(evidence)
    cells = max(disc.residual.size for disc in evidence.discs)
    shape = evidence.unocculted.levels.shape
    orders: dict[str, tuple[int, ...]] = {}
    in_discs: list[Matrix] = []
    in_blocks: list[Matrix] = []
    for name, planes in discs.items():
        orders[name] = tuple(range(len(in_discs), len(in_discs) + len(planes)))
        in_discs += planes
        in_blocks += [np.zeros(shape)] * len(planes)
    for name, planes in blocks.items():
        orders[name] = tuple(range(len(in_discs), len(in_discs) + len(planes)))
        in_discs += [np.zeros((len(evidence.discs), cells))] * len(planes)
        in_blocks += planes
    return Discrepancy(Directions(np.stack(in_discs, axis=-1), np.array(in_blocks), LIKELY), orders)


def _of_discs(evidence: Evidence) -> dict[str, list[Matrix]]:
    """The changes of the disc cells for each axis (a property such as time or exposure; see above).

    An axis has one array (discs, cells), DN/s, for each coefficient. Discs have different numbers of cells; the rest
    of a row is 0.
    """
    infos = [evidence.image_info[disc.index] for disc in evidence.discs]
    cells = max(disc.residual.size for disc in evidence.discs)
    level = np.array([disc.mean_expected for disc in evidence.discs])
    present = np.array([np.arange(cells) < disc.residual.size for disc in evidence.discs])
    readouts = np.array([1 / info.exposure_s for info in infos])
    faint = float(level.mean()) / level
    counts = np.maximum(level * [info.exposure_s for info in infos], 1e-9)

    def whole(share: Vector) -> Matrix:
        return np.asarray((share * level)[:, None] * present)

    def smooth(values: Sequence[float] | Vector) -> list[Matrix]:
        return [whole(term) for term in legvander(_unit(np.asarray(values)), DEGREE).T[1:]]

    patterns = [np.zeros((len(infos), cells)) for _ in range(5)]
    for k, disc in enumerate(evidence.discs):
        for plane, pattern in zip(patterns, in_disc(disc), strict=True):
            plane[k, : disc.residual.size] = pattern * level[k]
    found = {
        "x": smooth([info.x_px for info in infos]),
        "y": smooth([info.y_px for info in infos]),
        "time": smooth([info.time_s for info in infos]),
        "intensity": [*smooth(np.log(np.maximum(level, 1e-9))), whole(faint)],
        "exposure": [whole(_unit(readouts)), whole(_unit(readouts) * faint)],
        "counts": [whole(term) for term in _by_counts(counts)],
        "pointing": [
            whole(np.array([info.pointing == one for info in infos], dtype=np.float64))
            for one in sorted({info.pointing for info in infos})
        ],
        "radius": patterns[:1],
        "azimuth": patterns[1:],
        EACH_DISC: [whole(one) for one in np.eye(len(infos))],
        EACH_CELL: [one[:, None] * pattern for pattern in patterns for one in np.eye(len(infos))],
    }
    return _that_vary(found)


def _of_blocks(evidence: Evidence) -> dict[str, list[Matrix]]:
    """The changes of the unocculted blocks for each axis (a property such as time or exposure) and for each block
    alone.

    An axis has one array (images, blocks), DN/s, for each coefficient.
    """
    blocks = evidence.unocculted
    mean = np.maximum(blocks.means, 1e-9)
    usual = float(mean.mean())
    rows, columns = np.divmod(np.arange(mean.shape[1]), blocks.across)
    x, y = (np.broadcast_to(_unit(one.astype(np.float64)), mean.shape) for one in (columns, rows))
    bright = _unit(np.log(mean))
    infos = evidence.image_info
    times = legvander(_unit(np.array([info.time_s for info in infos])), DEGREE).T[1:]
    readouts = _unit(np.array([1 / info.exposure_s for info in infos]))[:, None]
    counts = mean * np.array([info.exposure_s for info in infos])[:, None]
    forms: tuple[Callable[[Matrix], Matrix], ...] = (
        lambda of_image: of_image * mean,
        lambda of_image: of_image * mean * x,
        lambda of_image: of_image * mean * y,
        lambda of_image: of_image * mean * bright,
        lambda of_image: of_image * np.full_like(mean, usual),
    )
    found = {
        "unocculted_time": [form(term[:, None]) for term in times for form in forms],
        "unocculted_exposure": [form(readouts) for form in forms[1:]],
        "unocculted_intensity": [mean * term for term in np.moveaxis(legvander(bright, DEGREE), -1, 0)[1:]],
        "unocculted_counts": [mean * term for term in _by_counts(counts)],
        EACH_READOUT: [readouts * usual * block for block in np.eye(mean.shape[1])],
    }
    return _that_vary(found)


def _by_counts(counts: Vector | Matrix) -> list[Vector | Matrix]:
    """Relative changes that are smooth functions of the counts (DN), and one that is proportional to 1 / counts.

    A detector or its electronics changes a signal according to its counts. The last change is the same number of DN
    in every pixel and image.
    """
    bright = np.log(counts)
    smooth = np.moveaxis(legvander(_unit(bright), DEGREE), -1, 0)[1:]
    return [*smooth, float(np.exp(bright.mean())) / counts]


def _that_vary(found: dict[str, list[Matrix]]) -> dict[str, list[Matrix]]:
    """Remove the arrays that are zero everywhere, because the data do not vary along them, and axes without any
    array."""
    kept = {name: [plane for plane in planes if plane.any()] for name, planes in found.items()}
    return {name: planes for name, planes in kept.items() if planes}


def _unit(values: Vector) -> Vector:
    """Values, scaled to -1 ... 1; zeros if they are all equal."""
    low, high = float(values.min()), float(values.max())
    return np.asarray(2 * (values - low) / (high - low) - 1) if high > low else np.zeros_like(values)
