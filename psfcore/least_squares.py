"""The inverse of a normal matrix whose numbers have units: the covariance of a least-squares fit.

    A = S B S,   S = diag(sqrt(A_kk))        Eq. (1)
    A^+ = S^-1 B^+ S^-1                      Eq. (2)

B has a unit diagonal whatever the units of the fitted numbers are, so that which of its directions are open is a
question of the data and not of px beside DN/s. B^+ is its pseudo-inverse (Moore and Penrose): a direction that is
open stays where it is, and gets no variance.

| symbol | name |
|---|---|
| A | normal: J^T W J, slopes J and weights W |
| S | size |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

WEAKEST_DIRECTION = 1e-15  # of B's strongest: weaker ones are open


def scaled_inverse(normal: Matrix, *, weakest: float = WEAKEST_DIRECTION) -> Matrix:
    """Eq. (2) of a symmetric (n, n) matrix that is not negative; a number that nothing depends on has 0 there.

    weakest: eigenvalue of B, as a share of its largest, up to which a direction is taken as open.
    """
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(normal / scale, rcond=weakest, hermitian=True) / scale)  # Eq. (2)
