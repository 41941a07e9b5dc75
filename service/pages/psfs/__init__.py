"""The pages of PSFs: their list, one PSF, and two PSFs compared."""
