"""Convolution with a PSF and its adjoint, through Fourier transforms."""
