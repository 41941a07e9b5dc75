"""The commands `heliopsf psf`: make, read and version PSFs."""
