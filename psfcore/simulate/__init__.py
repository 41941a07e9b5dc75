"""Synthetic scenes, observations and transits whose truth is known."""
