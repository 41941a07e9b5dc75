"""Measures what a deconvolution changed in an image, the errors of the pixels, and the signs of artefacts."""
