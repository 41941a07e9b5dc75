"""Transits: an occulter before the Sun, its place, its pixels, and what they say of scattered light."""
