"""The inversion: the PSF for which the occulter of a transit is dark."""

from psfcore.scatter.inversion.inversion import (
    ALGORITHM_VERSION,
    PILOT_FRAMES,
    Inverter,
    invert,
    refit,
    solution_of,
)
from psfcore.scatter.inversion.kept import read_solution, write_solution
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
    "ALGORITHM_VERSION",
    "CONVERGED_POINTS",
    "DARK_MARGIN_PX",
    "DARK_MARGIN_SIGMAS",
    "LEAST_DARK_PIXELS",
    "LEAST_LEVEL",
    "PILOT_FRAMES",
    "Inversion",
    "Inverter",
    "Progress",
    "Reconstruction",
    "Solution",
    "dark_pixels",
    "invert",
    "read_solution",
    "refit",
    "solution_of",
    "write_solution",
]
