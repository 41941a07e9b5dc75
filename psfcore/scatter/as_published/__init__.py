"""The inversion exactly as published: segments of the PSF, ring sums, the system of equations, and six rounds."""
