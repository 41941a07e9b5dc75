"""Diffraction by what stands in the beam."""
