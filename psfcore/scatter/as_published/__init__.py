"""The inversion as published: segments of the PSF, ring sums, the system of equations, and its six rounds."""
