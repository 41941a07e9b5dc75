"""Diffraction by the entrance pupil, its mount and the filter meshes."""
