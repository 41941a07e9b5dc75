"""Deconvolution of images with a known PSF.

Each method is one file in `methods`, with a function `deconvolve(image, psf, conditions, ...) -> Deconvolved`. The
constant METHOD is its name, and EDGES is its default for what lies beyond the field; `methods.registry.method_named`
finds it. A method that uses the engine is an `Iteration` between `problem.pose` and `problem.solution`.
"""
