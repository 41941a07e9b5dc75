"""Tests of a fitted PSF with held-out images, other shapes, shells without a formula, and wrong dark levels."""
