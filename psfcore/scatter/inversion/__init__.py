"""The inversion: it finds the PSF for which a transit's occulter is dark."""

from psfcore.scatter.inversion.inversion import *  # noqa: F403
