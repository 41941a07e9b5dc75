"""`python -m studies.venus_gap`: which causes of a measured gap the data support, and which they cannot separate.

The data are 32 epochs of Venus in front of the Sun in AIA 193, deconvolved with the standard PSF, which contains no
long-range scatter. The disc of Venus should be dark, but is not. The remaining light is fitted as a sum of terms, each
with a physical meaning:

    core = sum over terms of weight x term          Eq. (1)

Choices of terms are compared by the rms error of held-out epochs, and by BIC = n ln(rss / n) + k ln n, where n is the
number of epochs, k the number of terms, and rss the sum of the squared residuals.
"""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

FILE = "data/real/occultation/aia193_venus_residuals.csv"


@dataclass(frozen=True)
class Explained:
    """One choice of terms.

    weights: weight and error of each term; the weight is the light in DN for the mean of the term. held_out_rms: DN.
    """

    terms: tuple[str, ...]
    weights: dict[str, tuple[float, float]]
    held_out_rms: float
    bic: float


def read(shared: Path) -> tuple[Vector, dict[str, Vector]]:
    """The light that remains in the disc (DN) at each epoch, and the terms, scaled to a mean (or a step) of 1."""
    with (shared / FILE).open() as lines:
        rows = list(csv.DictReader(lines))
    column = {name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name != "time"}
    order = np.linspace(-0.5, 0.5, len(rows))
    ring, disk = column["annulus_DN_after_std_psf"], column["fulldisk_DN"]
    # About every other image has 5 % more light over the whole disk: there are two kinds of images.
    brighter = (disk > np.polyval(np.polyfit(order, disk, 1), order)).astype(float)
    return column["core_DN_after_std_psf"], {
        "level": np.ones(len(rows)),
        "ring": ring / ring.mean(),
        "full disk": disk / disk.mean(),
        "kind of image": brighter - brighter.mean(),
        "time": order,
    }


def explained(core: Vector, terms: dict[str, Vector], chosen: Sequence[str]) -> Explained:
    """Fit Eq. (1) by least squares."""
    design = np.array([terms[name] for name in chosen]).T
    inverse = np.linalg.inv(design.T @ design)
    weights = inverse @ design.T @ core
    left = core - design @ weights
    n, k = design.shape
    sigma = np.sqrt(np.diag(inverse) * float(left @ left) / (n - k))
    lever = np.einsum("ni,ij,nj->n", design, inverse, design)
    return Explained(
        tuple(chosen),
        {name: (float(w), float(s)) for name, w, s in zip(chosen, weights, sigma, strict=True)},
        float(np.sqrt(np.mean((left / (1 - lever)) ** 2))),
        float(n * np.log(left @ left / n) + k * np.log(n)),
    )


def ranking(core: Vector, terms: dict[str, Vector], most: int = 3) -> list[Explained]:
    """Fit every choice of up to `most` terms; the smallest BIC first."""
    chosen = (c for k in range(1, most + 1) for c in itertools.combinations(terms, k))
    return sorted((explained(core, terms, c) for c in chosen), key=lambda one: one.bic)


if __name__ == "__main__":
    shared = Path(os.environ.get("HELIOPSF_SHARED", Path(__file__).parents[2] / "shared"))
    core, terms = read(shared)
    print(
        f"light in the disc after the standard PSF: mean {core.mean():.1f} DN, standard deviation {core.std():.1f} DN"
    )
    for one in ranking(core, terms)[:8]:
        said = ", ".join(f"{name} {w:.1f} +- {s:.1f}" for name, (w, s) in one.weights.items())
        print(f"BIC {one.bic:6.1f}  held-out rms {one.held_out_rms:.2f} DN  {said}")
