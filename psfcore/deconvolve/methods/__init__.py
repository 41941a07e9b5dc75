"""Deconvolution methods, one per file; `registry` finds them by name."""
