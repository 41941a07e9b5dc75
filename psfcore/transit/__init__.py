"""Transits, in which an occulter crosses the Sun: reading, preparing, places of the occulter, first guess of scatter."""
