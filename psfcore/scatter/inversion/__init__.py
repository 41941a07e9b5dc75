"""The inversion: the PSF for which the occulter of a transit is dark."""

from psfcore.scatter.inversion.inversion import PILOT_FRAMES, invert, refit
from psfcore.scatter.inversion.reconstruction import (
    DARK_MARGIN_PX,
    DARK_MARGIN_SIGMAS,
    LEAST_DARK_PIXELS,
    LEAST_LEVEL,
    Progress,
    Reconstruction,
    dark_pixels,
)
from psfcore.scatter.inversion.results import Inversion, Solution
from psfcore.scatter.inversion.solver import CONVERGED_POINTS

__all__ = [
    "CONVERGED_POINTS",
    "DARK_MARGIN_PX",
    "DARK_MARGIN_SIGMAS",
    "LEAST_DARK_PIXELS",
    "LEAST_LEVEL",
    "PILOT_FRAMES",
    "Inversion",
    "Progress",
    "Reconstruction",
    "Solution",
    "dark_pixels",
    "invert",
    "refit",
]
