"""Patterns that any gap makes, whatever its cause: what an effect leaves is searched along them.

A gap of unknown cause is smooth in time within a pointing, and within a disc it goes with radius or azimuth. Looked at
along these few directions it stands out where chi2 of all cells, most of them noise, would not tell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.evidence.cells import DiscCells
from psfcore.gap.evidence.evidence import Evidence

Matrix = NDArray[np.float64]

DEGREES = 4  # of a polynomial in time: 0 to 3


def patterns(evidence: Evidence) -> tuple[Matrix, ...]:
    """For each disc the patterns (patterns, cells), each a share of what is expected there, DN/s."""
    fovs = sorted({taken.pointing for taken in evidence.image_info})
    times = {fov: [t.time_s for t in evidence.image_info if t.pointing == fov] for fov in fovs}
    return tuple(_of_disc(evidence, disc, fovs, times) for disc in evidence.discs)


def _of_disc(evidence: Evidence, disc: DiscCells, fovs: list[int], times: dict[int, list[float]]) -> Matrix:
    taken = evidence.image_info[disc.index]
    first, last = min(times[taken.pointing]), max(times[taken.pointing])
    at = 2 * (taken.time_s - first) / (last - first) - 1 if last > first else 0.0
    level = np.full(disc.expected.size, float(disc.share @ disc.expected))
    in_time = np.zeros((len(fovs), DEGREES))
    in_time[fovs.index(taken.pointing)] = [np.polynomial.Legendre.basis(k)(at) for k in range(DEGREES)]
    return np.vstack([in_time.ravel()[:, None] * level, in_disc(disc) * level])


def means(evidence: Evidence) -> tuple[Matrix, ...]:
    """For each disc as many patterns as there are discs (discs, cells): its own, one plane, is as bright as the disc."""
    own = np.eye(len(evidence.discs))
    return tuple(np.outer(row, disc.expected) for row, disc in zip(own, evidence.discs, strict=True))


def in_disc(disc: DiscCells) -> Matrix:
    """Radius, dipole and quadrupole of a disc's cells, each without mean: (5, cells)."""
    r, t = disc.radius, disc.azimuth
    out = np.array([r**2, r * np.cos(t), r * np.sin(t), r**2 * np.cos(2 * t), r**2 * np.sin(2 * t)])
    return np.asarray(out - (out @ disc.share)[:, None])
