"""Deconvolution of images with a known PSF.

Each method is one file in `methods` with a function `deconvolve(image, psf, conditions, ...) -> Deconvolved`. The
constant METHOD is the name of the method, and EDGES is its default assumption about the scene beyond the field.
`methods.registry.method_named` finds a method by its name. A method that uses the engine calls `problem.pose` and
passes its `Iteration` to `Problem.solve`.
"""
