"""The iterations of the methods, with their compiled kernels."""
