"""The covariance of a least-squares fit: invert a normal matrix whose parameters have different units.

    A = S B S,   S = diag(sqrt(A_kk))        Eq. (1)
    A^+ = S^-1 B^+ S^-1                      Eq. (2)

The diagonal of B is 1 for any units of the fitted parameters. Therefore only the data determine which directions in
the space of parameters are undetermined; a ratio of units, such as px and DN/s, has no influence. B^+ is the
pseudo-inverse of B (Moore and Penrose). Along an undetermined direction, it gives no change and no variance.

| symbol | name |
|---|---|
| A | normal: J^T W J, with the Jacobian J and the weights W |
| S | size |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

# Share of B's largest eigenvalue: a direction whose eigenvalue is smaller is undetermined.
WEAKEST_DIRECTION = 1e-15


def scaled_inverse(normal: Matrix, *, weakest: float = WEAKEST_DIRECTION) -> Matrix:
    """Compute A^+ by Eq. (2) for a symmetric, non-negative matrix (n, n).

    The rows and columns of parameters that have no influence on the data are 0.
    weakest: a direction is undetermined if its eigenvalue in B is at most this fraction of the largest eigenvalue.
    """
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(normal / scale, rcond=weakest, hermitian=True) / scale)  # Eq. (2)
