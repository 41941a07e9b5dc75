"""Deconvolution methods, one file each, all called as ``deconvolve(image, psf, conditions, ...) -> Deconvolved``.

A method's file says METHOD, its name, and EDGES, what it does at edges where nothing is asked for;
`methods.method_named` finds it. A method that steps through the engine is an `Iteration` between
`problem.pose` and `problem.solution`.
"""
