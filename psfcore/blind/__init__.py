"""Transits with a withheld effect: made, sealed, diagnosed by a process that sees the images alone, and scored."""
