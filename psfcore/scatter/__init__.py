"""Diffuse scattering by the mirrors."""
