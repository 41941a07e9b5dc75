"""Patterns that a gap of any cause produces. The residuals after an effect are tested with these patterns.

A gap of unknown cause is usually smooth in time within a pointing, and varies within a disc with radius or azimuth. The
test with these few patterns detects such a gap more easily than chi2 of all cells, because most of that chi2 is noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.evidence.cells import DiscCells
from psfcore.gap.evidence.evidence import Evidence

Matrix = NDArray[np.float64]

DEGREES = 4  # number of polynomials in time: degrees 0 to 3


def patterns(evidence: Evidence) -> tuple[Matrix, ...]:
    """For each disc, all patterns (patterns, cells), DN/s: each is scaled by the mean expected light of the disc."""
    pointings = sorted({taken.pointing for taken in evidence.image_info})
    times = {
        pointing: [t.time_s for t in evidence.image_info if t.pointing == pointing] for pointing in pointings
    }
    return tuple(_of_disc(evidence, disc, pointings, times) for disc in evidence.discs)


def _of_disc(
    evidence: Evidence, disc: DiscCells, pointings: list[int], times: dict[int, list[float]]
) -> Matrix:
    taken = evidence.image_info[disc.index]
    first, last = min(times[taken.pointing]), max(times[taken.pointing])
    at = 2 * (taken.time_s - first) / (last - first) - 1 if last > first else 0.0
    level = np.full(disc.expected.size, float(disc.share @ disc.expected))
    in_time = np.zeros((len(pointings), DEGREES))
    in_time[pointings.index(taken.pointing)] = [np.polynomial.Legendre.basis(k)(at) for k in range(DEGREES)]
    return np.vstack([in_time.ravel()[:, None] * level, in_disc(disc) * level])


def means(evidence: Evidence) -> tuple[Matrix, ...]:
    """Patterns that change the mean of one disc only: for each disc an array (discs, cells), DN/s.

    Row k is zero in all discs but disc k. There it is the expected light.
    """
    own = np.eye(len(evidence.discs))
    return tuple(np.outer(row, disc.expected) for row, disc in zip(own, evidence.discs, strict=True))


def in_disc(disc: DiscCells) -> Matrix:
    """Five patterns in the cells of a disc, each with mean zero (5, cells): the radius, two dipoles and two quadrupoles."""
    r, t = disc.radius, disc.azimuth
    out = np.array([r**2, r * np.cos(t), r * np.sin(t), r**2 * np.cos(2 * t), r**2 * np.sin(2 * t)])
    return np.asarray(out - (out @ disc.share)[:, None])
