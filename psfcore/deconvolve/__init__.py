"""Deconvolution of images with a known PSF.

Each method is one file in `methods`: METHOD declares it (`declaration.Method`), and `deconvolve(problem, ...)` runs its
iteration, whose equations and kernels are in `iterations`. `methods.registry.method_named` finds a method by its name.
"""
