"""FITS images in compressed tiles: their parameters, and checks of the tiles before they are decoded."""
