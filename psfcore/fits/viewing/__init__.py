"""Reads the parts of a stored FITS file that a viewer shows: the pixels of one plane, and the cards of all headers."""
