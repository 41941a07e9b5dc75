"""Transits, in which an occulter crosses the Sun: reading, preparing, positions of the occulter, first guess of
scatter.
"""
