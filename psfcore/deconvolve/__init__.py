"""Deconvolution methods, one file each, all called as ``method(image, psf, ...) -> Deconvolved``."""
