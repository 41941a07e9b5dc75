"""The covariance of a least-squares fit: the inverse of a normal matrix whose parameters have different units.

    A = S B S,   S = diag(sqrt(A_kk))        Eq. (1)
    A^+ = S^-1 B^+ S^-1                      Eq. (2)

B has a unit diagonal for any units of the fitted parameters. The data alone, and not the ratio of units such as px and
DN/s, then decide which directions are undetermined. B^+ is the pseudo-inverse of B (Moore and Penrose): it gives an
undetermined direction no change and no variance.

| symbol | name |
|---|---|
| A | normal: J^T W J, with the Jacobian J and the weights W |
| S | size |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

WEAKEST_DIRECTION = 1e-15  # relative to B's largest eigenvalue; weaker directions are undetermined


def scaled_inverse(normal: Matrix, *, weakest: float = WEAKEST_DIRECTION) -> Matrix:
    """Eq. (2) for a symmetric, non-negative matrix (n, n). Parameters without any influence get 0.

    weakest: a direction is undetermined if its eigenvalue of B is at most this share of the largest.
    """
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(normal / scale, rcond=weakest, hermitian=True) / scale)  # Eq. (2)
